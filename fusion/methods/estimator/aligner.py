"""The alignment of odometry with the map from kept predictions: solved anew, robustly, with each new one.

The estimate is the joint fit of alignment_chain.py to all keyframes, with what each prediction counts (robust.py) and
the covariance of their errors (prediction_noise.py) fitted along: a prediction that later ones contradict loses its say
in hindsight. Each new prediction starts from the last solution, so that few iterations do.
"""

from math import cos, exp, inf, isnan, log, nan, sin, sqrt
from typing import NamedTuple

import numpy as np

from groundwalk.fusion.methods.estimator import robust
from groundwalk.fusion.methods.estimator.alignment_chain import UNKNOWN, Chain, Solution, apply, solve, write_error
from groundwalk.fusion.methods.estimator.compiled import compiled, inlined
from groundwalk.fusion.methods.estimator.keyframes import Row, Rows
from groundwalk.fusion.methods.estimator.likeness import Sharing, independent, likeness, position_variances
from groundwalk.fusion.methods.estimator.matrices import add_product, clear, invert, write_columns
from groundwalk.fusion.methods.estimator.prediction_noise import Prior, scatter
from groundwalk.fusion.methods.estimator.way import CERTAIN
from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array

DIMENSIONS = 6
_MIN_COUNTED = 1e-3  # of what a prediction counts, so that each is bound to something
ROTATION, POSITION = 0, 1  # of `Fit.weights`
_TILT = (0, 2)  # of the six numbers of an error: those that odometry's gravity error changes
_GRAVITY = 0.1  # what a prediction counts for the tilt: predictions of a whole walk may lean alike
_REFRESHED = 5  # keyframes whose posterior is worked out anew in an iteration
_DECIDED = 10  # newest keyframes of which it is asked whether odometry jumped before
_UNBOUND = 1e4  # variance (m^2) of a step of which nothing is known
_UNKNOWN = 10.0  # of a state's variance over an error's: how soon a position's kernel has heavier tails
_EXCESS = 0.3  # of a squared error that is too much for what is known, taken for the prediction's


class Model(NamedTuple):
    """What the fit assumes.

    prior: of the covariance of normalised errors. dof: degrees of freedom of Student's t; position_dof: the most that a
    position's kernel has. marginal: of rotation and position, the exponent of the weight by its own error, beside that
    by the whole prediction's. sharing: of errors. apart_m: motion after which two predictions are half as good as two
    that are made apart. tilt_sd: of odometry's gravity error an axis, rad.
    """

    prior: Prior
    dof: float
    position_dof: float
    marginal: tuple[float, float]
    sharing: Sharing
    apart_m: float
    tilt_sd: float


class Belief(NamedTuple):
    """What the states are fitted under.

    covariance (6, 6): of normalised errors. tilt (2,): odometry's gravity error about its x and z, rad. distrust (4,):
    factors of the usual variances of odometry's drift.
    """

    covariance: Array
    tilt: Array
    distrust: Array


class Fit(NamedTuple):
    """What an iteration gives beside the keyframes' states.

    covariance (6, 6): of normalised errors. squared (N,): each keyframe's squared error in its units. counted (N,):
    what it says that others don't. weights (N, 2): what the kernel lets its rotation and its position count. alike
    (N, N): correlations of errors, below the diagonal. information (N, 4, 4) and solution: the predictions' terms, and
    the step. tilt (2,) and its variance: odometry's gravity error.
    """

    covariance: Array
    squared: Array
    counted: Array
    weights: Array
    alike: Array
    information: Array
    solution: Solution
    tilt: Array
    tilt_variance: float


@compiled
def counted(along: Array, apart_m: float) -> Array:
    """How much of a prediction each says that isn't its neighbour's, (N,): those made standing still are one."""
    fraction = np.ones(len(along))
    for i in range(1, len(along)):
        gap = along[i] - along[i - 1]
        fraction[i] = max(gap / (gap + apart_m), _MIN_COUNTED)
    return fraction


@compiled
def innovation(keyframes: Rows, belief: Belief, known: Array) -> tuple[float, float, float]:
    """Squared lengths of the newest prediction's error, and of its rotation's and position's alone, that are to be
    expected once it is taken in, for a state of covariance `known` (4, 4) at the one before. What may be odometry's
    drift is no error of the prediction, and doesn't show that it is a good one either; what is too much for both is an
    error."""
    newest = keyframes[-1]
    known = known.copy()
    for j in range(4):  # the yaw before turns the step
        known[0, j] += newest.step[2] * known[3, j]
        known[2, j] -= newest.step[0] * known[3, j]
    for j in range(4):
        known[j, 0] += newest.step[2] * known[j, 3]
        known[j, 2] -= newest.step[0] * known[j, 3]
    for j in range(4):
        known[j, j] += belief.distrust[j] * newest.drift[j] + newest.loose[j]
    normalised, unknown, spread = np.empty(6), np.empty((6, 4)), np.empty((6, 6))
    _write_normalised(newest, belief.tilt, normalised)
    write_columns(newest.whitening, UNKNOWN, unknown, 6)
    _write_sandwich(unknown, known, 1.0, spread, (6, 4))
    whole = _innovation(belief.covariance, spread, normalised)
    rotation = _innovation(belief.covariance[:3, :3], spread[:3, :3], normalised[:3])
    position = _innovation(belief.covariance[3:, 3:], spread[3:, 3:], normalised[3:])
    return whole, rotation, position


@compiled
def _innovation(covariance: Array, spread: Array, normalised: Array) -> float:
    """That of an error (n,) of covariance (n, n), whose state spreads it by (n, n)."""
    n = len(normalised)
    precision, left = covariance + spread, np.zeros(n)
    invert(precision)
    expected = error = 0.0
    for j in range(n):
        for k in range(n):
            left[j] += precision[j, k] * normalised[k]
            expected += precision[j, k] * spread[j, k]  # dimensions, less the trace with the errors' own
        error += normalised[j] * left[j]
    for j in range(n):
        for k in range(n):
            expected += left[j] * covariance[j, k] * left[k]
    return max(expected, _EXCESS * error)


def iterate(keyframes: Rows, model: Model, belief: Belief, newest: tuple[float, float, float] | None = None) -> Fit:
    """One iteration: weights and covariance from the errors as they are expected (expectation and maximisation: an
    error is what is left of the prediction, and how uncertain the state is), then one step of the keyframes' states.

    `newest` stands in for the newest keyframe's squared errors in its weights (`innovation`). Raises GeometryError
    where nothing binds a keyframe.
    """
    fit = _iterate(keyframes, model, belief, np.full(3, nan) if newest is None else np.array(newest))
    if fit.solution.fault >= 0:
        raise GeometryError(
            f"nothing binds keyframe {fit.solution.fault} of {len(keyframes)}: the information isn't positive"
        )
    return fit


@compiled
def _iterate(keyframes: Rows, model: Model, belief: Belief, newest: Array) -> Fit:
    count = len(keyframes)
    normalised, unknown, spread = np.empty((count, 6)), np.empty((count, 6, 4)), np.empty((count, 6, 6))
    precision = belief.covariance.copy()
    invert(precision)
    variances = position_variances(keyframes, belief.covariance)
    alike = likeness(keyframes, variances, model.sharing)
    each = independent(keyframes, variances, alike, belief.distrust[0])
    t_weights, squared, fraction = np.empty(count), np.empty(count), counted(keyframes["along"], model.apart_m)
    for i in range(count):
        _write_normalised(keyframes[i], belief.tilt, normalised[i])
        write_columns(keyframes[i].whitening, UNKNOWN, unknown[i], 6)
        _write_sandwich(unknown[i], keyframes[i].posterior, each[i], spread[i], (6, 4))
        squared[i] = _expected(normalised[i], spread[i], precision, 0, 6)
        t_weights[i] = robust.weight(squared[i], DIMENSIONS, model.dof)
    covariance = scatter(model.prior, normalised, spread, fraction, t_weights)
    precision = covariance.copy()
    invert(precision)
    of_rotation, of_position = covariance[:3, :3].copy(), covariance[3:, 3:].copy()
    invert(of_rotation)
    invert(of_position)
    weights, lengths, weighed = np.empty((count, 2)), np.empty(3), np.empty((count, 6, 6))
    for i in range(count):
        squared[i] = lengths[0] = _expected(normalised[i], spread[i], precision, 0, 6)
        lengths[1] = _expected(normalised[i], spread[i], of_rotation, 0, 3)
        lengths[2] = _expected(normalised[i], spread[i], of_position, 3, 6)
        known_better = i == count - 1 and not isnan(newest[0])
        position_dof = _position_dof(model, covariance, spread[i])
        _write_weights(newest if known_better else lengths, model, position_dof, weights[i])
        fraction[i] *= each[i]
        _write_weighed(precision, weights[i], fraction[i], weighed[i])
    information, gradient = _normal_equations(normalised, unknown, weighed)
    tilt, tilt_variance = _tilt(keyframes, normalised, weighed, belief.tilt, model.tilt_sd)
    chain = _chain(keyframes, belief.distrust)
    for i in range(max(1, count - _DECIDED), count):
        if abs(keyframes[i].odds) < CERTAIN:
            _weigh_jump(keyframes, chain, i, information, gradient)
    solution = solve(chain, keyframes["state"], information, gradient)
    if solution.fault < 0:
        apply(keyframes["state"], solution.increments)
        _refresh(keyframes, solution.covariance)
    return Fit(covariance, squared, fraction, weights, alike, information, solution, tilt, tilt_variance)


@compiled
def _chain(keyframes: Rows, distrust: Array) -> Chain:
    """Odometry's part of the problem, its variances `distrust` (4,) times the usual ones."""
    count = len(keyframes)
    chain = Chain(np.empty((count, 3)), np.empty(count), np.zeros((count, 4)))
    for i in range(count):
        here = keyframes[i]
        chain.turn[i] = here.turn
        for j in range(3):
            chain.step[i, j] = here.step[j]
        if i > 0:
            for j in range(4):
                chain.precision[i, j] = 1 / (distrust[j] * here.drift[j] + here.loose[j])
    return chain


@compiled
def _weigh_jump(keyframes: Rows, chain: Chain, at: int, information: Array, gradient: Array) -> None:
    """Judge by the predictions before and after whether odometry has jumped on the way to a keyframe, and write to it
    and to the chain what step is to be expected."""
    here, usual = keyframes[at], np.empty(3)
    for j in range(3):
        usual[j] = 1 / chain.precision[at, j] - here.loose[j]
        chain.precision[at, j] = 1 / _UNBOUND
    solution = solve(chain, keyframes["state"], information, gradient)
    before, now = keyframes[at - 1].state.copy(), here.state.copy()
    both = np.empty((2, 4))
    for j in range(4):
        both[0, j], both[1, j] = before[j], now[j]
    apply(both, solution.increments[at - 1 : at + 1])
    c, s = cos(both[0, 3]), sin(both[0, 3])
    x, z = both[1, 0] - both[0, 0], both[1, 2] - both[0, 2]
    step = (c * x - s * z, both[1, 1] - both[0, 1], s * x + c * z)
    odds, apart = here.odds, 0.0
    for j in range(3):
        k = 2 - j if j != 1 else 1
        known = (solution.covariance[at - 1, j, j] + solution.covariance[at - 1, k, k]) / 2
        known += (solution.covariance[at, j, j] + solution.covariance[at, k, k]) / 2 + usual[j]
        moved, bridged = known, known + here.bridge[j]
        odds += ((step[j] - here.moved[j]) ** 2 / moved + log(moved)) / 2
        odds -= ((step[j] - here.bridged[j]) ** 2 / bridged + log(bridged)) / 2
        apart += (here.bridged[j] - here.moved[j]) ** 2 / 3
    jump = 1 / (1 + exp(-odds))
    for j in range(4):
        here.loose[j] = jump * here.bridge[j]
        if j < 3:
            here.step[j] = chain.step[at, j] = jump * here.bridged[j] + (1 - jump) * here.moved[j]
            here.loose[j] += jump * (1 - jump) * apart
            chain.precision[at, j] = 1 / (usual[j] + here.loose[j])


@compiled
def _write_normalised(keyframe: Row, tilt: Array, normalised: Array) -> None:
    """Writes a prediction's error (6,) in camera axes, over its expected size."""
    error = np.empty(6)
    write_error(keyframe.state, keyframe.measured, error)
    error[_TILT[0]] -= tilt[0]
    error[_TILT[1]] -= tilt[1]
    for j in range(6):
        normalised[j] = 0.0
        for k in range(6):
            normalised[j] += keyframe.whitening[j, k] * error[k]


@inlined
def _write_sandwich(outer: Array, middle: Array, scale: float, result: Array, shape: tuple[int, int]) -> None:
    """Writes scale * outer @ middle @ outer.T, for outer of the shape and symmetric middle."""
    rows, columns = shape
    half = np.zeros((rows, columns))
    add_product(outer, middle, half, (rows, columns, columns), scale)
    clear(result, rows, rows)
    add_product(half, outer.T, result, (rows, columns, rows))


@inlined
def _expected(normalised: Array, spread: Array, precision: Array, first: int, end: int) -> float:
    """The squared error that is to be expected of some numbers of an error (6,) whose state spreads it by (6, 6), with
    the precision of these numbers."""
    squared = 0.0
    for j in range(first, end):
        for k in range(first, end):
            squared += precision[j - first, k - first] * (normalised[j] * normalised[k] + spread[j, k])
    return squared


@inlined
def _position_dof(model: Model, covariance: Array, spread: Array) -> float:
    """Degrees of freedom of the kernel of a position, of errors' covariance (6, 6) and the state's (6, 6) in their
    units. What is off is surely the prediction's fault where many agree on the state; where it is hardly better known
    than one prediction tells it, odometry may be to blame."""
    errors = unknown = 0.0
    for j in range(3, 6):
        errors += covariance[j, j]
        unknown += spread[j, j]
    return model.dof + (model.position_dof - model.dof) / (1 + _UNKNOWN * unknown / errors)


@inlined
def _write_weights(lengths: Array, model: Model, position_dof: float, weights: Array) -> None:
    """Writes what rotation and position count, (2,), by squared lengths (3,) of the whole error and of theirs. Where
    only one of both is gross, the other still says something."""
    for part in (ROTATION, POSITION):
        dof = position_dof if part == POSITION else model.dof
        whole = robust.bounded(lengths[0], DIMENSIONS, dof)
        marginal = robust.bounded(lengths[1 + part], DIMENSIONS // 2, dof)
        weights[part] = whole ** (1 - model.marginal[part]) * marginal ** model.marginal[part]


@inlined
def _write_weighed(precision: Array, weights: Array, fraction: float, weighed: Array) -> None:
    """Writes the precision (6, 6) of errors that say so much by themselves, and whose rotation and position count so
    much, (2,)."""
    rotation, position = sqrt(weights[ROTATION]), sqrt(weights[POSITION])
    for j in range(6):
        for k in range(6):
            count = (rotation if j < 3 else position) * (rotation if k < 3 else position)
            weighed[j, k] = fraction * count * precision[j, k]


@compiled
def _normal_equations(normalised: Array, unknown: Array, weighed: Array) -> tuple[Array, Array]:
    """The predictions' information (N, 4, 4) and gradient (N, 4); weighed (N, 6, 6): the errors' precisions."""
    count = len(weighed)
    information, gradient, pulled = np.empty((count, 4, 4)), np.zeros((count, 4)), np.empty(6)
    for i in range(count):
        _write_sandwich(unknown[i].T, weighed[i], 1.0, information[i], (4, 6))
        for j in range(6):
            pulled[j] = 0.0
            for k in range(6):
                pulled[j] += weighed[i, j, k] * normalised[i, k]
        for j in range(6):
            for k in range(4):
                gradient[i, k] += unknown[i, j, k] * pulled[j]
    return information, gradient


@compiled
def _tilt(keyframes: Rows, normalised: Array, weighed: Array, tilt: Array, sd: float) -> tuple[Array, float]:
    """Odometry's gravity error (2,) after one step from `tilt`, and its variance, given its sd beforehand."""
    information, gradient = np.zeros((2, 2)), np.empty(2)
    for j in range(2):
        information[j, j], gradient[j] = 1 / sd**2, -tilt[j] / sd**2
    for i in range(len(keyframes)):
        whitening = keyframes[i].whitening
        for j in range(2):
            for k in range(6):
                pulled = 0.0
                for m in range(6):
                    pulled += _GRAVITY * whitening[m, _TILT[j]] * weighed[i, m, k]
                gradient[j] += pulled * normalised[i, k]
                for m in range(2):
                    information[j, m] += pulled * whitening[k, _TILT[m]]
    invert(information)
    of = np.empty(2)
    for j in range(2):
        of[j] = tilt[j] + information[j, 0] * gradient[0] + information[j, 1] * gradient[1]
    return of, (information[0, 0] + information[1, 1]) / 2


@compiled
def _refresh(keyframes: Rows, covariance: Array) -> None:
    """Note the covariances (N, 4, 4) of some keyframes' states: of the newest always, of the others in turns."""
    count = len(keyframes)
    for i in range(count):
        keyframes[i].age += 1
    keyframes[-1].age = inf
    for _ in range(min(_REFRESHED, count)):
        oldest = 0
        for i in range(count):
            if keyframes[i].age > keyframes[oldest].age:
                oldest = i
        keyframes[oldest].age = 0
        for j in range(4):
            for k in range(4):
                keyframes[oldest].posterior[j, k] = covariance[oldest, j, k]
