"""Features of a frozen backbone: computed once, kept in a file, used in every epoch."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from groundwalk.store.child import Report
from groundwalk.store.files import written_aside
from groundwalk.training.data import Frames, Jitter, Turns, View, normalised, pose_batch
from groundwalk.training.models.regressor import FrozenRegressor
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import RegressorSettings

COPIES = 20  # turned and re-coloured ones of each training image
_BATCH = 32


@dataclass(frozen=True)
class FeatureCache:
    """Features of each training image and of its turned and re-coloured copies: row c * N + i is copy c of frame i,
    copy 0 the image itself. In the file they are float16."""

    features: NDArray[np.floating[Any]]
    quaternion_M4: NDArray[np.float64]
    training: Frames

    @property
    def scene_M(self) -> NDArray[np.int64]:
        """The scene of each row."""
        return np.tile(self.training.scene_N, len(self.quaternion_M4) // len(self.training))

    def rows(self, rows: NDArray[np.int64], device: torch.device) -> tuple[Tensor, PoseBatch]:
        """The features of some rows, and the poses that they are to be given."""
        frames = rows % len(self.training)
        position, scene = self.training.position_N3[frames], self.training.scene_N[frames]
        features = torch.from_numpy(np.asarray(self.features[rows])).to(device)
        return features, pose_batch(position, self.quaternion_M4[rows], scene, device)


@torch.no_grad()
def feature_cache(
    folder: Path,
    model: FrozenRegressor,
    training: Frames,
    view: View,
    settings: RegressorSettings,
    seed: int,
    report: Report,
) -> FeatureCache:
    """Fill `folder`, unless it is there from an earlier run; `quaternions.npy` comes last and marks it as whole.

    A copy's randomness comes from (seed, copy).
    """
    done, kept = folder / "quaternions.npy", folder / "features.npy"
    if not done.exists():
        folder.mkdir(parents=True, exist_ok=True)
        model.eval()
        device = next(model.parameters()).device
        turns, jitter = Turns(*(settings.training.turn_deg or (0, 0, 0))), Jitter(*settings.training.jitter)
        file = None
        quaternions = []
        for copy in range(COPIES + 1):
            rng = np.random.default_rng([seed, copy])
            angles, colours = (turns, jitter) if copy else (Turns(0, 0, 0), Jitter(0, 0, 0, 0))
            for start in range(0, len(training), _BATCH):
                rows = np.arange(start, min(start + _BATCH, len(training)))
                image, poses = training.select(rows).training_crops(view, angles, rng, device)
                image = normalised(colours.apply(image, rng)).contiguous(memory_format=torch.channels_last)
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
    return FeatureCache(np.load(kept, mmap_mode="r"), np.load(done), training)
