"""How much worse than usual odometry drifts, from predictions alone.

Predictions that are wrong alike at a place look like drift for a while, but not for long: how far they stray from
odometry levels off with the way between two of them, while drift goes on growing. So what counts as drift is by how
much they stray over a long way more than over a quarter of it, beyond what wrong predictions and chance make of that.
"""

import numpy as np

from groundwalk.fusion.keyframes import Keyframes
from groundwalk.fusion.robust import middle
from groundwalk.geometry.poses import Array

_LAGS = (8, 16, 32)  # keyframes apart; compared with a quarter as many
_LONG_M = 12.0  # motion over which predictions are no longer wrong alike, turns counted in
# Strayed over the long way, in the square, over that of a quarter of it: 4 for drift, less than this without.
_WITHOUT_DRIFT = 2.5
_MOST = 1000.0
# Medians of squares over an axis' variance: of two axes together, and of one.
_MEDIANS = np.array([1.386, 0.455])


def drift_factors(keyframes: Keyframes) -> Array:
    """Factors (4,), 1 or more, of the usual variances of drift in x, y, z and yaw."""
    along = keyframes.column("along")
    usable = [k for k in _LAGS if len(keyframes) >= 2 * k and middle(along[k:] - along[:-k]) >= _LONG_M]
    if not usable:
        return np.ones(4)
    lag = usable[0]
    (near, _), (far, usual) = _strayed(keyframes, lag // 4), _strayed(keyframes, lag)
    growth = (far - _WITHOUT_DRIFT * near) / (1 - _WITHOUT_DRIFT / 4) / _MEDIANS
    position, yaw = np.clip(growth / usual, 1.0, _MOST).tolist()
    return np.array([position, position, position, yaw])


def _strayed(keyframes: Keyframes, lag: int) -> tuple[Array, Array]:
    """Medians, over keyframes so many apart, of the square of what odometry and predictions disagree in: the horizontal
    way between them and yaw (2,); and what usual drift adds to the variance of each axis (2,)."""
    measured, vio = keyframes.column("measured"), keyframes.column("vio")
    drift = np.cumsum(keyframes.column("drift"), axis=0)
    added = drift[lag:] - drift[:-lag]
    way = vio[lag:] - vio[:-lag]
    yaw = keyframes.column("state")[:-lag, 3]
    c, s = np.cos(yaw), np.sin(yaw)
    apart = measured[lag:, :3] - measured[:-lag, :3]
    x, z = apart[:, 0] - c * way[:, 0] - s * way[:, 2], apart[:, 2] - c * way[:, 2] + s * way[:, 0]
    turned = (measured[lag:, 3] - measured[:-lag, 3] + np.pi) % (2 * np.pi) - np.pi
    # A yaw that drifts on the way bends it, too: by a third of its variance for a random walk, over two axes.
    bent = added[:, 3] * (way[:, 0] ** 2 + way[:, 2] ** 2) / 6
    found = np.array([middle(x * x + z * z), middle(turned * turned)])
    return found, np.array([middle(added[:, 0] + bent), middle(added[:, 3])])
