"""What an epoch goes over: training images, or features of a frozen backbone, computed once and kept in a file."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from groundwalk.geometry.poses import Array
from groundwalk.store.child import Report
from groundwalk.store.files import written_aside
from groundwalk.training import processes
from groundwalk.training.data import Frames, View, jittered, normalised, pose_batch
from groundwalk.training.models.regressor import FrozenRegressor, PoseRegressor
from groundwalk.training.poses import PoseBatch
from groundwalk.training.predict import errors, pose_errors
from groundwalk.training.regressor_settings import Jitter, RegressorSettings, Turn
from groundwalk.training.steps import Precision

COPIES = 20  # turned and re-coloured ones of each training image
_BATCH = 32
_FIT_ROWS = 2000  # features are whitened by so many rows at most
_REDUCED_ROWS = 512  # at once


@dataclass(frozen=True)
class Run:
    """Which model is trained, where and how exactly."""

    title: str
    settings: RegressorSettings
    device: torch.device
    precision: Precision
    view: View
    seed: int
    folder: Path
    checkpoint_s: float = 60.0
    """least time between two checkpoints"""
    unit: str = "m"
    """of lengths, in words for the user"""


def augmented(
    frames: Frames, run: Run, turn_deg: Turn | None, jitter: Jitter, rng: Generator, part: slice = slice(None)
) -> tuple[Tensor, PoseBatch]:
    """Training crops of a part of the frames, re-coloured and normalised, and their poses. Random numbers are drawn for
    all frames, so that a frame's are the same whatever the part."""
    image, poses = frames.training_crops(run.view, turn_deg, rng, run.device, part)
    image = jittered(image, jitter, rng, len(frames), part)
    return normalised(image).contiguous(memory_format=torch.channels_last), poses


class ImageSource:
    """Training images, cropped, turned and re-coloured anew in every epoch."""

    def __init__(self, model: PoseRegressor, training: Frames, held_out: Frames, run: Run) -> None:
        self.model, self.training, self.held_out, self.run = model, training, held_out, run
        self.scene_N = training.scene_N

    def batch(self, rows: NDArray[np.int64], rng: Generator) -> tuple[Tensor, PoseBatch]:
        """What the loss of this process's share of some rows is computed from (see `gradient_step`), and the true
        poses."""
        recipe, training = self.run.settings.training, self.training.select(rows)
        return augmented(training, self.run, recipe.turn_deg, recipe.jitter, rng, processes.share())

    def errors(self) -> tuple[Array, Array]:
        """Position (m) and rotation errors (deg) on the held-out frames."""
        return pose_errors(self.model, self.held_out, self.run.view, self.run.device)


class FeatureSource:
    """Features of each training image and of its turned and re-coloured copies, reduced once: row c * N + i is copy c
    of frame i, copy 0 the image itself. `resumed`: the model knows already how they are reduced."""

    @torch.no_grad()
    def __init__(
        self, report: Report, model: FrozenRegressor, training: Frames, held_out: Frames, run: Run, resumed: bool
    ) -> None:
        self.model, self.training, self.held_out, self.run = model, training, held_out, run
        self.scene_N = np.tile(training.scene_N, COPIES + 1)
        with processes.first_alone():
            features, self.quaternion_M4 = feature_cache(model, training, run, report)
        model.eval()
        if not resumed:
            rows = np.linspace(0, len(features) - 1, min(len(features), _FIT_ROWS)).astype(np.int64)
            model.fit_features(torch.from_numpy(np.asarray(features[rows])).to(run.device))
        starts = range(0, len(features), _REDUCED_ROWS)
        parts = (torch.from_numpy(np.array(features[start : start + _REDUCED_ROWS])) for start in starts)
        self.reduced = torch.cat([model.reduced(part.to(run.device)).cpu() for part in parts])
        self.held_out_reduced = model.reduced(model.features(held_out.centre_crops(run.view, run.device)))

    def batch(self, rows: NDArray[np.int64], rng: Generator) -> tuple[Tensor, PoseBatch]:
        """As of images."""
        rows = rows[processes.share()]
        frames = rows % len(self.training)
        position, scene = self.training.position_N3[frames], self.training.scene_N[frames]
        poses = pose_batch(position, self.quaternion_M4[rows], scene, self.run.device)
        return self.reduced[torch.from_numpy(rows)].to(self.run.device), poses

    @torch.no_grad()
    def errors(self) -> tuple[Array, Array]:
        """As of images."""
        poses = self.model.eval().answer(self.held_out_reduced)
        return errors(*self.held_out.camera_poses(poses, self.run.view), self.held_out)


@torch.no_grad()
def feature_cache(
    model: FrozenRegressor, training: Frames, run: Run, report: Report
) -> tuple[NDArray[np.float16], Array]:
    """Features (M, ...) of all copies and the quaternions (M, 4) of their poses. They are kept in a folder, where an
    earlier run may have left them; `quaternions.npy` comes last and marks it as whole.

    A copy's randomness comes from (seed, copy).
    """
    folder = run.folder / "features"
    done, kept = folder / "quaternions.npy", folder / "features.npy"
    if not done.exists():
        folder.mkdir(parents=True, exist_ok=True)
        model.eval()
        recipe = run.settings.training
        file = None
        quaternions = []
        for copy in range(COPIES + 1):
            rng = np.random.default_rng([run.seed, copy])
            turn_deg, jitter = (recipe.turn_deg or (0, 0, 0), recipe.jitter) if copy else ((0, 0, 0), (0, 0, 0, 0))
            for start in range(0, len(training), _BATCH):
                rows = np.arange(start, min(start + _BATCH, len(training)))
                image, poses = augmented(training.select(rows), run, turn_deg, jitter, rng)
                features = model.features(image)
                if file is None:
                    shape = ((COPIES + 1) * len(training), *features.shape[1:])
                    file = np.lib.format.open_memmap(kept, "w+", np.float16, shape)
                file[copy * len(training) + rows] = features.half().cpu().numpy()
                quaternions.append(poses.quaternion_B4.cpu().numpy())
            report(0, f"features {copy + 1}/{COPIES + 1}")
        assert file is not None, "there are training frames"
        file.flush()
        with written_aside(done) as partial, partial.open("wb") as out:
            np.save(out, np.concatenate(quaternions).astype(np.float64))
    return np.load(kept, mmap_mode="r"), np.load(done)
