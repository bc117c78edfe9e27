"""SIFT features of an image, the same for the map and for queries.

SIFT (Lowe, IJCV 2004) by OpenCV, as RootSIFT (Arandjelović and Zisserman, "Three things everyone should know to improve
object retrieval", CVPR 2012) in bytes.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.artefacts.files import written_aside

DESCRIPTOR_SIZE = 128
_LENGTH = 512.0


@dataclass(frozen=True)
class Features:
    """K keypoints: px (K, 2) of the full image, the first pixel's centre at (0.5, 0.5); their diameters (K,), px; their
    descriptors (K, D): RootSIFT's 128 bytes are of length 512, others' numbers of length 1."""

    px: NDArray[np.float32]
    size_px: NDArray[np.float32]
    descriptors: NDArray[Any]

    def __len__(self) -> int:
        return len(self.px)


def keep_features(path: Path, features: Features) -> None:
    """Write features as a checkpoint."""
    with written_aside(path) as partial, partial.open("wb") as file:
        np.savez(file, px=features.px, size_px=features.size_px, descriptors=features.descriptors)


def load_features(path: Path) -> Features:
    """The features of a checkpoint."""
    with np.load(path) as kept:
        return Features(kept["px"], kept["size_px"], kept["descriptors"])


def extract(grey: NDArray[np.uint8], max_features: int, max_side: int) -> Features:
    """Features of a grey image (H, W), which is first shrunk to at most `max_side` pixels a side; the strongest
    ones."""
    small, scale = shrunk(grey, max_side)
    sift = cv2.SIFT.create(nfeatures=max_features, enable_precise_upscale=True)
    keypoints, sift_rows = sift.detectAndCompute(small, None)
    if not keypoints:
        nothing = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
        return Features(*nothing, np.zeros((0, DESCRIPTOR_SIZE), np.uint8))
    # Strongest first, so that a prefix is what fewer features would have been.
    order = np.argsort([-k.response for k in keypoints], kind="stable")[:max_features]
    px = (np.array([k.pt for k in keypoints])[order] + 0.5) * scale
    size = np.array([k.size for k in keypoints])[order] * scale.mean()
    return Features(px.astype(np.float32), size.astype(np.float32), root_sift(np.asarray(sift_rows, np.float32)[order]))


def shrunk(grey: NDArray[np.uint8], max_side: int) -> tuple[NDArray[np.uint8], NDArray[np.float64]]:
    """A grey image (H, W) with at most `max_side` pixels a side, and how many pixels of the image one of it is, (2,), x
    and y."""
    factor = min(1.0, max_side / max(grey.shape))
    small = grey
    if factor < 1:
        width, height = (round(side * factor) for side in (grey.shape[1], grey.shape[0]))
        small = np.asarray(cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
    return small, np.array([grey.shape[1] / small.shape[1], grey.shape[0] / small.shape[0]])


def strongest(features: Features, count: int) -> Features:
    """The `count` strongest of features in order of strength."""
    return Features(features.px[:count], features.size_px[:count], features.descriptors[:count])


def root_sift(sift_K128: NDArray[np.float32]) -> NDArray[np.uint8]:
    """RootSIFT descriptors (K, 128) of length 512 in bytes."""
    sums = np.maximum(sift_K128.sum(axis=1, keepdims=True), 1e-9)
    return np.minimum(np.rint(_LENGTH * np.sqrt(sift_K128 / sums)), 255).astype(np.uint8)


def unit(descriptors: NDArray[np.generic]) -> NDArray[np.float32]:
    """Descriptors (..., D) at unit length."""
    floats = np.asarray(descriptors, np.float32)
    return np.asarray(floats / np.maximum(np.linalg.norm(floats, axis=-1, keepdims=True), 1e-9), np.float32)
