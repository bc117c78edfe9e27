"""Poses of frames by a regressor, in batches or one at a time as a phone would ask for them; their errors, and the
answer that any regressor has to beat."""

import time
from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from groundwalk.geometry.averages import quaternion_mean
from groundwalk.geometry.poses import Array, pose_from_tq, quaternion_angle
from groundwalk.store.tables import pose_frame
from groundwalk.training.data import Frames, View
from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.poses import PoseBatch

_BATCH = 64
_WARM_UP = 5  # runs before timing: the first ones choose kernels and allocate


def pose_errors(model: PoseRegressor, frames: Frames, view: View, device: torch.device) -> tuple[Array, Array]:
    """Position errors (m) and rotation errors (deg) of the model on centre crops, one a frame."""
    return errors(*frames.camera_poses(answers(model, frames, view, device), view), frames)


@torch.no_grad()
def answers(model: PoseRegressor, frames: Frames, view: View, device: torch.device) -> PoseBatch:
    """The model's poses of centre crops, of the cameras that it sees."""
    model.eval()
    parts = []
    for start in range(0, len(frames), _BATCH):
        rows = np.arange(start, min(start + _BATCH, len(frames)))
        parts.append(model(frames.select(rows).centre_crops(view, device)))
    columns: list[Any] = [None if part[0] is None else torch.cat(part) for part in zip(*parts, strict=True)]
    return PoseBatch(*columns)


def errors(position_N3: Array, quaternion_N4: Array, frames: Frames) -> tuple[Array, Array]:
    """Distances (m) and angles (deg) between given poses and the frames' own."""
    distance = np.linalg.norm(position_N3 - frames.position_N3, axis=1)
    return distance, np.degrees(quaternion_angle(quaternion_N4, frames.quaternion_N4))


def mean_pose_errors(training: Frames, tested: Frames) -> tuple[Array, Array]:
    """Errors of always answering the mean position and mean rotation (Gramkow's) of the training frames."""
    means = training.position_N3.mean(axis=0), quaternion_mean(training.quaternion_N4)
    position, quaternion = (np.tile(mean, (len(tested), 1)) for mean in means)
    return errors(position, quaternion, tested)


@torch.inference_mode()
def predict(
    model: PoseRegressor, frames: Frames, scenes: list[str], view: View, device: torch.device, order: Iterable[int]
) -> pd.DataFrame:
    """Predictions of the rows in `order` (all rows, in order, perhaps wrapped in progress): map_cam_*,
    picked_scene, covariance, inference_ms. ValueError where a pose isn't finite."""
    model.eval().to(device)
    position: list[Array] = []
    quaternion: list[Array] = []
    covariance: list[list[float] | None] = []
    scene, milliseconds = [], []
    for row in order:
        frame = frames.select(np.array([row]))
        image = frame.centre_crops(view, device)
        for _ in range(0 if position else _WARM_UP):
            model(image)
        _wait(device)
        start = time.perf_counter()
        poses = model(image)
        _wait(device)
        milliseconds.append((time.perf_counter() - start) * 1e3)
        for parts, of_frame in zip((position, quaternion), frame.camera_poses(poses, view), strict=True):
            parts.append(of_frame[0])
        covariance.append(None if poses.covariance_B66 is None else _symmetric(poses.covariance_B66[0]))
        scene.append(scenes[int(poses.scene_B[0])])
    finite = np.asarray(np.isfinite(np.hstack([position, quaternion])).all(axis=1))
    if not finite.all():
        raise ValueError(f"{int((~finite).sum())} of {len(finite)} predictions aren't finite")
    table = pose_frame("map_cam", pose_from_tq(np.array(position), np.array(quaternion)))
    return table.assign(picked_scene=scene, covariance=pd.Series(covariance, dtype=object), inference_ms=milliseconds)


def _symmetric(covariance_66: Tensor) -> list[float]:
    """The matrix's numbers; single precision leaves it unsymmetric enough to be refused by who reads it."""
    as_double = covariance_66.double().cpu()
    return ((as_double + as_double.T) / 2).flatten().tolist()


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
