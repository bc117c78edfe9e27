"""Alternative hypotheses of the alignment: odometry may have lost its frame, or found it again.

After odometry has lost its frame, the newest predictions agree on an alignment that isn't the one in force. What those
from a keyframe on name together is an alternative, and so is the last one of each earlier segment. It gains what it
explains the predictions since better than the alignment in force does, less how rarely odometry loses its frame there,
and, for an alignment that was never in force, less how little was known of it beforehand. Odometry that has lost its
frame may still know one thing of two: the place, as where it turned on the spot, or the heading, as where it jumped
aside. Such an alternative keeps the one and takes the other from the predictions.

Where the first predictions after a start or a loss of tracking were wrong, the fit stays at the alignment that they
named, a local minimum, even where all later ones agree on another. That other one is an alternative from the same
keyframe on."""

from math import atan2, cos, inf, log, nan, pi, sin
from typing import NamedTuple

import numpy as np

from groundwalk.fusion.methods.estimator import robust
from groundwalk.fusion.methods.estimator.chain import UNKNOWN, write_error
from groundwalk.fusion.methods.estimator.compiled import Row, Rows, add_product, compiled, invert, write_columns
from groundwalk.geometry.poses import Array

# Extent of the places and headings that a phone may turn up at: m, m up, m, rad.
_ANYWHERE = (40.0, 3.0, 40.0, 2 * pi)
# Odds below exp(SIGN) against a loss of odometry's frame: it jumped, or was gone.
SIGN = 5.0
# Predictions may be wrong in a row, and all alike, so that they look like a lost frame: without a sign they count less.
_WITHOUT_SIGN = 0.5
_RECENT = 10  # newest predictions by which they are compared
_DOF = 0.3  # of Student's t by which alignments are compared: a wrong prediction's cost hardly grows with its error
_EVIDENCE = 0.7  # what a prediction counts in that, as neighbours' errors are correlated; ...
_APART_M = 0.05  # ... half of it at this distance
_USUAL = 3.0  # squared error, over the usual one, up to which predictions are explained where there was no sign
_TURNED = 7.0  # log odds against a turn of odometry on the spot without a sign
_SAME_START = 5.0  # nats that an alignment from the same keyframe on as the one in force must gain
_BACK = 3.0  # log odds against an earlier alignment's holding again
LOST = 1e4  # variance (m^2, rad^2) of what isn't known any more from one keyframe to the next

# What a new alignment keeps of the one before: nothing, where the camera is, or where it looks; what that leaves
# unknown of x, y, z and yaw; and predictions that must agree where odometry gave no sign: passing what looks like
# another place takes some seconds.
NOTHING, PLACE, HEADING = range(3)
_UNKNOWN_WITH = ((True, True, True, True), (False, False, False, True), (True, True, True, False))
_LEAST = (10, 3, 10)


class Alternative(NamedTuple):
    """The keyframes from `begin` on under another alignment: translation and yaw (4,) of map_T_vio. gain: in nats.
    kept: what it has of the one in force. segment: the earlier one whose alignment it is, NaN for a new one."""

    begin: int
    alignment: Array
    gain: float
    kept: int
    segment: float


class _Recent(NamedTuple):
    """The newest keyframes, by which alignments are compared. precision (6, 6): of normalised errors. share (N,): what
    each counts, as neighbours' errors are correlated. now (N,): what each costs under the alignment in force."""

    keyframes: Rows
    precision: Array
    share: Array
    now: Array


def lost_variances(kept: int) -> Array:
    """Variances (4,) of x, y, z and yaw from the keyframe before, for an alignment that keeps so much of it."""
    return np.where(_UNKNOWN_WITH[kept], LOST, 0.0)


def best_alternative(keyframes: Rows, covariance: Array, squared: Array) -> Alternative | None:
    """The alternative that gains most; None where there is none. covariance (6, 6) and squared (N,): of the keyframes'
    errors as they are."""
    alternative = _best_alternative(keyframes, covariance, squared, float(np.median(squared)))
    return alternative if alternative.begin >= 0 else None


@compiled
def adopt(keyframes: Rows, alternative: Alternative) -> None:
    """Move the keyframes from the alternative's begin on to where its alignment has them."""
    for i in range(alternative.begin, len(keyframes)):
        _compose(alternative.alignment, keyframes[i].vio, 1.0, keyframes[i].state)


@compiled
def starts_here(keyframes: Rows, index: int, kept: int) -> bool:
    """Whether the alignment in force starts at a keyframe, with no more of one before than such an alternative."""
    for axis in range(4):
        if index > 0 and _UNKNOWN_WITH[kept][axis] and keyframes[index].added_variance[axis] < LOST:
            return False
    return index > 0 or kept == NOTHING


@compiled
def _best_alternative(keyframes: Rows, covariance: Array, squared: Array, usual: float) -> Alternative:
    first, count = len(keyframes) - 1, len(keyframes)
    while first > max(0, count - _RECENT) and keyframes[first - 1].segment == keyframes[-1].segment:
        first -= 1
    recent = _recent(keyframes[first:], covariance, squared[first:])
    newness = _newness(keyframes[-1], recent.precision)
    states, positions = _averages(recent, usual)
    best = Alternative(-1, np.zeros(4), -inf, NOTHING, nan)
    for begin in range(count - first):
        here = recent.keyframes[begin]
        for kept in range(3):
            share, odds, unseen = 1.0, here.kept_odds, here.kept_odds >= SIGN
            if starts_here(keyframes, first + begin, kept):
                if kept != NOTHING:
                    continue
                odds, unseen = _SAME_START - newness[kept], False
            elif first + begin == 0 or (unseen and first + begin > count - _LEAST[kept]):
                continue
            elif unseen:
                share, odds = _WITHOUT_SIGN, _TURNED if kept == PLACE else odds
            alignment = _named(keyframes, first + begin, states[begin], positions[begin], kept)
            gain = share * _better(recent, alignment, begin) - odds - newness[kept]
            if gain > best.gain and not (unseen and not _explains(recent, alignment, begin, usual)):
                best = Alternative(first + begin, alignment, gain, kept, nan)
    for last in range(first):
        ends = keyframes[last].segment != keyframes[-1].segment
        for later in range(last + 1, count):
            ends = ends and keyframes[later].segment != keyframes[last].segment
        if ends:
            alignment = np.empty(4)
            _compose(keyframes[last].state, keyframes[last].vio, -1.0, alignment)
            for begin in range(count - first):  # an alignment that held before needs no sign
                gain = _better(recent, alignment, begin) - min(recent.keyframes[begin].kept_odds, _BACK)
                if gain > best.gain:
                    best = Alternative(first + begin, alignment, gain, NOTHING, keyframes[last].segment)
    return best


@compiled
def _recent(keyframes: Rows, covariance: Array, squared: Array) -> _Recent:
    precision, share, now = covariance.copy(), np.empty(len(keyframes)), np.empty(len(keyframes))
    invert(precision)
    for i in range(len(keyframes)):
        now[i] = robust.cost(squared[i], 6, _DOF)
        gap = keyframes[i].along - keyframes[i - 1].along if i > 0 else inf
        share[i] = _EVIDENCE / (1 + _APART_M / max(gap, 1e-6))
    return _Recent(keyframes, precision, share, now)


@compiled
def _newness(keyframe: Row, precision: Array) -> tuple[float, float, float]:
    """How much narrower, in nats, a prediction names what isn't kept than it was known beforehand."""
    unknown, pulled, information = np.empty((6, 4)), np.zeros((6, 4)), np.zeros((4, 4))
    write_columns(keyframe.whitening, UNKNOWN, unknown, 6)
    add_product(precision, unknown, pulled, (6, 6, 4), 1 / (2 * pi))
    add_product(unknown.T, pulled, information, (4, 6, 4))
    heading, of_place = information[3, 3], information[:3, :3].copy()
    place, both = invert(of_place), invert(information)
    anywhere = _ANYWHERE[0] * _ANYWHERE[1] * _ANYWHERE[2]
    return (
        log(anywhere * _ANYWHERE[3]) + log(both) / 2,
        log(_ANYWHERE[3]) + log(heading) / 2,
        log(anywhere) + log(place) / 2,
    )


@compiled
def _averages(recent: _Recent, usual: float) -> tuple[Array, Array]:
    """For each keyframe that may have begun a new alignment, means over the predictions since: position and heading
    (N, 4) that they name, and odometry's position (N, 3). Each counts by how well the best of the alignments explains
    it that they name one by one. usual: squared error of a prediction."""
    count, alignment = len(recent.now), np.empty(4)
    squared, best, most = np.empty((count, count)), np.zeros(count, np.int64), np.full(count, -inf)
    for by in range(count):
        _compose(recent.keyframes[by].measured, recent.keyframes[by].vio, -1.0, alignment)
        better = 0.0
        for begin in range(count - 1, -1, -1):
            # Alignments that single predictions name are as uncertain as those: errors are twice as large.
            squared[by, begin] = _squared(recent, alignment, begin) / 2
            cost = robust.cost(usual if by == begin else squared[by, begin], 6, _DOF)
            better += recent.share[begin] * (recent.now[begin] - cost)
            if begin <= by and better > most[begin]:
                best[begin], most[begin] = by, better
    states, positions = np.zeros((count, 4)), np.zeros((count, 3))
    for begin in range(count):
        total = c = s = 0.0
        for i in range(begin, count):
            weight = recent.share[i] * robust.weight(squared[best[begin], i], 6, _DOF)
            total += weight
            c += weight * cos(recent.keyframes[i].measured[3])
            s += weight * sin(recent.keyframes[i].measured[3])
            for j in range(3):
                states[begin, j] += weight * recent.keyframes[i].measured[j]
                positions[begin, j] += weight * recent.keyframes[i].vio[j]
        for j in range(3):
            states[begin, j] /= total
            positions[begin, j] /= total
        states[begin, 3] = atan2(s, c)
    return states, positions


@compiled
def _named(keyframes: Rows, begin: int, state: Array, vio: Array, kept: int) -> Array:
    """The alignment (4,) that predictions from a keyframe on name, but for what is kept of the one in force until then.
    state (4,) and vio (3,): means over them (`_averages`)."""
    carried, alignment = np.empty(4), np.empty(4)
    if kept == NOTHING:
        _compose(state, vio, -1.0, alignment)
        return alignment
    _compose(keyframes[begin - 1].state, keyframes[begin].step, 1.0, carried)
    if kept == PLACE:
        carried[3] = state[3]
        _compose(carried, keyframes[begin].vio, -1.0, alignment)
        return alignment
    for j in range(3):
        alignment[j] = state[j]
    alignment[3] = carried[3] + keyframes[begin].turn
    _compose(alignment.copy(), vio, -1.0, alignment)
    return alignment


@compiled
def _squared(recent: _Recent, alignment: Array, at: int) -> float:
    """The squared error of a keyframe under an alignment."""
    keyframe = recent.keyframes[at]
    state, error, normalised = np.empty(4), np.empty(6), np.zeros(6)
    _compose(alignment, keyframe.vio, 1.0, state)
    write_error(state, keyframe.measured, error)
    squared = 0.0
    for j in range(6):
        for k in range(6):
            normalised[j] += keyframe.whitening[j, k] * error[k]
    for j in range(6):
        for k in range(6):
            squared += normalised[j] * recent.precision[j, k] * normalised[k]
    return squared


@compiled
def _better(recent: _Recent, alignment: Array, begin: int) -> float:
    """By how much an alignment explains what came from a keyframe on better than the one in force."""
    better = 0.0
    for i in range(begin, len(recent.now)):
        better += recent.share[i] * (recent.now[i] - robust.cost(_squared(recent, alignment, i), 6, _DOF))
    return better


@compiled
def _explains(recent: _Recent, alignment: Array, begin: int, usual: float) -> bool:
    """Whether an alignment explains what came from a keyframe on about as well as predictions usually are, whose
    squared error is that: one that is merely better than the one in force is none."""
    cost = limit = 0.0
    for i in range(begin, len(recent.now)):
        cost += recent.share[i] * robust.cost(_squared(recent, alignment, i), 6, _DOF)
        limit += recent.share[i] * robust.cost(_USUAL * usual, 6, _DOF)
    return cost <= limit


@compiled
def _compose(alignment: Array, point: Array, sign: float, result: Array) -> None:
    """Writes translation and yaw (4,) of an alignment (4,) after a shift of odometry's axes by `sign` times a point
    (3,): from map_T_vio and odometry's position the camera's state, and with sign -1 back."""
    c, s = cos(alignment[3]), sin(alignment[3])
    result[0] = alignment[0] + sign * (c * point[0] + s * point[2])
    result[1] = alignment[1] + sign * point[1]
    result[2] = alignment[2] + sign * (c * point[2] - s * point[0])
    result[3] = alignment[3]
