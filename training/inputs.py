"""The frames that a run trains on and predicts, gathered from the scene or from a group's scenes."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from artefacts import StageRun, UserError
from artefacts.tables import poses_of
from geometry.poses import tq_from_pose
from training.data import Frames, ImageCache
from training.settings import TrainSettings


def read_frames(r: StageRun[TrainSettings]) -> pd.DataFrame:
    """Every frame of the run's scenes: import.frames with the ground truth of align and its quality class (null where
    there is none), the scene's name and its index. Held-out frames are marked `val` in every scene."""
    tables = []
    for index, scene in enumerate(r.leaves):
        frames = r.dataset_frames(scene)
        truth = r.read("align", "ground_truth", scene=scene)
        pose_columns = [c for c in truth.columns if c.startswith("map_cam_")]
        frames = frames.merge(truth[["frame_id", "quality", *pose_columns]], on="frame_id", how="left", validate="1:1")
        frames.insert(0, "scene", scene)
        frames.insert(1, "scene_index", index)
        frames["split"] = hold_out(frames, r.settings.val_fraction)
        tables.append(frames.sort_values(["session_id", "t_ns"]))
    return pd.concat(tables, ignore_index=True)


def hold_out(frames: pd.DataFrame, fraction: float) -> "pd.Series[str]":
    """The frames' splits, with a block from the middle of each training session held out as `val` where none is.

    A block, since neighbours in time look nearly the same and would make every epoch look good.
    """
    split = frames["split"].copy()
    trainable = frames[(split == "train") & frames["map_cam_tx"].notna()]
    if (split == "val").any() or len(trainable) < 2:
        return split
    for _, session in trainable.sort_values("t_ns").groupby("session_id"):
        count = round(fraction * len(session))
        start = (len(session) - count) // 2
        split[session.index[start : start + count]] = "val"
    if not (split == "val").any():  # sessions too short for a block of their own
        split[trainable.sort_values("t_ns").index[-1]] = "val"
    return split


def rows_with_truth(frames: pd.DataFrame, split: str) -> NDArray[np.int64]:
    """Row numbers of the frames of a split that have ground truth."""
    return np.flatnonzero((frames["split"] == split) & frames["map_cam_tx"].notna())


def check_trainable(frames: pd.DataFrame, where: Path) -> None:
    """UserError where a scene has nothing to train on or nothing to choose an epoch by."""
    for scene, mine in frames.groupby("scene"):
        counts = {split: len(rows_with_truth(mine, split)) for split in ("train", "val")}
        if counts["train"] < 2 or counts["val"] < 1:
            raise UserError(
                f"scene {scene} has too few frames to train on",
                where=where,
                expected="two or more frames of split train with ground truth, and one of val",
                found=f"{counts['train']} and {counts['val']}, of {len(mine)} frames",
                do="check the scene's split rules, and what align says about its ground truth",
            )


def image_paths(r: StageRun[TrainSettings], frames: pd.DataFrame) -> Iterator[Path]:
    """The frames' image files, in order, with progress."""
    pairs = zip(frames["image"], frames["scene"], strict=True)
    for image, scene in r.track(pairs, "reading images", len(frames)):
        yield r.image_path(image, scene=scene)


def as_training_frames(frames: pd.DataFrame, cache: ImageCache) -> Frames:
    """The table as arrays, row i's image being cache[i]; a frame without ground truth has NaN there."""
    K = np.zeros((len(frames), 3, 3))
    scale_N2 = cache.shapes[:, ::-1] / frames[["width", "height"]].to_numpy(float)
    K[:, [0, 1], [0, 1]] = frames[["fx", "fy"]].to_numpy(float) * scale_N2
    K[:, [0, 1], [2, 2]] = frames[["cx", "cy"]].to_numpy(float) * scale_N2
    K[:, 2, 2] = 1
    position, quaternion = np.full((len(frames), 3), np.nan), np.full((len(frames), 4), np.nan)
    map_T_cam: Any = poses_of(frames, "map_cam")
    known = np.isfinite(map_T_cam).all(axis=(1, 2))
    if known.any():
        position[known], quaternion[known] = tq_from_pose(map_T_cam[known])
    scene = frames["scene_index"].to_numpy(np.int64)
    return Frames(cache, np.arange(len(frames)), K, position, quaternion, scene)
