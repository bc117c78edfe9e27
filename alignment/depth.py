"""A depth sensor against the map, at the points of SfM; its depth gives nothing to the map.

Depth images are as import has them: 16-bit PNG, millimetres along the camera's z axis, with the field of view of the
image; their confidence is 0, 1, 2 or 0, 127, 255.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from urllib.parse import unquote

import cv2
import numpy as np
import pandas as pd
import pycolmap

from groundwalk.alignment.components import PlacedComponent
from groundwalk.geometry.depth_images import ratio_statistics, sample_depth
from groundwalk.geometry.poses import Array, inverse, transform
from groundwalk.store import UserError
from groundwalk.store.files import sha256_of
from groundwalk.store.schemas import schema
from groundwalk.store.tables import poses_of

# Phones' sensors reach 5 m: beyond, depth is interpolated.
MAX_RANGE_M = 5.0
_BINS_M = (0.0, 0.5, 1.0, 2.0, 3.0, MAX_RANGE_M, np.inf)
HIGH_CONFIDENCE = 2
# A point that two frames see may be a wrong match.
_MIN_TRACK = 3
_COLUMNS = ["session_id", "component", "frame", "map_m", "sensor_m", "confidence"]


def has_depth(frames: pd.DataFrame) -> bool:
    """Some frame has a depth image."""
    return bool(frames["depth"].map(_is_path).any())


def read_depth(path: Path, confidence: Path | None, sha256: str) -> tuple[Array, np.ndarray]:
    """A depth image in metres (H, W), 0 where there is none, and its confidence 0 to 2 (H, W), -1 where unknown.
    UserError where it isn't the file that import saw, of which `sha256` is the hash."""
    if not path.is_file() or sha256_of(path) != sha256:
        raise UserError(
            "a depth image isn't as import saw it",
            where=path,
            found="another sha256 than in import.frames" if path.is_file() else "no such file",
            do="put it back, or import the scene again",
        )
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
    placed: Sequence[PlacedComponent],
    model_folder: Callable[[str], Path],
    image_path: Callable[[str], Path],
) -> pd.DataFrame:
    """Points of SfM's models where frames (import's table) with ground truth (`used`) and depth see them: session_id,
    component, `frame` (row of the frames table), depth by the map and by the sensor in metres, confidence 0 to 2 (-1:
    unknown).

    `images` are SfM's in the order of `frames`; `model_folder` gives the folder of a model's id, `image_path` the file
    of an entry in frames.
    """
    row_of = {f: i for i, f in enumerate(frames["frame_id"]) if used[i] and _is_path(frames["depth"].iloc[i])}
    sfm_T_cam = poses_of(images, "sfm_cam")
    samples = [pd.DataFrame(columns=_COLUMNS)]
    for each in placed if row_of else []:
        model = pycolmap.Reconstruction(model_folder(each.component.model_id))
        points = {i: p.xyz for i, p in model.points3D.items() if p.track.length() >= _MIN_TRACK}
        for image in model.images.values():
            row = row_of.get(unquote(str(Path(image.name).with_suffix(""))))
            seen = [(p.xy, points[p.point3D_id]) for p in image.points2D if p.point3D_id in points]
            if row is None or not seen:
                continue
            xy, xyz = (np.array(column) for column in zip(*seen, strict=True))
            frame = frames.iloc[row]
            levels = image_path(frame["depth_confidence"]) if _is_path(frame["depth_confidence"]) else None
            depth, confidence = read_depth(image_path(frame["depth"]), levels, frame["depth_sha256"])
            sensor_m, nearest = sample_depth(depth, xy, (int(frame["width"]), int(frame["height"])))
            map_m = each.map_S_sfm.scale * transform(inverse(sfm_T_cam[row]), xyz)[:, 2]
            columns = {"frame": row, "map_m": map_m, "sensor_m": sensor_m, "confidence": confidence[tuple(nearest.T)]}
            sample = pd.DataFrame({"session_id": frame["session_id"], "component": each.component.index, **columns})
            samples.append(sample[sample["sensor_m"].notna() & (sample["map_m"] > 0)])
    return pd.concat(samples[1:] or samples, ignore_index=True)


def agreement_table(samples: pd.DataFrame, seed: int) -> pd.DataFrame:
    """The align.depth_agreement table: each session and model by distance and confidence, and within reach in all. A
    ratio above 1 says that the map is too small, or that the sensor measures long."""
    rng = np.random.default_rng(seed)
    rows = []
    for (session_id, component), of_session in samples.groupby(["session_id", "component"]):
        for confidence in (None, *range(HIGH_CONFIDENCE + 1)):
            selected = of_session if confidence is None else of_session[of_session["confidence"] == confidence]
            for near, far in ((0.0, MAX_RANGE_M), *pairwise(_BINS_M)):
                inside = selected[(selected["map_m"] >= near) & (selected["map_m"] < far)]
                if not len(inside):
                    continue
                frame = inside["frame"].to_numpy(np.int64)
                statistics = ratio_statistics((inside["sensor_m"] / inside["map_m"]).to_numpy(float), frame, rng)
                rows.append(
                    {
                        "session_id": session_id,
                        "component": component,
                        "near_m": near,
                        "far_m": far if np.isfinite(far) else None,
                        "confidence": confidence,
                        "frames": len(np.unique(frame)),
                        "samples": len(inside),
                        "median_ratio": statistics.median,
                        "mad": statistics.mad,
                        "median_ratio_se": statistics.se,
                    }
                )
    table = pd.DataFrame(rows, columns=schema("align", "depth_agreement").column_names)
    return table.astype({"confidence": "Int64", "far_m": float})


def _is_path(entry: object) -> bool:
    return isinstance(entry, str) and bool(entry)
