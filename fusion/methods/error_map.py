"""What a regressor gets wrong, by place: learnt from frames that were held out of its training.

Some places are far harder than others, and on one walk a regressor's error changes smoothly as the camera moves and
turns. So frames of training walks that the regressor never learnt from tell what to expect of it on another walk: how
uncertain it is and, as far as errors are the same on another walk, which error.

The error is a Gaussian process (Rasmussen and Williams, 2006, chapters 2 and 5) over the *predicted* position and
viewing direction, which is what a phone has. Its size is another one, on the logarithm. How far both reach and how much
of the error is noise is what makes the held-out errors most likely. Nothing of a test walk goes in.

An error that frames of one walk share needn't be repeatable on another, with another light or a path some metres aside.
Leave-one-walk-out cross-validation tells: the mean error counts as far as the other walks' frames predict a walk's
errors.

A step to the side and a turn move an image nearly alike, and regressors take one for the other: an error to the side
comes with a yaw error, of some degrees a metre, as the scene is near or far. How many is fitted, too, and the Gaussian
process of yaw is one of what is left.
"""

from dataclasses import asdict, dataclass, replace
from math import exp, hypot, sqrt
from typing import NamedTuple, Self

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize
from scipy.special import polygamma, psi

from groundwalk.geometry.poses import Array
from groundwalk.geometry.rows import evenly

LEAST_FRAMES = 60
"""With fewer held-out frames there is no map: a few walks' worst views would stand for the whole place."""
_MOST_FRAMES = 200  # kept, evenly: a step looks at each of them
_FITTED_FRAMES = 120  # looked at to fit how far errors reach

_SLOPE_STEPS, _SLOPE_DOF = 20, 3.0
_LEAST_TRAINING = 10  # frames of other walks, for cross-validation
_SIGNIFICANT = 3.0  # standard errors: correcting an error that isn't repeatable makes fusion worse
_ALIKE = 4.0  # neighbouring frames whose errors are alike, and so tell what one does
_UPRIGHT = 0.1  # of the viewing direction's horizontal part: less has no side

_POSITION, _ANGLE = 0, 1
_GROUP = np.array([_ANGLE, _POSITION, _POSITION, _POSITION])  # of yaw, x, y, z
# A logarithm of a mean of three squared Gaussian errors: how far below the variance's it lies, and how it spreads.
_LOG_MEAN, _LOG_VARIANCE = float(psi(1.5) - np.log(1.5)), float(polygamma(1, 1.5))


class Expected(NamedTuple):
    """What to expect of a prediction; arrays (4,) are yaw (rad), x, y, z (m) in map axes.

    error: the mean error. shared: the variance of what is left, as far as neighbouring predictions share it. noise: the
    variance of what each has by itself; yaw's are of what `yaw_per_m` leaves, the yaw error (rad) that comes with a
    metre of error in x and in z. tilt: the variance of pitch and of roll (rad^2).
    """

    error: Array
    shared: Array
    noise: Array
    tilt: float
    yaw_per_m: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class Reach:
    """The fitted numbers: how far errors reach, how much their size varies over the map, and the share of noise."""

    length_m: float  # motion over which errors change
    length_look: float  # change of the viewing direction (a unit vector) over which they change
    size_variance: float  # over the map, of the logarithm of an error's variance
    position_noise: float  # share of a position error's variance that is new in each frame
    yaw_noise: float
    yaw_per_m: float  # yaw error, rad, that comes with a metre of error to the left of the viewing direction
    position_repeatability: float = 0.0  # share of the mean error that is the same on another walk
    yaw_repeatability: float = 0.0


class ErrorMap:
    """Held-out errors, ready to be asked about other predictions of the same regressor in the same scene."""

    def __init__(
        self,
        where: Array,
        error: Array,
        tilt: Array,
        walk: NDArray[np.object_] | None = None,
        reach: Reach | None = None,
    ) -> None:
        """where (N, 6): predicted position (m) and viewing direction; error (N, 4) and tilt (N,) as `errors_of` gives
        them; walk (N,): of which each is, all of one by default. Without `reach` it is fitted."""
        self.where, self.error, self.tilt = where, error, tilt
        _, x, y, z = error.T
        left = np.array([_leftwards(look) for look in where[:, 3:]])
        aside = np.einsum("ni,ni->n", left, error[:, 1::2])
        per_m = _slope(error[:, 0], aside) if reach is None else reach.yaw_per_m
        yaw = error[:, 0] - per_m * aside
        self._uncoupled = np.column_stack([yaw, error[:, 1:]])
        horizontal, vertical, angle, lean = (_variance(e) for e in (np.concatenate([x, z]), y, yaw, tilt / np.sqrt(2)))
        self._lean = lean
        self._units = np.sqrt([angle, horizontal, vertical, horizontal])
        sizes = ((x**2 + z**2) / horizontal + y**2 / vertical) / 3, (yaw**2 / angle + tilt**2 / lean) / 3
        self._logs = np.log(np.maximum(np.column_stack(sizes), 1e-6)) - _LOG_MEAN
        self._usual = self._logs.mean(axis=0)
        self.reach = reach or _fitted(where, self._uncoupled / self._units, self._logs - self._usual, per_m)
        K, scaled = self._prepare()
        if reach is None and walk is not None:
            position, yaw = (
                _repeatability(K, share, scaled[:, group == _GROUP], walk)
                for group, share in zip((_POSITION, _ANGLE), self._shares, strict=True)
            )
            self.reach = replace(self.reach, position_repeatability=position, yaw_repeatability=yaw)

    @classmethod
    def learnt(cls, map_T_cam_apr: ArrayLike, map_T_cam: ArrayLike, walk: ArrayLike) -> Self | None:
        """From predicted and true poses (N, 4, 4) of held-out frames, NaN where missing, and the walk of each (N,);
        None for too few."""
        apr, true = np.asarray(map_T_cam_apr, dtype=float), np.asarray(map_T_cam, dtype=float)
        there = np.flatnonzero(np.isfinite(apr).all(axis=(1, 2)) & np.isfinite(true).all(axis=(1, 2)))
        if len(there) < LEAST_FRAMES:
            return None
        kept = there[evenly(len(there), _MOST_FRAMES)]
        where = np.hstack([apr[kept, :3, 3], apr[kept, :3, 2]])
        return cls(where, *errors_of(apr[kept], true[kept]), np.asarray(walk, dtype=object)[kept])

    def _prepare(self) -> tuple[Array, Array]:
        """The kernel (N, N), and the errors (N, 4) in units of each frame's size."""
        r = self.reach
        K = _kernel(self.where, r)
        size_weights, logs = _leave_one_out(K, self._logs - self._usual, r.size_variance)
        self._shares = r.position_noise, r.yaw_noise
        # Position and yaw have the same kernel and other noise: along its eigenvectors both are diagonal.
        values, vectors = np.linalg.eigh(K)
        self._vectors = np.ascontiguousarray(vectors.T)
        precisions = [(1 - share) / ((1 - share) * np.maximum(values, 0.0) + share) for share in self._shares]
        scaled = self._uncoupled / self._units / np.exp(logs[:, _GROUP] / 2)
        weights = [precisions[g] * (self._vectors @ scaled[:, c]) for c, g in enumerate(_GROUP)]
        self._weights = np.column_stack([*weights, self._vectors @ (r.size_variance * size_weights)])
        self._precisions = np.column_stack(precisions)
        self._per_length = np.repeat([1 / r.length_m, 1 / r.length_look], 3)
        self._middle = self.where.mean(axis=0)
        self._features = (self.where - self._middle) * self._per_length
        self._half_squares = (self._features**2).sum(axis=1) / 2
        return K, scaled

    def expected(self, position: Array, look: Array) -> Expected:
        """Of a prediction at `position` (3,) in metres that looks along `look` (3,)."""
        at = (np.concatenate([position, look]) - self._middle) * self._per_length
        # -|at - there|^2 / 2
        k = self._vectors @ np.exp(self._features @ at - (self._half_squares + float(at @ at) / 2))
        *errors, log_position, log_angle = (k @ self._weights).tolist()
        known_position, known_angle = ((k * k) @ self._precisions).tolist()
        # In plain numbers: numpy takes longer for four of them.
        variance, angle_variance = exp(log_position + self._usual[_POSITION]), exp(log_angle + self._usual[_ANGLE])
        share, angle_share = self._shares
        corrected, angle_corrected = self.reach.position_repeatability, self.reach.yaw_repeatability
        left = (1 - share) * max(1 - corrected * known_position, 0.0)
        angle_left = (1 - angle_share) * max(1 - angle_corrected * known_angle, 0.0)
        size, angle_size = sqrt(variance), sqrt(angle_variance)
        square = self._units * np.array([angle_size, size, size, size])
        error = square * errors * np.array([angle_corrected, corrected, corrected, corrected])
        square *= square
        left_x, left_z = _leftwards(look)
        per_m = self.reach.yaw_per_m * left_x, self.reach.yaw_per_m * left_z
        error[0] += per_m[0] * error[1] + per_m[1] * error[3]
        return Expected(
            error,
            square * np.array([angle_left, left, left, left]),
            square * np.array([angle_share, share, share, share]),
            self._lean * angle_variance,
            per_m,
        )

    def table(self) -> pd.DataFrame:
        """What `from_table` makes the same map from: a row a held-out frame."""
        names = [*(f"apr_{a}_m" for a in "xyz"), *(f"look_{a}" for a in "xyz")]
        names += ["yaw_error_rad", *(f"{a}_error_m" for a in "xyz"), "tilt_error_rad"]
        rows = pd.DataFrame(np.column_stack([self.where, self.error, self.tilt]), columns=names)
        return rows.assign(**asdict(self.reach))

    @classmethod
    def from_table(cls, table: pd.DataFrame) -> Self:
        """The map of one scene and model from the rows that `table` gave."""
        numbers = table.drop(columns=list(Reach.__dataclass_fields__)).select_dtypes("number").to_numpy(float)
        reach = Reach(**{name: float(table[name].iloc[0]) for name in Reach.__dataclass_fields__})
        return cls(numbers[:, :6], numbers[:, 6:10], numbers[:, 10], reach=reach)


def errors_of(map_T_cam_apr: Array, map_T_cam: Array) -> tuple[Array, Array]:
    """Errors (N, 4) of predictions as yaw (rad), x, y, z (m) in map axes, and their tilt (N,), the angle in radians
    between the predicted and the true vertical. Poses (N, 4, 4)."""
    turn = map_T_cam_apr[:, :3, :3] @ map_T_cam[:, :3, :3].transpose(0, 2, 1)
    yaw = np.arctan2(turn[:, 0, 2] - turn[:, 2, 0], turn[:, 0, 0] + turn[:, 2, 2])
    upright = np.einsum("ni,ni->n", map_T_cam_apr[:, 1, :3], map_T_cam[:, 1, :3])
    return np.column_stack([yaw, map_T_cam_apr[:, :3, 3] - map_T_cam[:, :3, 3]]), np.arccos(np.clip(upright, -1, 1))


def _leftwards(look: Array) -> tuple[float, float]:
    """x and z of the horizontal unit vector to the left of a viewing direction (3,)."""
    x, _, z = look.tolist()
    length = max(hypot(x, z), _UPRIGHT)
    return z / length, -x / length


def _slope(y: Array, x: Array, sigmas: float = 1.0) -> float:
    """Slope of numbers (N,) over others (N,), as far as it is surely there.

    Robust (iterated weights of Student's t), and shrunk by its own uncertainty (James and Stein's positive part, of so
    many standard errors), for which a few neighbouring frames count as one.
    """
    slope, weight = 0.0, np.ones(len(y))
    for _ in range(_SLOPE_STEPS):
        power = float(weight @ x**2) + 1e-12
        slope = float(weight @ (y * x)) / power
        rest = y - slope * x
        weight = 1 / ((1 + rest**2 / _variance(rest) / _SLOPE_DOF) * (1 + x**2 / _variance(x) / _SLOPE_DOF))
    variance = _ALIKE * float(((weight * rest * x) ** 2).sum()) / power**2
    return slope * max(0.0, 1 - sigmas**2 * variance / (slope**2 + 1e-12))


def _variance(errors: Array) -> float:
    """Of the usual ones: a few huge errors hardly move it."""
    return float(np.median(np.abs(errors)) / 0.6745) ** 2 + 1e-12


def _kernel(where: Array, reach: Reach) -> Array:
    scaled = where / np.repeat([reach.length_m, reach.length_look], 3)
    square = (scaled**2).sum(axis=1)
    return np.asarray(np.exp(np.minimum(scaled @ scaled.T - (square[:, None] + square) / 2, 0.0)))


def _noisy(K: Array, share: float) -> Array:
    A = (1 - share) * K
    A[np.diag_indices_from(A)] += share
    return A


def _leave_one_out(K: Array, logs: Array, variance: float) -> tuple[Array, Array]:
    """Of the process on the sizes' logarithms (N, 2): its weights, and what it says of each frame without that frame
    (Rasmussen and Williams, equation 5.12)."""
    A = variance * K
    A[np.diag_indices_from(A)] += _LOG_VARIANCE
    inverse = np.linalg.inv(A)
    weights = inverse @ logs
    return weights, logs - weights / inverse.diagonal()[:, None]


def _repeatability(K: Array, noise: float, error: Array, walk: NDArray[np.object_]) -> float:
    """Share of the mean error that is the same on another walk: the slope of errors (N, D), in units of each frame's
    size, over those that the Gaussian process with kernel (N, N) predicts from the other walks' frames; walk (N,)."""
    predicted = np.zeros_like(error)
    for name in set(walk):
        of, others = walk == name, walk != name
        if others.sum() >= _LEAST_TRAINING:
            weights = np.linalg.solve(_noisy(K[np.ix_(others, others)], noise), error[others])
            predicted[of] = (1 - noise) * K[np.ix_(of, others)] @ weights
    return float(np.clip(_slope(error.ravel(), predicted.ravel(), _SIGNIFICANT), 0.0, 1.0))


def _fitted(where: Array, error: Array, logs: Array, yaw_per_m: float) -> Reach:
    """The numbers of greatest posterior probability for errors (N, 4) in units of their usual size."""
    rows = evenly(len(where), _FITTED_FRAMES)
    where, error, logs = where[rows], error[rows], logs[rows]
    extent = float(np.linalg.norm(np.ptp(where[:, :3], axis=0)))
    start = np.array([np.log(0.1 * extent + 0.1), 0.0, np.log(2.0), -2.0, -2.0])

    def cost(free: Array) -> float:
        reach = _reach(free, yaw_per_m)
        K = _kernel(where, reach)
        _, sizes = _leave_one_out(K, logs, reach.size_variance)
        total = float((((free - start) / _PRIOR_SD) ** 2).sum()) / 2
        for group, share in ((_POSITION, reach.position_noise), (_ANGLE, reach.yaw_noise)):
            columns = np.flatnonzero(group == _GROUP)
            factor = np.linalg.cholesky(_noisy(K, share))
            white = np.linalg.solve(factor, error[:, columns] / np.exp(sizes[:, group, None] / 2))
            determinant = 2 * np.log(factor.diagonal()).sum() + sizes[:, group].sum()
            total += float((white**2).sum() + len(columns) * determinant) / 2
        return total

    bounds = list(zip(start - 4 * _PRIOR_SD, start + 4 * _PRIOR_SD, strict=True))
    optimum = minimize(cost, start, method="L-BFGS-B", bounds=bounds, options={"maxiter": 20, "eps": 1e-4})
    return _reach(optimum.x, yaw_per_m)


_PRIOR_SD = np.array([1.0, 0.5, 0.4, 1.0, 1.0])


def _reach(free: Array, yaw_per_m: float) -> Reach:
    length_m, length_look, size_variance = np.exp(free[:3]).tolist()
    position_noise, yaw_noise = (1 / (1 + np.exp(-free[3:]))).tolist()
    return Reach(length_m, length_look, size_variance, position_noise, yaw_noise, yaw_per_m)
