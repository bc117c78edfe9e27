"""Features of an image as checkpoints, and parts of them."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from groundwalk.features.sift import Features
from groundwalk.store.files import written_aside


def keep_features(path: Path, features: Features) -> None:
    """Write features as a checkpoint."""
    with written_aside(path) as partial, partial.open("wb") as file:
        np.savez(file, px=features.px, size_px=features.size_px, descriptors=features.descriptors)


def load_features(path: Path) -> Features:
    """The features of a checkpoint."""
    with np.load(path) as kept:
        return Features(kept["px"], kept["size_px"], kept["descriptors"])


def unit(descriptors: NDArray[np.generic]) -> NDArray[np.float32]:
    """Descriptors (..., D) at unit length."""
    floats = np.asarray(descriptors, np.float32)
    return np.asarray(floats / np.maximum(np.linalg.norm(floats, axis=-1, keepdims=True), 1e-9), np.float32)
