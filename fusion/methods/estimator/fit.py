"""The alignment of odometry with the map from kept predictions: solved anew, robustly, with each new one.

The estimate is the joint fit of chain.py to all keyframes, with what each prediction counts (robust.py) and the
covariance of their errors (error_covariance.py) fitted along: a prediction that later ones contradict loses its weight.
Each new prediction starts from the last solution, so that few iterations do.
"""

from math import cos, exp, isnan, log, nan, sin
from typing import NamedTuple

import numpy as np

from groundwalk.fusion.methods.estimator import robust
from groundwalk.fusion.methods.estimator.chain import (
    UNKNOWN,
    Chain,
    Solution,
    apply,
    covariances_with,
    solve,
    write_error,
)
from groundwalk.fusion.methods.estimator.compiled import (
    Row,
    Rows,
    add_product,
    clear,
    compiled,
    inlined,
    invert,
    write_columns,
)
from groundwalk.fusion.methods.estimator.odometry_step import CERTAIN
from groundwalk.fusion.methods.estimator.prediction_errors import (
    Prior,
    effective_weights,
    error_correlations,
    expected_variances,
    position_variances,
    scatter,
)
from groundwalk.geometry.poses import Array, yaw_rotation

DIMENSIONS = 6
_DECIDED = 10  # newest keyframes of which it is asked whether odometry jumped before
_UNBOUND = 1e4  # variance (m^2) of a step of which nothing is known
DOF = 3.0  # of the errors' Student's t: heavy tails, as outliers are neither rare nor of a known size
_LEAST_WEIGHT = 0.01  # of the prediction that counts most: where all contradict each other, some of them hold the walk
_EXCESS = 0.3  # of a squared error that is too much for what is known, taken for the prediction's


class Belief(NamedTuple):
    """What the states are fitted under.

    prior: of the covariance of normalised errors. covariance (6, 6): as it is so far. drift_factors (4,): of the usual
    variances of odometry's drift. lean (2,): of odometry's vertical against the map's, about odometry's x and z (rad),
    as it is so far, and lean_variance an axis beforehand.
    """

    prior: Prior
    covariance: Array
    drift_factors: Array
    lean: Array
    lean_variance: float


class Fit(NamedTuple):
    """What an iteration gives beside the keyframes' states.

    covariance (6, 6): of normalised errors. squared (N,): each keyframe's squared error in its units. weights (N,):
    what the robust kernel lets each count; effective (N,): what it says that others don't. correlation (N, N): of
    errors, below the diagonal. information (N, 4, 4) and solution: the predictions' terms, and the step. lean (2,) and
    lean_variance: as known now.
    """

    covariance: Array
    squared: Array
    weights: Array
    effective: Array
    correlation: Array
    information: Array
    solution: Solution
    lean: Array
    lean_variance: float


@compiled
def innovation(keyframes: Rows, belief: Belief, known: Array) -> float:
    """Squared length of the newest prediction's error that is to be expected once it is taken in, for a state of
    covariance `known` (4, 4) at the one before. What may be odometry's drift is no error of the prediction, and doesn't
    show that it is a good one either; what is too much for both is an error."""
    newest = keyframes[-1]
    known = known.copy()
    for j in range(4):  # the yaw before turns the step
        known[0, j] += newest.step[2] * known[3, j]
        known[2, j] -= newest.step[0] * known[3, j]
    for j in range(4):
        known[j, 0] += newest.step[2] * known[j, 3]
        known[j, 2] -= newest.step[0] * known[j, 3]
    for j in range(4):
        known[j, j] += belief.drift_factors[j] * newest.drift[j] + newest.added_variance[j]
    normalised, unknown, spread = np.empty(6), np.empty((6, 4)), np.empty((6, 6))
    _write_normalised(newest, belief.lean, normalised)
    write_columns(newest.whitening, UNKNOWN, unknown, 6)
    _write_sandwich(unknown, known, 1.0, spread, (6, 4))
    precision, left = belief.covariance + spread, np.zeros(6)
    invert(precision)
    expected = error = 0.0
    for j in range(6):
        for k in range(6):
            left[j] += precision[j, k] * normalised[k]
            expected += precision[j, k] * spread[j, k]  # dimensions, less the trace with the errors' own
        error += normalised[j] * left[j]
    for j in range(6):
        for k in range(6):
            expected += left[j] * belief.covariance[j, k] * left[k]
    return max(expected, _EXCESS * error)


@compiled
def iterate(keyframes: Rows, belief: Belief, newest: float = nan) -> Fit:
    """One iteration: weights and covariance from the errors as they are expected (expectation and maximisation: an
    error is what is left of the prediction, and how uncertain the state is), then one step of the keyframes' states.

    `newest` stands in for the newest keyframe's squared error in its weight (`innovation`).
    """
    count = len(keyframes)
    normalised, unknown, spread = np.empty((count, 6)), np.empty((count, 6, 4)), np.empty((count, 6, 6))
    precision = belief.covariance.copy()
    invert(precision)
    variances = position_variances(keyframes, belief.covariance)
    correlation = error_correlations(keyframes, variances)
    effective = effective_weights(keyframes, variances, correlation, belief.drift_factors[0])
    squared, weights = np.empty(count), np.empty(count)
    for i in range(count):
        _write_normalised(keyframes[i], belief.lean, normalised[i])
        write_columns(keyframes[i].whitening, UNKNOWN, unknown[i], 6)
        _write_sandwich(unknown[i], keyframes[i].posterior, effective[i], spread[i], (6, 4))
        weights[i] = robust.weight(_expected(normalised[i], spread[i], precision), DIMENSIONS, DOF)
    covariance = scatter(belief.prior, normalised, spread, weights)
    precision = covariance.copy()
    invert(precision)
    for i in range(count):
        squared[i] = _expected(normalised[i], spread[i], precision)
        expected = newest if i == count - 1 and not isnan(newest) else squared[i]
        weights[i] = robust.bounded(expected, DIMENSIONS, DOF)
    weights *= max(1.0, _LEAST_WEIGHT / weights.max())
    information, gradient = _normal_equations(normalised, unknown, precision, effective * weights)
    chain = _chain(keyframes, belief.drift_factors)
    for i in range(max(1, count - _DECIDED), count):
        if abs(keyframes[i].odds) < CERTAIN:
            _weigh_jump(keyframes, chain, i, information, gradient)
    solution = solve(chain, keyframes["state"], information, gradient)
    apply(keyframes["state"], solution.increments)
    for i in range(count):
        keyframes[i].posterior[:] = solution.covariance[i]
    lean, lean_variance = _lean(keyframes, covariance, effective * weights, belief.lean_variance)
    return Fit(covariance, squared, weights, effective, correlation, information, solution, lean, lean_variance)


@compiled
def _lean(keyframes: Rows, covariance: Array, weights: Array, variance: float) -> tuple[Array, float]:
    """The lean (2,) of odometry's vertical that predictions name, and its variance an axis, which was `variance`. All
    predictions of a walk may lean alike, so that their mean is no better than one of them, and a little more."""
    mean, error, total, precision = np.zeros(2), np.empty(6), 0.0, 0.0
    factor = (covariance[0, 0] + covariance[1, 1] + covariance[2, 2]) / 3
    for i in range(len(keyframes)):
        write_error(keyframes[i].state, keyframes[i].measured, error)
        counts = weights[i] / (factor * expected_variances(keyframes[i].whitening)[1])
        mean[0] += counts * error[0]
        mean[1] += counts * error[2]
        total += weights[i]
        precision += counts
    gain = variance / (variance + (1 + total) / precision)
    return gain * mean / precision, (1 - gain) * variance


@compiled
def _chain(keyframes: Rows, drift_factors: Array) -> Chain:
    """Odometry's part of the problem, its variances `drift_factors` (4,) times the usual ones."""
    count = len(keyframes)
    chain = Chain(np.empty((count, 3)), np.empty(count), np.zeros((count, 4)))
    for i in range(count):
        here = keyframes[i]
        chain.turn[i] = here.turn
        for j in range(3):
            chain.step[i, j] = here.step[j]
        if i > 0:
            for j in range(4):
                chain.precision[i, j] = 1 / (drift_factors[j] * here.drift[j] + here.added_variance[j])
    return chain


@compiled
def _weigh_jump(keyframes: Rows, chain: Chain, at: int, information: Array, gradient: Array) -> None:
    """Judge by the predictions before and after whether odometry has jumped on the way to a keyframe, and write to it
    and to the chain what step is to be expected."""
    here, usual = keyframes[at], np.empty(3)
    for j in range(3):
        usual[j] = 1 / chain.precision[at, j] - here.added_variance[j]
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
        here.added_variance[j] = jump * here.bridge[j]
        if j < 3:
            here.step[j] = chain.step[at, j] = jump * here.bridged[j] + (1 - jump) * here.moved[j]
            here.added_variance[j] += jump * (1 - jump) * apart
            chain.precision[at, j] = 1 / (usual[j] + here.added_variance[j])


@compiled
def _write_normalised(keyframe: Row, lean: Array, normalised: Array) -> None:
    """Writes a prediction's error (6,) in camera axes, over its expected size. lean (2,): odometry's."""
    error = np.empty(6)
    write_error(keyframe.state, keyframe.measured, error)
    error[0] -= lean[0]
    error[2] -= lean[1]
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
def _expected(normalised: Array, spread: Array, precision: Array) -> float:
    """The squared error that is to be expected of an error (6,) whose state spreads it by (6, 6)."""
    squared = 0.0
    for j in range(6):
        for k in range(6):
            squared += precision[j, k] * (normalised[j] * normalised[k] + spread[j, k])
    return squared


@compiled
def _normal_equations(normalised: Array, unknown: Array, precision: Array, weights: Array) -> tuple[Array, Array]:
    """The predictions' information (N, 4, 4) and gradient (N, 4)."""
    count = len(weights)
    information, gradient = np.empty((count, 4, 4)), np.zeros((count, 4))
    for i in range(count):
        _write_sandwich(unknown[i].T, precision, weights[i], information[i], (4, 6))
        for j in range(6):
            pulled = 0.0
            for k in range(6):
                pulled += weights[i] * precision[j, k] * normalised[i, k]
            for k in range(4):
                gradient[i, k] += unknown[i, j, k] * pulled
    return information, gradient


def alignment_covariance(keyframes: Rows, fit: Fit, index: int) -> Array:
    """Covariance (4, 4) of the `index`th keyframe's x, y, z and yaw, in map axes.

    The fit takes predictions for independent ones that count less. What it is worth hangs on how their errors are
    really correlated. This is the covariance of the fit's linear response to such errors (a sandwich, as of generalised
    estimating equations; Liang and Zeger, Biometrika 73, 1986).
    """
    response = covariances_with(fit.solution, index)  # (N, 4, 4): of increments to a keyframe's gradient
    # What an error of each of a prediction's six numbers, over its size, does to the state, (N, 6, 4).
    counts = fit.effective * np.sqrt(fit.weights)
    moved = counts[:, None, None] * keyframes["whitening"][:, :, UNKNOWN] @ response
    correlation = fit.correlation + fit.correlation.T + np.eye(len(keyframes))
    together = np.tensordot(correlation, moved, 1)
    by_errors = np.tensordot(moved, np.linalg.inv(fit.covariance) @ together, ((0, 1), (0, 1)))
    by_drift = response[index] - np.tensordot(response, fit.information @ response, ((0, 1), (0, 1)))
    turn = np.eye(4)
    turn[:3, :3] = yaw_rotation(keyframes["state"][index, 3])
    covariance = turn @ (by_drift + by_errors) @ turn.T
    return np.asarray(covariance + covariance.T) / 2
