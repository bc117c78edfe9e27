"""Other alignments that could be the right one by now: odometry may have lost its frame, or found it again.

After odometry has lost its frame, the newest predictions agree on an alignment that isn't the one in force. Each of the
newest keyframes names an alignment, and each earlier segment has its last one. A rival is one of them from some keyframe
on: it gains what it explains the predictions since better than the alignment in force does, less how rarely odometry
loses its frame there, and, for an alignment that was never in force, less how little was known of it beforehand.
"""

from typing import NamedTuple

import numpy as np

from fusion import robust
from fusion.alignment_chain import UNKNOWN, errors
from fusion.keyframes import Keyframes
from geometry.poses import Array

# Volume of the places and headings that a phone may turn up at: m, m, m up, rad.
_ANYWHERE = 40.0 * 40.0 * 3.0 * 2 * np.pi
_DIMENSIONS = 6


class Rival(NamedTuple):
    """States (N - begin, 4) of the keyframes from `begin` on under another alignment, what it gains in nats, and the
    earlier segment whose alignment it is; None for a new one."""

    begin: int
    state: Array
    gain: float
    segment: float | None


def best_rival(
    keyframes: Keyframes, covariance: Array, squared: Array, dof: float, recent: int, counted: Array
) -> Rival | None:
    """The rival that gains most; None where a segment has just begun and there is no earlier one.

    covariance (6, 6) and squared (N,): of the keyframes' errors as they are. recent: how many keyframes judge. counted
    (N,): what each counts in that, as neighbours are wrong alike.
    """
    segment, rare = keyframes.column("segment"), keyframes.column("rare")
    first = max(len(keyframes) - recent, int(np.argmax(segment == segment[-1])))
    count = len(keyframes) - first
    begins_anew = first == 0 or segment[first - 1] != segment[-1]
    yaw, shift, of = _alignments(keyframes, first)
    position = _carried(yaw, shift, keyframes.column("vio")[first:])
    costs = robust.costs(_squared(keyframes, covariance, position, yaw, first), _DIMENSIONS, dof)
    now = robust.costs(squared, _DIMENSIONS, dof)
    newest = np.arange(len(of), len(yaw))
    # A keyframe fits the alignment that it names itself: it is taken to fit as they usually do.
    costs[newest, np.arange(count)] = np.median(now)
    better = counted[first:] * (now[first:] - costs)
    gains = np.cumsum(better[:, ::-1], axis=1)[:, ::-1] - rare[first:]
    gains[newest] -= np.log(_ANYWHERE) + _log_density(keyframes, covariance)
    gains[newest] = np.where(np.tri(count, dtype=bool), gains[newest], -np.inf)
    if begins_anew:
        gains[newest, 0] = -np.inf
    which, begin = np.unravel_index(int(np.argmax(gains)), gains.shape)
    if not np.isfinite(gains[which, begin]):
        return None
    state = np.column_stack([position[which, begin:], np.full(count - begin, yaw[which])])
    return Rival(first + int(begin), state, float(gains[which, begin]), of[which] if which < len(of) else None)


def _alignments(keyframes: Keyframes, first: int) -> tuple[Array, Array, list[float]]:
    """Yaw (K,) and shift (K, 3) of map_T_vio that earlier segments had last, and that keyframes from `first` on name;
    and those segments."""
    segment, state, measured = (keyframes.column(name) for name in ("segment", "state", "measured"))
    earlier = [float(s) for s in np.unique(segment) if s != segment[-1]]
    last = [int(np.flatnonzero(segment == s)[-1]) for s in earlier]
    yaw = np.concatenate([state[last, 3], measured[first:, 3]])
    at = np.concatenate([state[last, :3], measured[first:, :3]])
    vio = keyframes.column("vio")
    return yaw, at - _turned(yaw, np.concatenate([vio[last], vio[first:]])), earlier


def _turned(yaw: Array, points: Array) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    x, y, z = points[..., 0], points[..., 1], points[..., 2]
    return np.stack([c * x + s * z, y + 0 * c, c * z - s * x], axis=-1)


def _carried(yaw: Array, shift: Array, vio: Array) -> Array:
    """Map positions (K, N, 3) of odometry's (N, 3) under each of K alignments."""
    return shift[:, None] + _turned(yaw[:, None], vio[None])


def _squared(keyframes: Keyframes, covariance: Array, position: Array, yaw: Array, first: int) -> Array:
    """Squared errors (K, N) of the keyframes from `first` on under K alignments. Those are as uncertain as a prediction,
    so errors under them are twice as large in the square."""
    alignments, count = position.shape[:2]
    measured = np.tile(keyframes.column("measured")[first:], (alignments, 1))
    found = errors(
        position.reshape(-1, 3), np.repeat(yaw, count), measured[:, :3], measured[:, 3], measured[:, 4:]
    ).reshape(alignments, count, 6)
    whitening = keyframes.column("whitening")[first:].reshape(-1, 6, 6)
    normalised = np.einsum("nij,knj->kni", whitening, found)
    return np.einsum("kni,kni->kn", normalised @ np.linalg.inv(covariance), normalised) / 2


def _log_density(keyframes: Keyframes, covariance: Array) -> float:
    """Logarithm of the density at its top, in 1/(m^3 rad), of the alignment that the newest prediction names."""
    unknown = keyframes.column("whitening")[-1].reshape(6, 6)[:, UNKNOWN]
    information = unknown.T @ np.linalg.solve(covariance, unknown)
    return float(np.linalg.slogdet(information / (2 * np.pi))[1] / 2)
