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
_LEAST = 1e-3  # of what a prediction counts, so that each is bound to something


@dataclass(frozen=True)
class Model:
    """What the fit assumes.

    prior: of the covariance of normalised errors. dof: degrees of freedom of Student's t. independent: what one
    prediction counts of an independent one, as neighbours are wrong alike. apart_m: motion after which two predictions
    are half as good as two independent ones of that kind. shared: share of their errors that predictions of one place
    have in common, which fades over `shared_m`: bounds.
    """

    prior: Prior
    dof: float
    independent: float
    apart_m: float
    shared: float
    shared_m: float


@dataclass(frozen=True)
class Fit:
    """What an iteration found beside the keyframes' states.

    covariance (6, 6): of normalised errors. squared (N,): each keyframe's squared error in its units. counted (N,):
    what it says that its neighbour doesn't. weights (N,): what Student's t lets it count. gradient (N, 4), information
    (N, 4, 4), solution: the predictions' terms, and the step.
    """

    covariance: Array
    squared: Array
    counted: Array
    weights: Array
    gradient: Array
    information: Array
    solution: Solution


def chain_of(keyframes: Keyframes, distrust: Array) -> Chain:
    """Odometry's part of the problem, its variances `distrust` (4,) times the usual ones."""
    vio, segment = keyframes.column("vio"), keyframes.column("segment")
    step, precision = np.zeros((len(vio), 3)), np.zeros((len(vio), 4))
    step[1:] = vio[1:] - vio[:-1]
    precision[1:] = (segment[1:] == segment[:-1])[:, None] / (distrust * keyframes.column("drift")[1:])
    return Chain(step, precision)


def counted(along: Array, apart_m: float) -> Array:
    """How much of a prediction each says that isn't its neighbour's, (N,): those made standing still are one."""
    found = np.ones(len(along))
    gap = np.diff(along)
    found[1:] = np.maximum(gap / (gap + apart_m), _LEAST)
    return found


def innovation(keyframes: Keyframes, covariance: Array, known: Array) -> float:
    """Squared length of the newest prediction's error, for a state of covariance `known` (4, 4) before it."""
    state, measured = keyframes.column("state")[-1:], keyframes.column("measured")[-1:]
    whitening = keyframes.column("whitening")[-1].reshape(DIMENSIONS, DIMENSIONS)
    found = whitening @ errors(state[:, :3], state[:, 3], measured[:, :3], measured[:, 3], measured[:, 4:])[0]
    unknown = whitening[:, UNKNOWN]
    return float(found @ np.linalg.solve(covariance + unknown @ known @ unknown.T, found))


def iterate(keyframes: Keyframes, model: Model, covariance: Array, distrust: Array, newest: float | None = None) -> Fit:
    """One iteration: weights and covariance from the errors as they are, then one step of the keyframes' states.

    `distrust` (4,) multiplies the variances of odometry's drift. `newest` stands in for the newest keyframe's squared
    error in its weight: what odometry may have drifted meanwhile is no error of the prediction.
    """
    state, measured = keyframes.column("state"), keyframes.column("measured")
    whitening = keyframes.column("whitening").reshape(-1, DIMENSIONS, DIMENSIONS)
    position, yaw = state[:, :3], state[:, 3]
    found = errors(position, yaw, measured[:, :3], measured[:, 3], measured[:, 4:])
    normalised = (whitening @ found[:, :, None])[:, :, 0]
    share = counted(keyframes.column("along"), model.apart_m)
    squared = ((normalised @ np.linalg.inv(covariance)) * normalised).sum(axis=1)
    covariance = scatter(model.prior, normalised, share, robust.weights(squared, DIMENSIONS, model.dof))
    precision = np.linalg.inv(covariance)
    weighted = normalised @ precision
    squared = (weighted * normalised).sum(axis=1)
    judged = squared if newest is None else np.append(squared[:-1], newest)
    weights = robust.weights(judged, DIMENSIONS, model.dof)
    unknown = whitening[:, :, UNKNOWN]
    transposed = (model.independent * share * weights)[:, None, None] * unknown.transpose(0, 2, 1)
    information = transposed @ (precision @ unknown)
    gradient = (transposed @ weighted[:, :, None])[:, :, 0]
    solution = solve(chain_of(keyframes, distrust), position, yaw, information, gradient)
    state[:, :3], state[:, 3] = applied(position, yaw, solution.increments)
    return Fit(covariance, squared, share, weights, gradient, information, solution)
