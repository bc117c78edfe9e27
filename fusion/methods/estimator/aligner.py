"""The alignment of odometry with the map from kept predictions: solved anew, robustly, with each new one.

The estimate is the joint fit of alignment_chain.py to all keyframes, with what each prediction counts (Student's
t, robust.py) and the covariance of their errors (prediction_noise.py) fitted along: a prediction that
later ones contradict loses its say in hindsight. Each new prediction starts from the last solution, so that few
iterations do.
"""

from dataclasses import dataclass

import numpy as np

from groundwalk.fusion.methods.estimator import robust
from groundwalk.fusion.methods.estimator.alignment_chain import UNKNOWN, Chain, Solution, applied, errors, solve
from groundwalk.fusion.methods.estimator.keyframes import Keyframes
from groundwalk.fusion.methods.estimator.prediction_noise import Prior, scatter
from groundwalk.geometry.poses import Array

DIMENSIONS = 6
_MIN_COUNTED = 1e-3  # of what a prediction counts, so that each is bound to something
_TILT = [0, 2]  # of the six numbers of an error: those that odometry's gravity error changes
_GRAVITY = 0.1  # what a prediction counts for the tilt: predictions of a whole walk may lean alike
_REFRESHED = 5  # keyframes whose posterior is worked out anew in an iteration
_EXCESS = 0.3  # of a squared error that is too much for what is known, taken for the prediction's
_RECENT = 10  # keyframes that say how many predictions odometry lets one average over


@dataclass(frozen=True)
class Model:
    """What the fit assumes.

    prior: of the covariance of normalised errors. dof: degrees of freedom of Student's t. independent: what one
    prediction counts at least of an independent one, as neighbours are wrong alike. apart_m: motion after which two
    predictions are half as good as two independent ones of that kind. shared: fraction of their errors that predictions
    of one place have in common, which fades over `shared_m`: bounds. tilt_sd: of odometry's gravity error an axis, rad.
    """

    prior: Prior
    dof: float
    independent: float
    apart_m: float
    shared: float
    shared_m: float
    tilt_sd: float


@dataclass(frozen=True)
class Belief:
    """What the states are fitted under.

    covariance (6, 6): of normalised errors. tilt (2,): odometry's gravity error about its x and z, rad. distrust (4,):
    factors of the usual variances of odometry's drift.
    """

    covariance: Array
    tilt: Array
    distrust: Array


@dataclass(frozen=True)
class Fit:
    """What an iteration gives beside the keyframes' states.

    covariance (6, 6): of normalised errors. squared (N,): each keyframe's squared error in its units. counted (N,):
    what it says that its neighbours don't. weights (N,): what Student's t lets it count. gradient (N, 4), information
    (N, 4, 4), solution: the predictions' terms, and the step. tilt (2,) and its variance: odometry's gravity error.
    """

    covariance: Array
    squared: Array
    counted: Array
    weights: Array
    gradient: Array
    information: Array
    solution: Solution
    tilt: Array
    tilt_variance: float


def chain_of(keyframes: Keyframes, distrust: Array) -> Chain:
    """Odometry's part of the problem, its variances `distrust` (4,) times the usual ones."""
    precision = 1 / (distrust * keyframes.column("drift") + keyframes.column("loose"))
    precision[0] = 0.0
    return Chain(keyframes.column("step"), keyframes.column("turn"), precision)


def counted(along: Array, apart_m: float) -> Array:
    """How much of a prediction each says that isn't its neighbour's, (N,): those made standing still are one."""
    fraction = np.ones(len(along))
    gap = np.diff(along)
    fraction[1:] = np.maximum(gap / (gap + apart_m), _MIN_COUNTED)
    return fraction


def independent(keyframes: Keyframes, model: Model, belief: Belief, precision: Array) -> float:
    """What a prediction counts of an independent one. Predictions share errors with those that they are averaged with:
    about as many as their sd is larger than what odometry drifts from one to the next."""
    if len(keyframes) < 2:
        return model.independent
    horizontal = keyframes.column("whitening")[-_RECENT:].reshape(-1, DIMENSIONS, DIMENSIONS)[:, :, UNKNOWN[:3:2]]
    information = ((precision @ horizontal) * horizontal).sum(axis=(1, 2)) / 2
    drift = belief.distrust[0] * keyframes.column("drift")[-_RECENT:, 0]
    seen = slice(1 if len(keyframes) <= _RECENT else 0, None)
    averaged = np.exp(-0.5 * np.log(information[seen] * drift[seen]).mean())
    return float(max(model.independent, 1 / (1 + averaged)))


def innovation(keyframes: Keyframes, belief: Belief, known: Array) -> float:
    """Squared length of the newest prediction's error that is to be expected once it is taken in, for a state of
    covariance `known` (4, 4) before it. What may be odometry's drift is no error of the prediction, and doesn't show
    that it is a good one either; what is too much for both is an error."""
    state, measured = keyframes.column("state")[-1:], keyframes.column("measured")[-1:]
    whitening = keyframes.column("whitening")[-1].reshape(DIMENSIONS, DIMENSIONS)
    error = errors(state[:, :3], state[:, 3], measured[:, :3], measured[:, 3], measured[:, 4:])[0]
    error[_TILT] -= belief.tilt
    unknown = whitening[:, UNKNOWN]
    error = whitening @ error
    precision = np.linalg.inv(belief.covariance + unknown @ known @ unknown.T)
    left = precision @ error
    expected = left @ belief.covariance @ left + DIMENSIONS - (precision * belief.covariance).sum()
    return float(max(expected, _EXCESS * (error @ left)))


def iterate(keyframes: Keyframes, model: Model, belief: Belief, newest: float | None = None) -> Fit:
    """One iteration: weights and covariance from the errors as they are expected (expectation and maximisation: an
    error is what is left of the prediction, and how uncertain the state is), then one step of the keyframes' states.

    `newest` stands in for the newest keyframe's squared error in its weight (`innovation`).
    """
    state, measured = keyframes.column("state"), keyframes.column("measured")
    whitening = keyframes.column("whitening").reshape(-1, DIMENSIONS, DIMENSIONS)
    position, yaw = state[:, :3], state[:, 3]
    left = errors(position, yaw, measured[:, :3], measured[:, 3], measured[:, 4:])
    left[:, _TILT] -= belief.tilt
    normalised = (whitening @ left[:, :, None])[:, :, 0]
    unknown = whitening[:, :, UNKNOWN]
    fraction = counted(keyframes.column("along"), model.apart_m)
    precision = np.asarray(np.linalg.inv(belief.covariance), dtype=float)
    each = independent(keyframes, model, belief, precision)
    posterior = keyframes.column("posterior").reshape(-1, 4, 4)
    spread = each * (unknown @ posterior @ unknown.transpose(0, 2, 1))
    squared = _expected(normalised, spread, precision)
    weights = robust.weights(squared, DIMENSIONS, model.dof)
    covariance = scatter(model.prior, normalised, spread, fraction, weights)
    precision = np.asarray(np.linalg.inv(covariance), dtype=float)
    squared = _expected(normalised, spread, precision)
    judged = squared if newest is None else np.append(squared[:-1], newest)
    weights = robust.weights(judged, DIMENSIONS, model.dof)
    fraction = each * fraction
    weighed = (fraction * weights)[:, None, None]
    pulled = precision @ normalised[:, :, None]
    transposed = weighed * unknown.transpose(0, 2, 1)
    information, gradient = transposed @ (precision @ unknown), (transposed @ pulled)[:, :, 0]
    level = whitening[:, :, _TILT]
    transposed = _GRAVITY * weighed * level.transpose(0, 2, 1)
    of_tilt = np.linalg.inv((transposed @ (precision @ level)).sum(axis=0) + np.eye(2) / model.tilt_sd**2)
    tilt = belief.tilt + of_tilt @ ((transposed @ pulled)[:, :, 0].sum(axis=0) - belief.tilt / model.tilt_sd**2)
    solution = solve(chain_of(keyframes, belief.distrust), position, yaw, information, gradient)
    state[:, :3], state[:, 3] = applied(position, yaw, solution.increments)
    _refresh(keyframes, solution)
    return Fit(covariance, squared, fraction, weights, gradient, information, solution, tilt, of_tilt.trace() / 2)


def _expected(normalised: Array, spread: Array, precision: Array) -> Array:
    """Squared errors (N,) that are to be expected of errors (N, 6) whose states spread them by (N, 6, 6)."""
    flat = spread.reshape(len(spread), -1) @ precision.ravel()
    return np.asarray(((normalised @ precision) * normalised).sum(axis=1) + flat)


def _refresh(keyframes: Keyframes, solution: Solution) -> None:
    """Work out the covariance of some keyframes' states: of the newest always, of the others in turns."""
    posterior, age = keyframes.column("posterior"), keyframes.column("age")
    age += 1
    rows = np.argsort(-age, kind="stable")[: _REFRESHED - 1] if len(age) > _REFRESHED else np.arange(len(age))
    rows = np.append(rows[rows != len(age) - 1], len(age) - 1)
    posterior[rows] = solution.covariances(rows).reshape(-1, 16)
    age[rows] = 0
