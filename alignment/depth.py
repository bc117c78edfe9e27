"""A depth sensor against the map, at the points of SfM; its depth gives nothing to the map.

Depth images are as import has them: 16-bit PNG, millimetres along the camera's z axis, with the field of view of the
image; their confidence is 0, 1, 2 or 0, 127, 255.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
import pandas as pd
import pycolmap

from groundwalk.alignment.components import PlacedComponent
from groundwalk.geometry.depth_images import pixel_rays, ratio_statistics, sample_depth, smooth_pixels
from groundwalk.geometry.poses import Array, inverse, transform
from groundwalk.store import UserError
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of

# Phones' sensors reach 5 m: beyond, depth is interpolated.
MAX_RANGE_M = 5.0
_BINS_M = (0.0, 0.5, 1.0, 2.0, 3.0, MAX_RANGE_M, np.inf)
HIGH_CONFIDENCE = 2
# A point that two frames see may be a wrong match.
_MIN_TRACK = 3
_MAX_CLOUD_POINTS = 60_000


@dataclass(frozen=True)
class DepthSamples:
    """Points of SfM's models that a frame sees where the sensor has depth (N rows): the frame's row in the frames
    table, its session and model, depth by the map and by the sensor in metres, confidence 0 to 2 (-1: unknown)."""

    frame: np.ndarray
    session: np.ndarray
    component: np.ndarray
    map_m: Array
    sensor_m: Array
    confidence: np.ndarray

    @staticmethod
    def empty() -> "DepthSamples":
        """No samples."""
        integers, numbers = np.empty(0, np.int64), np.empty(0)
        return DepthSamples(integers, np.empty(0, str), integers, numbers, numbers, integers)

    @property
    def ratio(self) -> Array:
        """(N,) depth by the sensor over depth by the map: above 1 the map is too small, or the sensor measures long."""
        return self.sensor_m / self.map_m


def read_depth(path: Path, confidence: Path | None) -> tuple[Array, np.ndarray]:
    """A depth image in metres (H, W), 0 where there is none, and its confidence 0 to 2 (H, W), -1 where unknown."""
    millimetres = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if millimetres is None:
        raise UserError("a depth image can't be read", where=path, do="import the scene again")
    levels = None if confidence is None else cv2.imread(str(confidence), cv2.IMREAD_UNCHANGED)
    metres = np.asarray(millimetres, dtype=float) / 1000
    if levels is None:
        return metres, np.full(metres.shape, -1)
    level = np.asarray(levels, dtype=np.int64)
    return metres, np.where(level > HIGH_CONFIDENCE, (level + 1) // 127, level).clip(0, HIGH_CONFIDENCE)


def sample_frames(
    frames: pd.DataFrame,
    images: pd.DataFrame,
    used: np.ndarray,
    placed: list[PlacedComponent],
    model_folder: Callable[[str], Path],
    image_path: Callable[[str], Path],
) -> DepthSamples:
    """Samples of all frames (import's table) with ground truth (`used`) and depth.

    `images` are SfM's in the order of `frames`; `model_folder` gives the folder of a model's id, `image_path` the file
    of an entry in frames.
    """
    row_of = {f: i for i, f in enumerate(frames["frame_id"]) if used[i] and _is_path(frames["depth"].iloc[i])}
    sfm_T_cam = poses_of(images, "sfm_cam")
    parts: list[pd.DataFrame] = []
    for each in placed:
        model = pycolmap.Reconstruction(model_folder(each.component.model_id))
        points = {i: p.xyz for i, p in model.points3D.items() if p.track.length() >= _MIN_TRACK}
        for image in model.images.values():
            row = row_of.get(unquote(str(Path(image.name).with_suffix(""))))
            seen = [(p.xy, points[p.point3D_id]) for p in image.points2D if p.point3D_id in points]
            if row is None or not seen:
                continue
            xy, xyz = (np.array(column) for column in zip(*seen, strict=True))
            depth, confidence = _depth_of(frames.iloc[row], image_path)
            size = (int(frames["width"].iloc[row]), int(frames["height"].iloc[row]))
            sensor_m, nearest = sample_depth(depth, xy, size)
            sample = pd.DataFrame({"sensor_m": sensor_m, "confidence": confidence[nearest[:, 0], nearest[:, 1]]})
            sample["map_m"] = each.map_S_sfm.scale * transform(inverse(sfm_T_cam[row]), xyz)[:, 2]
            sample["frame"], sample["component"] = row, each.component.index
            parts.append(sample[sample["sensor_m"].notna() & (sample["map_m"] > 0)])
    if not parts:
        return DepthSamples.empty()
    samples = pd.concat(parts, ignore_index=True)
    frame = samples["frame"].to_numpy(np.int64)
    return DepthSamples(
        frame,
        frames["session_id"].to_numpy(str)[frame],
        samples["component"].to_numpy(np.int64),
        samples["map_m"].to_numpy(float),
        samples["sensor_m"].to_numpy(float),
        samples["confidence"].to_numpy(np.int64),
    )


def agreement_table(samples: DepthSamples, seed: int) -> pd.DataFrame:
    """The align.depth_agreement table: each session and model by distance and confidence, and within reach in all."""
    rng = np.random.default_rng(seed)
    rows = []
    for session_id, component in sorted(set(zip(samples.session, samples.component.tolist(), strict=True))):
        of_session = (samples.session == session_id) & (samples.component == component)
        for confidence in (None, *range(HIGH_CONFIDENCE + 1)):
            selected = of_session if confidence is None else of_session & (samples.confidence == confidence)
            for near, far in ((0.0, MAX_RANGE_M), *pairwise(_BINS_M)):
                inside = selected & (samples.map_m >= near) & (samples.map_m < far)
                if not inside.any():
                    continue
                statistics = ratio_statistics(samples.ratio[inside], samples.frame[inside], rng)
                rows.append(
                    {
                        "session_id": session_id,
                        "component": component,
                        "near_m": near,
                        "far_m": far if np.isfinite(far) else None,
                        "confidence": confidence,
                        "frames": len(np.unique(samples.frame[inside])),
                        "samples": int(inside.sum()),
                        "median_ratio": statistics.median,
                        "mad": statistics.mad,
                        "median_ratio_se": statistics.se,
                    }
                )
    table = pd.DataFrame(rows, columns=schema("align", "depth_agreement").column_names)
    return table.astype({"confidence": "Int64", "far_m": float})


def depth_clouds(
    frames: pd.DataFrame, map_T_cam: Array, used: np.ndarray, image_path: Callable[[str], Path]
) -> dict[str, Array]:
    """Back-projected depth of each session, points (N, 3) in the map, thinned out; within reach, of high confidence
    where that is stated, and away from edges."""
    rows = [i for i in np.flatnonzero(used) if _is_path(frames["depth"].iloc[i])]
    clouds: dict[str, list[Array]] = {}
    for row in rows:
        frame = frames.iloc[row]
        depth, confidence = _depth_of(frame, image_path)
        step = max(1, int(np.ceil(np.sqrt(depth.size * len(rows) / _MAX_CLOUD_POINTS))))
        pixels, fractions = pixel_rays((depth.shape[0], depth.shape[1]), step)
        i, j = pixels.T
        good = (
            (depth[i, j] < MAX_RANGE_M) & smooth_pixels(depth)[i, j] & np.isin(confidence[i, j], (-1, HIGH_CONFIDENCE))
        )
        matrix = np.array([[frame.fx, 0, frame.cx], [0, frame.fy, frame.cy], [0, 0, 1.0]])
        xy = fractions[good] * [frame.width, frame.height]
        if not len(xy):
            continue
        rays = cv2.undistortPoints(xy[:, None], matrix, np.asarray([*frame.distortion, 0, 0, 0, 0][:8], float))[:, 0]
        cam = np.column_stack([rays, np.ones(len(rays))]) * depth[i, j][good][:, None]
        clouds.setdefault(frame.session_id, []).append(transform(map_T_cam[row], cam))
    return {session_id: np.concatenate(parts) for session_id, parts in clouds.items()}


def has_depth(frames: pd.DataFrame) -> bool:
    """Some frame has a depth image."""
    return bool(frames["depth"].map(_is_path).any())


def _is_path(entry: object) -> bool:
    return isinstance(entry, str) and bool(entry)


def _depth_of(frame: pd.Series, image_path: Callable[[str], Path]) -> tuple[Array, np.ndarray]:
    confidence = frame["depth_confidence"]
    return read_depth(image_path(frame["depth"]), image_path(confidence) if _is_path(confidence) else None)
