"""Other alignments that could be the right one by now: odometry may have lost its frame, or found it again.

After odometry has lost its frame, the newest predictions agree on an alignment that isn't the one in force. Each of
the newest keyframes names an alignment, and each earlier segment has its last one. An alternative is one of them from
some keyframe on: it gains what it explains the predictions since better than the alignment in force does, less how
rarely odometry loses its frame there, and, for an alignment that was never in force, less how little was known of it
beforehand. Odometry that has lost its frame may still know one thing of two: the place, as where it turned on the spot,
or the heading, as where it jumped aside. Such an alternative keeps the one and takes the other from the predictions.

Where the first predictions after a start or a loss of tracking were wrong, the fit stays at the alignment that they
named, a local minimum, even where all later ones agree on another. That other one is an alternative from the same
keyframe on. Being new costs it nothing, as the one in force is as new.

A turn on the spot gives no sign where frames are far apart, but it is seen: under the alignment in force the camera has
turned, and under the alternative it has gone on looking where it did, as cameras do most of the time."""

from collections.abc import Sequence
from math import atan2, cos, exp, inf, log, log1p, nan, pi, radians, sin
from typing import NamedTuple

import numpy as np

from groundwalk.fusion.methods.estimator import robust
from groundwalk.fusion.methods.estimator.chain import UNKNOWN, write_error
from groundwalk.fusion.methods.estimator.compiled import compiled
from groundwalk.fusion.methods.estimator.keyframes import Row, Rows
from groundwalk.fusion.methods.estimator.matrices import add_product, invert, write_columns
from groundwalk.geometry.poses import Array

# Extent of the places and headings that a phone may turn up at: m, m up, m, rad.
_ANYWHERE = (40.0, 3.0, 40.0, 2 * pi)
# Odds below exp(SIGN) against a loss of odometry's frame: it jumped, or was gone.
SIGN = 5.0
_WITHOUT_SIGN = 0.5
_RECENT = 10  # newest predictions by which they are compared
_DOF = 0.3  # of Student's t by which alignments are compared: a wrong prediction's cost hardly grows with its error
_EVIDENCE = 0.7  # what a prediction counts in that, as neighbours' errors are correlated; ...
_APART_M = 0.05  # ... half of it at this distance
_USUAL = 3.0  # squared error, over the usual one, up to which predictions are explained where there was no sign
_TURNED = 7.0  # log odds against a turn of odometry on the spot without a sign, before the camera's turn is looked at
_TURN_S = radians(10.0)  # scale of a camera's turn in a second, under a Cauchy distribution
_HOPELESS = 5.0  # nats behind, where an alternative needn't be worked out
_SAME_START_GAIN = 5.0  # nats that an alignment from the same keyframe on as the one in force must gain
_BACK = 3.0  # log odds against an earlier alignment's holding again
LOST = 1e4  # variance (m^2, rad^2) of what isn't known any more from one keyframe to the next

# What a new alignment has of the one before: nothing, where the camera is, or where it looks; what that leaves unknown
# of x, y, z and yaw; and predictions that must agree where odometry gave no sign: passing what looks like another place
# takes some seconds.
NOTHING, PLACE, HEADING = range(3)
SAME_START = 3  # of `Alternative.kept`: nothing, and the alternative starts at the keyframe where the one in force did
_UNKNOWN_WITH = ((True, True, True, True), (False, False, False, True), (True, True, True, False))
_LEAST = (10, 3, 10)


class Alternative(NamedTuple):
    """The keyframes from `begin` on under another alignment: translation and yaw (4,) of map_T_vio. gain: in nats.
    kept: what it has of the one in force. segment: the earlier one whose alignment it is, NaN for a new one. evidence:
    what it gains by the predictions alone, where odometry gave a sign."""

    begin: int
    alignment: Array
    gain: float
    kept: int
    segment: float
    evidence: float


class _Recent(NamedTuple):
    """The newest keyframes, by which alignments are compared.

    precision (6, 6): of normalised errors. share (N,): what each counts, as neighbours' errors are correlated. now
    (N,): what each prediction costs under the alignment in force. share_new (N,): how much of that counts for a new
    alignment that begins at keyframe i.
    """

    keyframes: Rows
    precision: Array
    share: Array
    now: Array
    share_new: Array


def lost_variances(kept: int) -> Array:
    """Variances (4,) of x, y, z and yaw from the keyframe before, for an alignment that keeps so much of it."""
    return np.where(_UNKNOWN_WITH[kept], LOST, 0.0)


def best_alternative(keyframes: Rows, covariance: Array, squared: Array) -> Alternative | None:
    """The alternative that gains most; None where none can win. covariance (6, 6) and squared (N,): of the keyframes'
    errors as they are."""
    alternative = _best_alternative(keyframes, covariance, squared)
    return alternative if alternative.begin >= 0 else None


@compiled
def adopt(keyframes: Rows, alternative: Alternative) -> None:
    """Move the keyframes from the alternative's begin on to where its alignment has them."""
    for i in range(alternative.begin, len(keyframes)):
        _compose(alternative.alignment, keyframes[i].vio, 1.0, keyframes[i].state)


@compiled
def _best_alternative(keyframes: Rows, covariance: Array, squared: Array) -> Alternative:
    newest = keyframes[-1]
    first = len(keyframes) - 1
    while first > max(0, len(keyframes) - _RECENT) and keyframes[first - 1].segment == newest.segment:
        first -= 1
    precision = covariance.copy()
    invert(precision)
    recent = _recent(keyframes[first:], precision, squared[first:])
    usual = robust.cost(robust.middle(squared), 6, _DOF)
    newness = _newness(newest, precision)
    none = Alternative(-1, np.zeros(4), -inf, NOTHING, nan, -inf)
    # Even one that explains every prediction well couldn't win: most often there is nothing to look at.
    only, start = keyframes[0].segment == newest.segment, _start(recent, first)
    if only and start < 0 and _best_hope(recent, usual / 2) < min(newness) - _HOPELESS:
        return none
    best = _new(keyframes, first, recent, usual, newness, start, none)
    return best if only else _earlier(keyframes, first, recent, best)


@compiled
def _recent(keyframes: Rows, precision: Array, squared: Array) -> _Recent:
    count = len(keyframes)
    now, share, share_new = np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        now[i] = robust.cost(squared[i], 6, _DOF)
        gap = keyframes[i].along - keyframes[i - 1].along if i > 0 else inf
        share[i] = _EVIDENCE / (1 + _APART_M / max(gap, 1e-6))
        # Predictions may be wrong in a row, and all alike, so that they look like a lost frame: where odometry gave no
        # sign of one they count less.
        share_new[i] = 1.0 if keyframes[i].kept_odds < SIGN else _WITHOUT_SIGN
    return _Recent(keyframes, precision, share, now, share_new)


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
def _best_hope(recent: _Recent, cost: float) -> float:
    """What a new alignment gains at most under which each prediction costs so much."""
    best, better = -inf, 0.0
    for i in range(len(recent.now) - 1, -1, -1):
        better += recent.share[i] * (recent.now[i] - cost)
        best = max(best, recent.share_new[i] * better - min(recent.keyframes[i].kept_odds, _TURNED - _HOPELESS))
    return best


@compiled
def _squared(recent: _Recent, alignment: Array, at: int) -> float:
    """The squared error of a keyframe under an alignment."""
    keyframe = recent.keyframes[at]
    state, error, normalised = np.empty(4), np.empty(6), np.zeros(6)
    _compose(alignment, keyframe.vio, 1.0, state)
    write_error(state, keyframe.measured, error)
    for j in range(6):
        for k in range(6):
            normalised[j] += keyframe.whitening[j, k] * error[k]
    squared = 0.0
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
def _start(recent: _Recent, first: int) -> int:
    """The recent keyframe at which the alignment in force started, with nothing of one before; -1 where it is older."""
    for i in range(len(recent.now) - 1, -1, -1):
        if first + i == 0 or _holds_already(recent.keyframes[i], NOTHING):
            return i
    return -1


@compiled
def _new(
    keyframes: Rows, first: int, recent: _Recent, usual: float, newness: Sequence[float], start: int, best: Alternative
) -> Alternative:
    """The best of an alternative and the alignments that were never in force and begin at a recent keyframe. newness:
    what being new costs, by what is kept. start: see `_start`."""
    count = len(recent.now)
    weights, yaw = _named(recent, usual)
    carried, place, vio = np.empty(4), np.empty(4), np.empty(3)
    if start >= 0:
        _write_middle(recent, weights, start, place, vio)
        place[3] = yaw[start]
        alignment = np.empty(4)
        _compose(place, vio, -1.0, alignment)
        gain = _better(recent, alignment, start)
        if gain > _SAME_START_GAIN:
            best = Alternative(first + start, alignment, gain, SAME_START, nan, gain)
    for begin in range(1 if first == 0 else 0, count):
        here = recent.keyframes[begin]
        _write_carried(keyframes[first + begin - 1], here, carried)
        _write_middle(recent, weights, begin, place, vio)
        heading = carried[3]
        for kept in range(3):
            unseen = here.kept_odds >= SIGN
            if (unseen and begin > count - _LEAST[kept]) or _holds_already(here, kept):
                continue
            alignment = np.empty(4)
            place[3] = carried[3] = heading if kept == HEADING else yaw[begin]
            if kept == PLACE:
                _compose(carried, here.vio, -1.0, alignment)
            else:
                _compose(place, vio, -1.0, alignment)
            if unseen and not _explained(recent, alignment, begin, usual):
                continue
            kept_odds = here.kept_odds
            if unseen and kept == PLACE:
                kept_odds = _TURNED - _steadier(keyframes[first + begin - 1], here, yaw[begin] - heading)
            gain = recent.share_new[begin] * _better(recent, alignment, begin) - kept_odds - newness[kept]
            if gain > best.gain:
                best = Alternative(
                    first + begin, alignment, gain, kept, nan, gain + (here.kept_odds if here.kept_odds < SIGN else 0)
                )
    return best


@compiled
def _explained(recent: _Recent, alignment: Array, begin: int, usual: float) -> bool:
    """Whether an alignment explains what came from a keyframe on about as well as predictions usually are, which cost
    so much: one that is merely better than the one in force is none."""
    cost = counted = 0.0
    for i in range(begin, len(recent.now)):
        cost += recent.share[i] * robust.cost(_squared(recent, alignment, i), 6, _DOF)
        counted += recent.share[i]
    squared = _DOF * (exp(2 * usual / (_DOF + 6)) - 1)
    return cost <= counted * robust.cost(_USUAL * squared, 6, _DOF)


@compiled
def _steadier(before: Row, here: Row, turn: float) -> float:
    """By how much likelier, in nats, the camera's turn from the keyframe before is where odometry's axes have turned
    in the map by an angle (rad) meanwhile."""
    turned = atan2(here.forward[0], here.forward[2]) - atan2(before.forward[0], before.forward[2]) + here.turn
    scale = _TURN_S * (here.time_s - before.time_s)
    now, then = (turned + pi) % (2 * pi) - pi, (turned + turn + pi) % (2 * pi) - pi
    return log1p((now / scale) ** 2) - log1p((then / scale) ** 2)


@compiled
def _holds_already(keyframe: Row, kept: int) -> bool:
    """Whether all that such an alignment doesn't keep was lost here before: then it is the alignment in force."""
    for axis in range(4):
        if _UNKNOWN_WITH[kept][axis] and keyframe.added_variance[axis] < LOST:
            return False
    return True


@compiled
def _named(recent: _Recent, usual: float) -> tuple[Array, Array]:
    """For each keyframe that may have begun a new alignment, what the predictions since count in it (N, N), weighed
    under the best alignment that one of them names, and its yaw (N,). usual: what a prediction costs."""
    count = len(recent.now)
    named, best, best_gain = np.empty((count, count)), np.zeros(count, np.int64), np.full(count, -inf)
    alignment = np.empty(4)
    for i in range(count):
        _compose(recent.keyframes[i].measured, recent.keyframes[i].vio, -1.0, alignment)
        better = 0.0
        for begin in range(count - 1, -1, -1):
            # Alignments that single predictions name are as uncertain as those: errors under them are twice as large.
            named[i, begin] = _squared(recent, alignment, begin) / 2
            cost = usual if begin == i else robust.cost(named[i, begin], 6, _DOF)
            better += recent.share[begin] * (recent.now[begin] - cost)
            gain = recent.share_new[begin] * better - recent.keyframes[begin].kept_odds
            if begin <= i and gain > best_gain[begin]:
                best[begin], best_gain[begin] = i, gain
    weights, yaw = np.zeros((count, count)), np.empty(count)
    for begin in range(count):
        total = c = s = 0.0
        for i in range(begin, count):
            weight = recent.share[i] * robust.weight(named[best[begin], i], 6, _DOF)
            weights[begin, i] = weight
            total += weight
            c += weight * cos(recent.keyframes[i].measured[3])
            s += weight * sin(recent.keyframes[i].measured[3])
        yaw[begin] = atan2(s, c)
        for i in range(begin, count):
            weights[begin, i] /= total
    return weights, yaw


@compiled
def _write_middle(recent: _Recent, weights: Array, begin: int, place: Array, vio: Array) -> None:
    """Writes means of the predicted positions (3,) and of odometry's (3,) from a keyframe on."""
    for j in range(3):
        place[j] = vio[j] = 0.0
        for i in range(begin, len(recent.now)):
            place[j] += weights[begin, i] * recent.keyframes[i].measured[j]
            vio[j] += weights[begin, i] * recent.keyframes[i].vio[j]


@compiled
def _earlier(keyframes: Rows, first: int, recent: _Recent, best: Alternative) -> Alternative:
    """The best of an alternative and the alignments that earlier segments had last."""
    for last in range(len(keyframes) - 1):
        keyframe = keyframes[last]
        if keyframe.segment == keyframes[-1].segment or not _is_last(keyframes, last):
            continue
        alignment = np.empty(4)
        _compose(keyframe.state, keyframe.vio, -1.0, alignment)
        for begin in range(len(recent.now)):
            # An alignment that held before needs no sign.
            gain = _better(recent, alignment, begin) - min(recent.keyframes[begin].kept_odds, _BACK)
            if gain > best.gain:
                best = Alternative(first + begin, alignment, gain, NOTHING, keyframe.segment, gain)
    return best


@compiled
def _is_last(keyframes: Rows, index: int) -> bool:
    """Whether none of the later keyframes is of the same segment."""
    for i in range(index + 1, len(keyframes)):
        if keyframes[i].segment == keyframes[index].segment:
            return False
    return True


@compiled
def _write_carried(before: Row, here: Row, state: Array) -> None:
    """Writes position and yaw (4,) of a keyframe, carried by odometry from the one before."""
    _compose(before.state, here.step, 1.0, state)
    state[3] += here.turn


@compiled
def _compose(alignment: Array, point: Array, sign: float, result: Array) -> None:
    """Writes translation and yaw (4,) of an alignment (4,) after a shift of odometry's axes by `sign` times a point
    (3,): from map_T_vio and odometry's position the camera's state, and with sign -1 back."""
    c, s = cos(alignment[3]), sin(alignment[3])
    result[0] = alignment[0] + sign * (c * point[0] + s * point[2])
    result[1] = alignment[1] + sign * point[1]
    result[2] = alignment[2] + sign * (c * point[2] - s * point[0])
    result[3] = alignment[3]
