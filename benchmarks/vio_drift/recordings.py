"""Reads the real recordings that the drift model is fitted to: ARKit walks past AprilTags, ARKit at 60 Hz, and
odometry beside ground truth. Formats: docs/explanation/vio-drift.md."""

import json
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Limits
from groundwalk.capture_import.formats import FORMATS
from groundwalk.geometry.poses import Array
from groundwalk.store import UserError

TAG_WALKS = "invisible_map_arkit/benchmarking/datasets"
STEADY_LOGS = "arkit_data_logger/Visualization"
TRUTH_PAIRS = "spectacularai_two_sessions/examples/two_sessions"

# Detections of one tag less than this apart are one visit.
_VISIT_GAP_S = 5.0
# The tags hang further apart than this, so that a frame with two closer ones has read one number wrong.
_MISREAD_M = 1.5


@dataclass(frozen=True, eq=False)
class TagWalk:
    """The visits of a walk to AprilTags, in the order of time.

    `tag` (V,): number on the tag. `position` (V, 3): m, in the session's frame, +y up. `along_m` (V,): path to there.
    """

    name: str
    tag: NDArray[np.int64]
    position: Array
    along_m: Array


@dataclass(frozen=True, eq=False)
class TagLog:
    """An ARKit walk: its visits, its duration, and how often and long (s) the pose stood still before a restart.
    The visits are those after the last restart."""

    walk: TagWalk
    duration_s: float
    path_m: float
    stood_still_s: list[float]


def read_tag_log(path: Path) -> TagLog:
    """A log of the Invisible Map app: poses twice a second, and detected tags (tag in the camera, row-major, OpenCV
    axes)."""
    log, (t_ns, world_T_cam) = _json(path), _poses(path, "invisible_map")
    t_s = t_ns * 1e-9
    start, still_s = _last_start(np.asarray(t_s, float), world_T_cam)

    step = np.linalg.norm(np.diff(world_T_cam[:, :3, 3], axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(step)])
    detections: dict[int, list[tuple[int, Array]]] = defaultdict(list)
    for frame_tags in log["tag_data"]:
        frame = frame_tags[0]["pose_id"]
        if frame < start:
            continue
        cam_T_tag = _matrices([t["tag_pose"] for t in frame_tags])
        at = (world_T_cam[frame] @ cam_T_tag)[:, :3, 3]
        apart = np.linalg.norm(at[:, None] - at[None], axis=-1) + np.where(np.eye(len(at)), np.inf, 0.0)
        for tag, position, nearest in zip(frame_tags, at, apart.min(axis=1), strict=True):
            if nearest > _MISREAD_M:
                detections[tag["tag_id"]].append((frame, position))

    visits = []
    for tag_id, positions in detections.items():
        frames = np.array([frame for frame, _ in positions])
        for group in np.split(np.arange(len(frames)), np.flatnonzero(np.diff(t_s[frames]) > _VISIT_GAP_S) + 1):
            middle = frames[group[len(group) // 2]]
            visits.append((along[middle], tag_id, np.mean([positions[i][1] for i in group], axis=0)))
    visits.sort(key=lambda v: v[:2])
    walk = TagWalk(
        name=path.stem,
        tag=np.array([tag for _, tag, _ in visits]),
        position=np.array([position for _, _, position in visits]),
        along_m=np.array([m for m, _, _ in visits]),
    )
    return TagLog(walk, float(t_s[-1] - t_s[0]), float(np.sum(step[start:])), still_s)


def _last_start(t_s: Array, world_T_cam: Array) -> tuple[int, list[float]]:
    """The first frame after the last restart, and for how long the pose stood still before each."""
    same = np.all(world_T_cam[1:] == world_T_cam[:-1], axis=(1, 2))
    start, still_s = 0, []
    frame = 0
    while frame < len(same):
        if not same[frame]:
            frame += 1
            continue
        end = frame
        while end < len(same) and same[end]:
            end += 1
        start = min(end + 1, len(t_s) - 1)
        still_s.append(float(t_s[start] - t_s[frame]))
        frame = end + 1
    return start, still_s


@dataclass(frozen=True, eq=False)
class SteadyLog:
    """ARKit poses at 60 Hz: t_ns (N,) and world_T_cam (N, 4, 4)."""

    t_ns: NDArray[np.int64]
    world_T_cam: Array


def read_steady_log(path: Path) -> SteadyLog:
    """A log of ARKit Data Logger."""
    return SteadyLog(*_poses(path, "arkit_logger"))


@dataclass(frozen=True, eq=False)
class TruthPair:
    """Positions of odometry at t_s (N,) and of motion capture at truth_t_s (M,), both (., 3) with +z up."""

    name: str
    t_s: Array
    position: Array
    truth_t_s: Array
    truth_position: Array


def read_truth_pair(folder: Path) -> TruthPair:
    """A session of Spectacular AI: output.jsonl and groundtruth.jsonl."""
    vio = _json_lines(folder / "output.jsonl")
    truth = _json_lines(folder / "groundtruth.jsonl")
    return TruthPair(
        name=folder.name,
        t_s=np.array([row["time"] for row in vio]),
        position=np.array([[row["position"][axis] for axis in "xyz"] for row in vio]),
        truth_t_s=np.array([row["time"] for row in truth]),
        truth_position=np.array([[row["groundTruth"]["position"][axis] for axis in "xyz"] for row in truth]),
    )


@dataclass(frozen=True)
class Recordings:
    """Everything that the fit reads."""

    tag_logs: list[TagLog]
    steady_logs: list[SteadyLog]
    truth_pairs: list[TruthPair]


def read_recordings(folder: Path) -> Recordings:
    """All recordings below a folder. Raises UserError where one kind is absent."""

    def paths_of(where: str, pattern: str) -> list[Path]:
        paths = sorted((folder / where).glob(pattern))
        if not paths:
            raise UserError(
                "the recordings to fit to aren't there",
                where=folder / where,
                expected=pattern,
                do="point --trajectories at the folder of recordings that docs/explanation/vio-drift.md lists",
            )
        return paths

    return Recordings(
        tag_logs=[read_tag_log(p) for p in paths_of(TAG_WALKS, "*.json")],
        steady_logs=[read_steady_log(p) for p in paths_of(STEADY_LOGS, "*.txt")],
        truth_pairs=[read_truth_pair(p.parent) for p in paths_of(TRUTH_PAIRS, "*/groundtruth.jsonl")],
    )


def _poses(path: Path, format_name: str) -> tuple[NDArray[np.int64], Array]:
    """Times (N,) and world_T_cam (N, 4, 4) of a log in a capture format; UserError where a row can't be read."""
    raw = FORMATS.find(format_name).read(path, Limits())
    if raw.rejects:
        raise UserError(
            "a row of a log can't be read", where=path, found=f"{raw.rejects[0].source}: {raw.rejects[0].reason}"
        )
    return np.array([frame.t_ns for frame in raw.frames]), np.array([frame.vio_T_cam for frame in raw.frames])


def _matrices(rows: list[list[float]]) -> Array:
    return np.array(rows, dtype=float).reshape(-1, 4, 4)


def _json(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def _json_lines(path: Path) -> list[Any]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
