"""Poses of frames by a trained regressor, one at a time as a phone would ask for them."""

import time
from collections.abc import Iterable

import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from torch import Tensor

from groundwalk.geometry.poses import pose_from_tq
from groundwalk.store.tables import pose_frame
from groundwalk.training.data import Frames, View
from groundwalk.training.models.regressor import PoseRegressor

_WARM_UP = 5  # runs before timing: the first ones choose kernels and allocate


@torch.inference_mode()
def predict(
    model: PoseRegressor, frames: Frames, scenes: list[str], view: View, device: torch.device, order: Iterable[int]
) -> pd.DataFrame:
    """Predictions of the rows in `order` (all rows, in order, perhaps wrapped in progress): map_cam_*,
    picked_scene, covariance, inference_ms. ValueError where a pose isn't finite."""
    model.eval().to(device)
    position: list[NDArray[np.float64]] = []
    quaternion: list[NDArray[np.float64]] = []
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
