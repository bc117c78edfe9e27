"""Relative motions of a camera by images and by odometry, and which usual mistake explains where they differ.

Images give the motion from a model or from a pair's essential matrix. What distinguishes the mistakes: a mirrored image
turns and moves as the mirror image of the camera does; a focal length that is too long makes turns too small, by the
same share; images that were swapped among poses move in no relation to them at all.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import ArrayLike

from groundwalk.geometry.fits import fit_robust
from groundwalk.geometry.poses import Array, rotation_angle

# Pairs that turn and move less say nothing about a mistake.
MIN_TURN = np.radians(4.0)
MIN_STEP_M = 0.25
# A pair is explained where its turn agrees to this angle and fraction, its direction to this angle, and its length,
# against the median one, to this factor: wide enough for a focal length that is off by a fifth.
_TURN, _TURN_FRACTION = np.radians(2.0), 0.25
_DIRECTION = np.radians(35.0)
_LENGTH = 1.6
_MIN_PAIRS = 8
# A mistake is the cause where it explains at least this fraction of pairs, and so much more than no mistake does.
_MIN_EXPLAINED, _MIN_ADVANTAGE = 0.5, 0.2
# Larger turns say little about the focal length: the images hardly overlap.
_MAX_TURN = np.radians(60.0)
_GAIN_FLOOR = np.radians(0.1)

MIRRORED, UPSIDE_DOWN, UNRELATED = "mirrored", "upside down", "unrelated"
MISTAKE_REASONS = {
    MIRRORED: "images turn and move as VIO does in a mirror: they are mirrored left to right",
    UPSIDE_DOWN: "images turn and move as VIO does in a mirror: they are mirrored upside down",
    UNRELATED: "images move in no relation to VIO: they don't belong to these poses",
}
_NOT_MIRRORED = "export the session's images as the camera saw them, not mirrored; or leave the session out"
MISTAKE_ADVICE = {
    MIRRORED: _NOT_MIRRORED,
    UPSIDE_DOWN: _NOT_MIRRORED,
    UNRELATED: "check that the session's images and poses are of one recording, and in the same order; or leave the "
    "session out",
}
_MIRRORS = {MIRRORED: np.diag([-1.0, 1.0, 1.0]), UPSIDE_DOWN: np.diag([1.0, -1.0, 1.0])}


@dataclass(frozen=True)
class MotionAgreement:
    """Which pairs (P,) `agree`, or move too little to tell. Of the other `pairs`, the fractions that odometry explains:
    as it is (`explained`), and as each mirror image. `turn_gain`: the camera's turn about its x and y axes by images,
    over that by odometry; with a focal length that is off by a factor, about 1 over it. `turn_gain_sd`: its standard
    error. NaN where too few pairs turn."""

    agree: np.ndarray
    pairs: int
    explained: float
    mirrors: dict[str, float]
    turn_gain: float
    turn_gain_sd: float

    @property
    def mistake(self) -> str | None:
        """MIRRORED or UPSIDE_DOWN where that explains most pairs, UNRELATED where nothing does; None where odometry
        explains most as it is, or there are too few pairs. `MISTAKE_REASONS` says what each shows in."""
        if self.pairs < _MIN_PAIRS:
            return None
        name, fraction = max(self.mirrors.items(), key=lambda item: item[1])
        if fraction >= _MIN_EXPLAINED and fraction >= self.explained + _MIN_ADVANTAGE:
            return name
        return UNRELATED if self.explained < _MIN_EXPLAINED else None


def compare_motions(a_T_b_images: ArrayLike, a_T_b_vio: ArrayLike, *, common_scale: bool) -> MotionAgreement:
    """Compare relative poses (P, 4, 4) of the same pairs of cameras, by images and by odometry (metres).

    The images' translations have one unknown scale (`common_scale`), as those of a model, or one each, as those of
    essential matrices.
    """
    images, vio = np.asarray(a_T_b_images, dtype=float), np.asarray(a_T_b_vio, dtype=float)
    turn, step = rotation_angle(vio[:, :3, :3]), np.linalg.norm(vio[:, :3, 3], axis=1)
    informative = (turn >= MIN_TURN) | (step >= MIN_STEP_M)
    images, vio = images[informative], vio[informative]
    agree = np.ones(len(informative), dtype=bool)
    if not len(vio):
        nothing = {name: float("nan") for name in _MIRRORS}
        return MotionAgreement(agree, 0, float("nan"), nothing, float("nan"), float("nan"))
    agree[informative] = explained = _explained(images, vio, common_scale)
    mirrors = {}
    for name, mirror in _MIRRORS.items():
        mirrored = vio.copy()
        mirrored[:, :3, :3] = mirror @ vio[:, :3, :3] @ mirror
        mirrored[:, :3, 3] = vio[:, :3, 3] @ mirror
        mirrors[name] = float(np.mean(_explained(images, mirrored, common_scale)))
    gain = _turn_gain(images[explained], vio[explained])
    return MotionAgreement(agree, len(vio), float(np.mean(explained)), mirrors, *gain)


def _explained(images: Array, vio: Array, common_scale: bool) -> np.ndarray:
    """(P,) pairs whose motions agree."""
    difference = rotation_angle(np.swapaxes(vio[:, :3, :3], 1, 2) @ images[:, :3, :3])
    agree = difference <= _TURN + _TURN_FRACTION * rotation_angle(vio[:, :3, :3])
    length, vio_m = np.linalg.norm(images[:, :3, 3], axis=1), np.linalg.norm(vio[:, :3, 3], axis=1)
    moved = vio_m >= MIN_STEP_M
    cosine = np.sum(images[:, :3, 3] * vio[:, :3, 3], axis=1) / np.maximum(length * vio_m, 1e-12)
    agree &= ~moved | (cosine >= np.cos(_DIRECTION))
    if common_scale and moved.any():
        ratio = np.log(np.maximum(length[moved], 1e-12) / vio_m[moved])
        agree[moved] &= np.abs(ratio - np.median(ratio)) <= np.log(_LENGTH)
    return agree


def _turn_gain(images: Array, vio: Array) -> tuple[float, float]:
    """Slope of the images' turns about the camera's x and y axes on odometry's, and its standard error."""
    by_vio = scipy.spatial.transform.Rotation.from_matrix(vio[:, :3, :3]).as_rotvec()[:, :2]
    by_images = scipy.spatial.transform.Rotation.from_matrix(images[:, :3, :3]).as_rotvec()[:, :2]
    size = np.linalg.norm(by_vio, axis=1)
    informative = (size >= MIN_TURN) & (size <= _MAX_TURN)
    by_vio, by_images, size = by_vio[informative], by_images[informative], size[informative]
    if len(by_vio) < _MIN_PAIRS:
        return float("nan"), float("nan")

    def fit(weights: Array) -> float:
        return float(np.sum(weights * np.sum(by_vio * by_images, axis=1)) / np.sum(weights * size**2))

    gain, weights = fit_robust(
        fit, lambda k: np.linalg.norm(by_images - k * by_vio, axis=1), len(by_vio), floor=float(_GAIN_FLOOR)
    )
    residual = np.sum((by_images - gain * by_vio) ** 2, axis=1) / 2
    variance = np.sum((weights * size) ** 2 * residual) / np.sum(weights * size**2) ** 2
    return gain, float(np.sqrt(variance))
