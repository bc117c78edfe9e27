"""Do images and odometry tell the same relative motions of a camera, and if not, which usual mistake is it?

Images give the motion from a model or from a pair's essential matrix. What distinguishes the mistakes: a mirrored image
turns and moves as the mirror image of the camera does; a focal length that is too long makes turns too small, by the
same share; images that were swapped among poses move in no relation to them at all.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from groundwalk.geometry.fits import fit_robust
from groundwalk.geometry.poses import Array, rotation_angle

# Pairs that turn or move less tell nothing.
LEAST_TURN = np.radians(4.0)
LEAST_STEP_M = 0.25
# A pair is explained where its turn agrees to this angle and share, its direction to this angle, and its length,
# against the usual one, to this factor: wide enough for a focal length that is off by a fifth.
_TURN, _TURN_SHARE = np.radians(2.0), 0.25
_DIRECTION = np.radians(35.0)
_LENGTH = 1.6
_FEWEST_PAIRS = 8
# A mistake is taken for the cause where it explains most pairs, and clearly more than no mistake does.
_CLEARLY, _HALF = 0.2, 0.5
# Turns beyond this from one frame to the other say little about the focal length: images hardly overlap.
_MOST_TURN = np.radians(60.0)
_GAIN_FLOOR = np.radians(0.1)

MIRRORED, UPSIDE_DOWN, UNRELATED = "mirrored", "upside down", "unrelated"
# What each mistake is called, and what it shows in.
MISTAKES = {
    MIRRORED: ("mirrored images", "images turn and move as VIO does in a mirror: they are mirrored left to right"),
    UPSIDE_DOWN: ("mirrored images", "images turn and move as VIO does in a mirror: they are mirrored upside down"),
    UNRELATED: ("times shuffled", "images move in no relation to VIO: they don't belong to these poses"),
}
_MIRRORS = {MIRRORED: np.diag([-1.0, 1.0, 1.0]), UPSIDE_DOWN: np.diag([1.0, -1.0, 1.0])}


@dataclass(frozen=True)
class MotionAgreement:
    """Which pairs (P,) `agree`, or tell nothing. `pairs` that tell something, and the shares of them, 0 to 1, that
    odometry explains: as it is, and as each mirror image. `turn_gain`: how far images say the camera turned about its x
    and y axes, by odometry's turn; with a focal length that is off by a factor, about 1 over it. `turn_gain_sd`: one
    sigma of it. NaN where too few pairs turn."""

    agree: np.ndarray
    pairs: int
    explained: float
    mirrors: dict[str, float]
    turn_gain: float
    turn_gain_sd: float

    @property
    def mistake(self) -> str | None:
        """MIRRORED or UPSIDE_DOWN where that explains most pairs, UNRELATED where nothing does; None where odometry
        explains most as it is, or too few pairs tell. `MISTAKES` has their names."""
        if self.pairs < _FEWEST_PAIRS:
            return None
        name, share = max(self.mirrors.items(), key=lambda item: item[1])
        if share >= _HALF and share >= self.explained + _CLEARLY:
            return name
        return UNRELATED if self.explained < _HALF else None


def compare_motions(a_T_b_images: ArrayLike, a_T_b_vio: ArrayLike, *, common_scale: bool) -> MotionAgreement:
    """Compare relative poses (P, 4, 4) of the same pairs of cameras, by images and by odometry (metres).

    The images' translations have one unknown scale (`common_scale`), as those of a model, or one each, as those of
    essential matrices.
    """
    images, vio = np.asarray(a_T_b_images, dtype=float), np.asarray(a_T_b_vio, dtype=float)
    turn, step = rotation_angle(vio[:, :3, :3]), np.linalg.norm(vio[:, :3, 3], axis=1)
    telling = (turn >= LEAST_TURN) | (step >= LEAST_STEP_M)
    images, vio = images[telling], vio[telling]
    agree = np.ones(len(telling), dtype=bool)
    if not len(vio):
        nothing = {name: float("nan") for name in _MIRRORS}
        return MotionAgreement(agree, 0, float("nan"), nothing, float("nan"), float("nan"))
    agree[telling] = explained = _explained(images, vio, common_scale)
    mirrors = {}
    for name, mirror in _MIRRORS.items():
        seen = vio.copy()
        seen[:, :3, :3] = mirror @ vio[:, :3, :3] @ mirror
        seen[:, :3, 3] = vio[:, :3, 3] @ mirror
        mirrors[name] = float(np.mean(_explained(images, seen, common_scale)))
    return MotionAgreement(
        agree, len(vio), float(np.mean(explained)), mirrors, *_turn_gain(images[explained], vio[explained])
    )


def _explained(images: Array, vio: Array, common_scale: bool) -> np.ndarray:
    """(P,) pairs whose motions agree."""
    left = rotation_angle(np.swapaxes(vio[:, :3, :3], 1, 2) @ images[:, :3, :3])
    agree = left <= _TURN + _TURN_SHARE * rotation_angle(vio[:, :3, :3])
    length, true = np.linalg.norm(images[:, :3, 3], axis=1), np.linalg.norm(vio[:, :3, 3], axis=1)
    moved = true >= LEAST_STEP_M
    cosine = np.sum(images[:, :3, 3] * vio[:, :3, 3], axis=1) / np.maximum(length * true, 1e-12)
    agree &= ~moved | (cosine >= np.cos(_DIRECTION))
    if common_scale and moved.any():
        ratio = np.log(np.maximum(length[moved], 1e-12) / true[moved])
        agree[moved] &= np.abs(ratio - np.median(ratio)) <= np.log(_LENGTH)
    return agree


def _turn_gain(images: Array, vio: Array) -> tuple[float, float]:
    """Slope of the images' turns about the camera's x and y axes on odometry's, and its sigma."""
    turned = Rotation.from_matrix(vio[:, :3, :3]).as_rotvec()[:, :2]
    seen = Rotation.from_matrix(images[:, :3, :3]).as_rotvec()[:, :2]
    size = np.linalg.norm(turned, axis=1)
    telling = (size >= LEAST_TURN) & (size <= _MOST_TURN)
    turned, seen, size = turned[telling], seen[telling], size[telling]
    if len(turned) < _FEWEST_PAIRS:
        return float("nan"), float("nan")

    def fit(weights: Array) -> float:
        return float(np.sum(weights * np.sum(turned * seen, axis=1)) / np.sum(weights * size**2))

    gain, weights = fit_robust(
        fit, lambda k: np.linalg.norm(seen - k * turned, axis=1), len(turned), floor=float(_GAIN_FLOOR)
    )
    left = np.sum((seen - gain * turned) ** 2, axis=1) / 2
    variance = np.sum((weights * size) ** 2 * left) / np.sum(weights * size**2) ** 2
    return gain, float(np.sqrt(variance))
