"""Other alignments that could be the right one by now: odometry may have lost its frame, or found it again.

After odometry has lost its frame, the newest predictions agree on an alignment that isn't the one in force. Each of
the newest keyframes names an alignment, and each earlier segment has its last one. A rival is one of them from some
keyframe on: it gains what it explains the predictions since better than the alignment in force does, less how rarely
odometry loses its frame there, and, for an alignment that was never in force, less how little was known of it
beforehand. Odometry that has lost its frame may still know one thing of two: the place, as where it turned on the spot,
or the heading, as where it jumped aside. Such a rival keeps the one and takes the other from the predictions."""

from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

import numpy as np

from groundwalk.fusion.methods.estimator import robust
from groundwalk.fusion.methods.estimator.alignment_chain import UNKNOWN, errors
from groundwalk.fusion.methods.estimator.keyframes import Keyframes
from groundwalk.geometry.poses import Array

# Extent of the places and headings that a phone may turn up at: m, m up, m, rad.
_ANYWHERE = np.array([40.0, 3.0, 40.0, 2 * np.pi])
_DIMENSIONS = 6
# Odds below exp(_SIGN) against a loss of odometry's frame: it jumped, or was gone.
_SIGN = 5.0
_WITHOUT_SIGN = 0.5
_HOPELESS = 5.0  # nats behind, where a rival needn't be worked out
_BACK = 3.0  # log odds against an earlier alignment's holding again


_LOST = 1e4  # variance (m^2, rad^2) of what isn't known any more from one keyframe to the next


class Kept(Enum):
    """What a new alignment has of the one before: nothing, where the camera is, or where it looks. The value is what
    that leaves unknown of x, y, z and yaw."""

    NOTHING = (True, True, True, True)
    PLACE = (False, False, False, True)
    HEADING = (True, True, True, False)

    @property
    def loose(self) -> Array:
        """Variances (4,) of x, y, z and yaw from the keyframe before."""
        return np.where(self.value, _LOST, 0.0)


# Predictions that must agree where odometry gave no sign: passing what looks like another place takes some seconds.
_LEAST = {Kept.NOTHING: 10, Kept.PLACE: 4, Kept.HEADING: 10}


class Rival(NamedTuple):
    """States (N - begin, 4) of the keyframes from `begin` on under another alignment, what it gains in nats, what it
    keeps of the one in force, the earlier segment whose alignment it is (None for a new one), and what it gains by the
    predictions alone, where odometry gave a sign."""

    begin: int
    state: Array
    gain: float
    kept: Kept
    segment: float | None
    evidence: float


def best_rival(
    keyframes: Keyframes, covariance: Array, squared: Array, dof: float, recent: int, counted: Array
) -> Rival | None:
    """The rival that gains most; None where none can win.

    covariance (6, 6) and squared (N,): of the keyframes' errors as they are. recent: how many keyframes judge. counted
    (N,): what each counts in that, as neighbours are wrong alike.
    """
    segment, rare = keyframes.column("segment"), keyframes.column("rare")
    first = max(len(keyframes) - recent, int(np.argmax(segment == segment[-1])))
    count = len(keyframes) - first
    measured, vio = keyframes.column("measured")[first:], keyframes.column("vio")[first:]
    judged = _Judged(
        measured, vio, keyframes.column("whitening")[first:], np.asarray(np.linalg.inv(covariance), dtype=float)
    )
    now = robust.costs(squared[first:], _DIMENSIONS, dof)
    share = counted[first:]

    def better(costs: Array) -> Array:
        """By how much alignments (K, N) explain what came from each keyframe on better than the one in force."""
        return np.asarray(np.cumsum((share * (now - costs))[:, ::-1], axis=1)[:, ::-1])

    # Predictions may be wrong in a row, and all alike, so that they look like a lost frame: where odometry gave no sign
    # of one they count less. An alignment that held before needs no sign.
    sign = rare[first:] < _SIGN
    new_share, new_rare = np.where(sign, 1.0, _WITHOUT_SIGN), rare[first:]

    def gained(costs: Array) -> Array:
        return np.asarray(new_share * better(costs) - new_rare)

    usual = float(robust.costs(np.array([robust.middle(squared)]), _DIMENSIONS, dof)[0])
    newness = _newness(keyframes, covariance)
    # Even one that explains every prediction well couldn't win: most often there is nothing to look at.
    if segment[0] == segment[-1] and gained(np.full((1, count), usual / 2)).max() < min(newness.values()) - _HOPELESS:
        return None
    yaw, weight = _named(judged, usual, share, dof, gained)
    carried = _carried(keyframes, first)
    loose = keyframes.column("loose")[first:] >= _LOST
    rival = None
    for kept, (of_yaw, shift) in _new(yaw, weight, carried, measured, vio).items():
        gains = np.diag(gained(robust.costs(judged.squared(of_yaw, shift), _DIMENSIONS, dof))) - newness[kept]
        # What is new where it was lost before is the alignment in force.
        gains[~sign & (np.arange(count) > count - _LEAST[kept]) | loose[:, kept.value].all(axis=1)] = -np.inf
        if first == 0:
            gains[0] = -np.inf
        begin = int(np.argmax(gains))
        if np.isfinite(gains[begin]) and (rival is None or gains[begin] > rival.gain):
            state = _states(of_yaw[begin], shift[begin], vio[begin:])
            gain = float(gains[begin])
            rival = Rival(first + begin, state, gain, kept, None, gain + float(sign[begin] * new_rare[begin]))
    old_yaw, old_shift, segments = _earlier(keyframes)
    if segments:
        gains = better(robust.costs(judged.squared(old_yaw, old_shift), _DIMENSIONS, dof)) - np.minimum(new_rare, _BACK)
        which, begin = (int(i) for i in np.unravel_index(int(np.argmax(gains)), gains.shape))
        if rival is None or gains[which, begin] > rival.gain:
            state = _states(old_yaw[which], old_shift[which], vio[begin:])
            gain = float(gains[which, begin])
            rival = Rival(first + begin, state, gain, Kept.NOTHING, segments[which], gain)
    return rival


def _new(yaw: Array, weight: Array, carried: Array, measured: Array, vio: Array) -> dict[Kept, tuple[Array, Array]]:
    """Yaw (N,) and shift (N, 3) of the alignments that may begin at each keyframe, by what they keep. yaw (N,) and
    weight (N, N): `_named`; carried (N, 4): where the alignment before has the camera."""
    place, heading = weight @ measured[:, :3], weight @ vio
    before = carried[:, 3]
    return {
        Kept.NOTHING: (yaw, place - _turned(yaw, heading)),
        Kept.PLACE: (yaw, carried[:, :3] - _turned(yaw, vio)),
        Kept.HEADING: (before, place - _turned(before, heading)),
    }


def _carried(keyframes: Keyframes, first: int) -> Array:
    """Position and yaw (N, 4) of the keyframes from `first` on, each carried by odometry from the one before; that of
    the very first is its own."""
    state = keyframes.column("state")
    before = state[np.maximum(np.arange(first, len(state)) - 1, 0)]
    moved = _turned(before[:, 3], keyframes.column("step")[first:])
    carried = np.column_stack([before[:, :3] + moved, before[:, 3] + keyframes.column("turn")[first:]])
    if first == 0:
        carried[0] = state[0]
    return carried


class _Judged(NamedTuple):
    """Keyframes that judge alignments: what they measured (N, 6), odometry (N, 3), their whitening (N, 36), and the
    inverse of the normalised errors' covariance."""

    measured: Array
    vio: Array
    whitening: Array
    precision: Array

    def squared(self, yaw: Array, shift: Array) -> Array:
        """Squared errors (K, N) under alignments of yaw (K,) and shift (K, 3)."""
        alignments, count = len(yaw), len(self.vio)
        position = shift[:, None] + _turned(yaw[:, None], self.vio[None])
        measured = np.tile(self.measured, (alignments, 1))
        error = errors(
            position.reshape(-1, 3), np.repeat(yaw, count), measured[:, :3], measured[:, 3], measured[:, 4:]
        ).reshape(alignments, count, _DIMENSIONS)
        whitening = self.whitening.reshape(-1, _DIMENSIONS, _DIMENSIONS)
        normalised = (whitening @ error[..., None])[..., 0]
        return np.asarray(((normalised @ self.precision) * normalised).sum(axis=-1))


def _named(
    judged: _Judged, usual: float, share: Array, dof: float, gained: Callable[[Array], Array]
) -> tuple[Array, Array]:
    """For each keyframe that may have begun a new alignment, its yaw (N,), the mean of what the predictions since name,
    and what these count in it (N, N), weighed under the best of them. usual: what a prediction costs; share (N,): what
    each counts; gained: what alignments gain by their costs (K, N)."""
    measured, count = judged.measured, len(judged.vio)
    yaw, shift = measured[:, 3], measured[:, :3] - _turned(measured[:, 3], judged.vio)
    # Alignments that single predictions name are as uncertain as those: errors under them are twice as large.
    named = judged.squared(yaw, shift) / 2
    costs = robust.costs(named, _DIMENSIONS, dof)
    costs[np.arange(count), np.arange(count)] = usual
    best = np.argmax(np.where(np.tri(count, dtype=bool), gained(costs), -np.inf), axis=0)
    weight = np.triu(share * robust.weights(named[best], _DIMENSIONS, dof))
    weight /= weight.sum(axis=1, keepdims=True)
    return np.angle(weight @ np.exp(1j * yaw)), weight


def _states(yaw: float, shift: Array, vio: Array) -> Array:
    """Map positions and yaw (N, 4) of odometry's positions (N, 3) under an alignment."""
    return np.column_stack([shift + _turned(np.full(len(vio), yaw), vio), np.full(len(vio), yaw)])


def _earlier(keyframes: Keyframes) -> tuple[Array, Array, list[float]]:
    """Yaw (K,) and shift (K, 3) of map_T_vio that earlier segments had last, and those segments."""
    segment, state = keyframes.column("segment"), keyframes.column("state")
    if segment[0] == segment[-1]:
        return np.zeros(0), np.zeros((0, 3)), []
    segments = [float(s) for s in np.unique(segment) if s != segment[-1]]
    last = [int(np.flatnonzero(segment == s)[-1]) for s in segments]
    yaw = state[last, 3]
    return yaw, state[last, :3] - _turned(yaw, keyframes.column("vio")[last]), segments


def _turned(yaw: Array, points: Array) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    x, z = points[..., 0], points[..., 2]
    turned = np.empty((*np.broadcast_shapes(c.shape, x.shape), 3))
    turned[..., 0], turned[..., 1], turned[..., 2] = c * x + s * z, points[..., 1], c * z - s * x
    return turned


def _newness(keyframes: Keyframes, covariance: Array) -> dict[Kept, float]:
    """How much narrower, in nats, the newest prediction names what isn't kept than it was known beforehand."""
    unknown = keyframes.column("whitening")[-1].reshape(6, 6)[:, UNKNOWN]
    information = unknown.T @ np.linalg.solve(covariance, unknown) / (2 * np.pi)
    newness = {}
    for kept in Kept:
        lost = np.array(kept.value)
        log_density = float(np.linalg.slogdet(information[np.ix_(lost, lost)])[1] / 2)
        newness[kept] = float(np.log(_ANYWHERE[lost]).sum()) + log_density
    return newness
