"""The frames that a run trains on and predicts, gathered from the scene or from a group's scenes."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array, tq_from_pose
from groundwalk.store import StageRun, UserError
from groundwalk.store.images import Image, read_image
from groundwalk.store.resizing import pinhole_image, small_image
from groundwalk.store.tables import camera_of, poses_of, with_cameras
from groundwalk.training.data import Frames, ImageCache
from groundwalk.training.settings import TrainSettings

TrainRun = StageRun[TrainSettings]
_NARROW = 1.1
_HELD_OUT = 0.1  # share of each training session, where import marked none


def read_frames(r: TrainRun) -> pd.DataFrame:
    """Every frame of the run's scenes: import.frames with the ground truth of align, its quality class (null where
    there is none) and its cameras, the scene's name and its index. Held-out frames are marked `val` in every scene."""
    tables = []
    for index, scene in enumerate(r.leaves):
        frames = r.dataset_frames(scene)
        truth = r.read("align", "ground_truth", scene=scene)
        pose_columns = [c for c in truth.columns if c.startswith("map_cam_")]
        frames = with_cameras(frames, truth).merge(
            truth[["frame_id", "quality", *pose_columns]], on="frame_id", how="left", validate="1:1"
        )
        frames.insert(0, "scene", scene)
        frames.insert(1, "scene_index", index)
        frames["split"] = hold_out(frames)
        tables.append(frames.sort_values(["session_id", "t_ns"]))
    return pd.concat(tables, ignore_index=True)


def hold_out(frames: pd.DataFrame) -> "pd.Series[str]":
    """The frames' splits, with a block from the middle of each training session held out as `val` where none is.

    A block, since neighbours in time look nearly the same and would make every epoch look good.
    """
    split = frames["split"].copy()
    trainable = frames[(split == "train") & frames["map_cam_tx"].notna()]
    if (split == "val").any() or len(trainable) < 2:
        return split
    for _, session in trainable.sort_values("t_ns").groupby("session_id"):
        count = round(_HELD_OUT * len(session))
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


def virtual_focal(frames: pd.DataFrame) -> float:
    """The focal length of the virtual pinhole of all frames, in shorter sides: the median of those trained on."""
    return float(np.median(_in_short_sides(frames.iloc[rows_with_truth(frames, "train")])))


def _in_short_sides(frames: pd.DataFrame) -> Array:
    """Focal lengths (N,)."""
    sides = frames[["width", "height"]].to_numpy(float).min(axis=1)
    return np.asarray(frames[["fx", "fy"]].to_numpy(float).mean(axis=1) / sides)


def warn_of_borders(r: TrainRun, frames: pd.DataFrame, focal: float) -> None:
    """Say how many images show much less than the virtual pinhole sees."""
    if narrow := int((_in_short_sides(frames) > _NARROW * focal).sum()):
        r.say(
            f"warning: {narrow} of {len(frames)} images have focal lengths over {_NARROW} times the virtual pinhole's: "
            "what it sees beyond them is their border, repeated"
        )


def small_images(r: TrainRun, frames: pd.DataFrame, focal: float | None, short_side: int) -> Iterator[Image]:
    """The frames' images with so many pixels on the shorter side, in order, with progress: the virtual pinhole's, or
    without `focal` as captured.

    UserError for an image that isn't there or can't be decoded.
    """
    rows = zip(frames["image"], frames["scene"], frames.itertuples(index=False), strict=True)
    for path, scene, frame in r.track(rows, "reading images", len(frames)):
        image = read_image(r.image_path(path, scene=scene))
        if focal is None:
            yield small_image(image, short_side)
        else:
            yield pinhole_image(image, camera_of(frame), short_side, focal)


def as_training_frames(frames: pd.DataFrame, cache: ImageCache, focal: float | None) -> Frames:
    """The table as arrays, row i's image being cache[i]; a frame without ground truth has NaN there.

    `focal` is that of the virtual pinhole, None where the images are as captured.
    """
    size = cache.shapes[:, ::-1].astype(float)
    if focal is None:
        by = size / frames[["width", "height"]].to_numpy(float)
        focal_px, centre = frames[["fx", "fy"]].to_numpy(float) * by, frames[["cx", "cy"]].to_numpy(float) * by
    else:
        focal_px, centre = focal * size.min(axis=1, keepdims=True), size / 2
    K = np.tile(np.eye(3), (len(frames), 1, 1))
    K[:, [0, 1], [0, 1]], K[:, [0, 1], [2, 2]] = focal_px, centre
    position, quaternion = np.full((len(frames), 3), np.nan), np.full((len(frames), 4), np.nan)
    map_T_cam: Any = poses_of(frames, "map_cam")
    known = np.isfinite(map_T_cam).all(axis=(1, 2))
    if known.any():
        position[known], quaternion[known] = tq_from_pose(map_T_cam[known])
    scene = frames["scene_index"].to_numpy(np.int64)
    gravity = frames[["gravity_x", "gravity_y", "gravity_z"]].to_numpy(float, copy=True)
    return Frames(cache, np.arange(len(frames)), K, position, quaternion, scene, gravity)
