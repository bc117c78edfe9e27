"""Errors of a regressor's poses, and the answer that any regressor has to beat."""

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from groundwalk.geometry.averages import quaternion_mean
from groundwalk.geometry.poses import quaternion_angle
from groundwalk.training.data import Frames, View
from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.poses import PoseBatch

_BATCH = 64


def pose_errors(
    model: PoseRegressor, frames: Frames, view: View, device: torch.device
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
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


def errors(
    position_N3: NDArray[np.float64], quaternion_N4: NDArray[np.float64], frames: Frames
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Distances (m) and angles (deg) between given poses and the frames' own."""
    distance = np.linalg.norm(position_N3 - frames.position_N3, axis=1)
    return distance, np.degrees(quaternion_angle(quaternion_N4, frames.quaternion_N4))


def mean_pose_errors(training: Frames, tested: Frames) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Errors of always answering the mean position and mean rotation (Gramkow's) of the training frames."""
    means = training.position_N3.mean(axis=0), quaternion_mean(training.quaternion_N4)
    position, quaternion = (np.tile(mean, (len(tested), 1)) for mean in means)
    return errors(position, quaternion, tested)
