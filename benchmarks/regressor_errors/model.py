"""How an absolute pose regressor would have missed on a walk: errors that hang on the place, with heavy tails.

A regressor is wrong in a systematic way: an error changes smoothly as the camera moves and turns. Part of this bias is
the same whenever the scene is seen again from the same place in the same direction, and the rest is a walk's own.
Beside it there is noise that is new in each frame, with some frames far worse than others. How large both are differs
over the map by an order of magnitude: some places are hard.

Sizes (`sizes.toml`) were fitted to Tables II and III, scene by scene: errors and accuracy levels of raw predictions,
over all frames and over those that the paper's rule replaced, and the share that passed its pair check. The fields of
`AprModel` with a default are what no publication says. How repeatable the bias is follows PoseNet, MS-Transformer and
DFNet on chess, fire, office and KingsCollege. Nothing here was measured on a regressor of ours.
"""

import tomllib
import zlib
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array, make_pose

REGRESSORS = ("PN", "MS-T")

_FEATURES = 128
# Each effect has its own stream of random numbers.
_SCALES, _POSITION, _ROTATION, _NOISE = range(4)


def _number(unit: str, meaning: str, low: float = 0.0, high: float = np.inf, default: Any = MISSING) -> Any:
    return field(default=default, metadata={"unit": unit, "meaning": meaning, "range": (low, high)})


@dataclass(frozen=True, kw_only=True)
class AprModel:
    """How large the errors of one regressor in one scene are. The size of errors is log-normal over the map."""

    position_m: float = _number("m", "standard deviation of each horizontal coordinate at a typical place")
    rotation_deg: float = _number("deg", "standard deviation of yaw at a typical place")
    position_spread: float = _number("1", "spread over the map of the logarithm of the position error's size")
    rotation_spread: float = _number("1", "spread over the map of the logarithm of the rotation error's size")
    spread_correlation: float = _number("1", "correlation of the two", -1.0, 1.0)
    position_noise: float = _number("1", "share of the position error's variance that is new in each frame", 0.0, 1.0)
    rotation_noise: float = _number("1", "share of the rotation error's variance that is new in each frame", 0.0, 1.0)
    bias_length_m: float = _number("m", "motion over which bias and sizes change", 0.01)
    bias_length_deg: float = _number("deg", "turn over which they change", 1.0)
    tail: float = _number("1", "degrees of freedom of the noise's Student t", 2.01)
    position_repeatability: float = _number("1", "share of the bias's variance that all walks share", 0.0, 1.0, 0.5)
    rotation_repeatability: float = _number("1", "the same, of the rotation bias", 0.0, 1.0, 0.3)
    noise_follows: float = _number("1", "power of the place's size that the noise has", 0.0, 1.0, 0.5)
    vertical: float = _number("1", "height error against a horizontal axis: phones are held alike", 0.0, np.inf, 0.35)
    tilt: float = _number("1", "pitch error and roll error, each, against yaw", 0.0, np.inf, 0.5)
    largest_m: float = _number("m", "no regressor answers far outside the places it has seen", 0.0, np.inf, 100.0)

    def __post_init__(self) -> None:
        for f in fields(self):
            low, high = f.metadata["range"]
            if not low <= getattr(self, f.name) <= high:
                raise GeometryError(f"APR errors: {f.name} is {getattr(self, f.name)}, expected {low} to {high}")


def apr_seeds(scene: str, regressor: str, draw: int, walk: str) -> tuple[int, int]:
    """The seeds of a regressor and of its noise on a walk. The sizes are matched over these draws, from 0 on."""
    return zlib.crc32(f"{scene}/{regressor}/{draw}".encode()), zlib.crc32(f"{scene}/{regressor}/{draw}/{walk}".encode())


def simulate_apr(
    map_T_cam: ArrayLike, model: AprModel, map_seed: int, noise_seed: int, amplitude: float = 1.0
) -> Array:
    """Predictions (N, 4, 4) for true poses map_T_cam (N, 4, 4), map +y up, OpenCV camera axes.

    `map_seed` is the regressor's and draws the bias that all walks share; `noise_seed` draws the rest, walk by walk.
    `amplitude` multiplies all errors.
    """
    truth = np.asarray(map_T_cam, dtype=float)
    position, rotation = apr_errors(standard_errors(truth, model, map_seed, noise_seed), model)
    wrong = Rotation.from_rotvec(amplitude * rotation).as_matrix()
    return make_pose(wrong @ truth[:, :3, :3], truth[:, :3, 3] + amplitude * position)


@dataclass(frozen=True, eq=False)
class StandardErrors:
    """The random part of the errors on a walk of N frames, of unit variance.

    scales (N, 2): logarithms of sizes of position and rotation, before they are correlated. position and rotation are
    each a bias and a noise, (N, 3) in map axes; rotations are vectors, with yaw in the middle.
    """

    scales: Array
    position: tuple[Array, Array]
    rotation: tuple[Array, Array]


def standard_errors(map_T_cam: Array, model: AprModel, map_seed: int, noise_seed: int) -> StandardErrors:
    """Draw the biases that all walks share and this walk's own at its poses (N, 4, 4), and its noise."""
    look = map_T_cam[:, :3, 2] / np.radians(model.bias_length_deg)
    where = np.hstack([map_T_cam[:, :3, 3] / model.bias_length_m, look])
    rng = np.random.default_rng([noise_seed, _NOISE])
    noise = rng.standard_normal((2, len(where), 3))
    # One factor for both: a blurred picture is bad for position and rotation.
    noise *= np.sqrt((model.tail - 2) / chdtri(model.tail, rng.uniform(size=len(where))))[:, None]

    def bias(which: int, shared: float) -> Array:
        map_bias, walk_bias = (_fields(where, 3, [seed, which]) for seed in (map_seed, noise_seed))
        return np.sqrt(shared) * map_bias + np.sqrt(1 - shared) * walk_bias

    return StandardErrors(
        _fields(where, 2, [map_seed, _SCALES]),
        (bias(_POSITION, model.position_repeatability), noise[0]),
        (bias(_ROTATION, model.rotation_repeatability), noise[1]),
    )


def apr_errors(standard: StandardErrors, model: AprModel) -> tuple[Array, Array]:
    """Position errors in metres and rotation vectors in radians, both (N, 3) in map axes."""
    c = model.spread_correlation
    position_scale = model.position_spread * standard.scales[:, 0]
    rotation_scale = model.rotation_spread * (standard.scales @ [c, np.sqrt(1 - c**2)])
    position = _sized(standard.position, model.position_noise, position_scale, model.position_spread, model)
    rotation = _sized(standard.rotation, model.rotation_noise, rotation_scale, model.rotation_spread, model)
    return (
        _at_most(position * (model.position_m * np.array([1.0, model.vertical, 1.0])), model.largest_m),
        _at_most(rotation * (np.radians(model.rotation_deg) * np.array([model.tilt, 1.0, model.tilt])), np.pi),
    )


def _sized(parts: tuple[Array, Array], noise_share: float, scale: Array, spread: float, model: AprModel) -> Array:
    """Bias and noise (N, 3) with a place's size, whose logarithm is `scale` (N,)."""
    bias, noise = parts
    follows = model.noise_follows
    # Noise that follows places less is as much larger everywhere, so that the share is one of variances.
    noise_scale = follows * scale + (1 - follows**2) * spread**2
    return (
        np.sqrt(1 - noise_share) * np.exp(scale)[:, None] * bias
        + np.sqrt(noise_share) * np.exp(noise_scale)[:, None] * noise
    )


def _at_most(vectors: Array, length: float) -> Array:
    """Vectors (N, 3) shortened to a length."""
    return vectors * np.minimum(1.0, length / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12))


def _fields(where: Array, count: int, seed: list[int]) -> Array:
    """Independent smooth random fields (N, count) of unit variance at points (N, D), with the correlation exp(-d^2/2).

    Random Fourier features (Rahimi and Recht, NIPS 2007).
    """
    rng = np.random.default_rng(seed)
    frequency = rng.standard_normal((count, where.shape[1], _FEATURES))
    phase = rng.uniform(0, 2 * np.pi, (count, _FEATURES))
    waves = [np.cos(where @ frequency[c] + phase[c]).sum(axis=1) for c in range(count)]
    return np.sqrt(2 / _FEATURES) * np.stack(waves, axis=1)


def read_apr_models() -> dict[tuple[str, str], AprModel]:
    """Models by (scene, regressor)."""
    content = tomllib.loads(Path(__file__).with_name("sizes.toml").read_text(encoding="utf-8"))
    return {
        (scene, regressor): AprModel(**{name: float(value) for name, value in values.items()})
        for scene, regressors in content.items()
        for regressor, values in regressors.items()
    }
