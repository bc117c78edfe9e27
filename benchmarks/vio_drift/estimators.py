"""Estimators of the drift model's parameters from walks that pass the same tags again.

A walk that comes back to a tag needs no ground truth: the tag hangs where it hung. Each quantity that two passes share
(the height of a tag, the length and the heading of the way between two tags) is modelled as

    observation = value of the place + offset of the session + sum over effects of size_k * (effect with covariance K_k)

with free values and offsets, and the sizes have restricted maximum likelihood (Patterson and Thompson, Biometrika 58,
1971): the likelihood of what is left of the observations when the free values are projected out.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve
from scipy.optimize import brentq, minimize
from scipy.stats import chi2

from benchmarks.vio_drift.recordings import SteadyLog, TagWalk, TruthPair
from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.poses import Array, relative
from groundwalk.simulation.vio import wander_variance

# Between tags closer than this, where the tags are seen matters more than the drift.
_LEAST_SEGMENT_M = 4.0
# A profile of the log-likelihood falls by this much at one standard deviation.
_ONE_SIGMA = 0.5
_CHI2_SIGMA = (0.1587, 0.8413)

# A correction of position shows as a step between two frames at 60 Hz; below this, noise makes steps of its own.
JUMP_MIN_M = 0.006
_STEP_FRAMES = 6
_MAXWELL_MEDIAN = 1.5382


@dataclass(frozen=True)
class DriftEstimate:
    """A parameter with its 68 % interval and the number of independent samples (contrasts, sessions, frames, events).

    Where the interval reaches zero, `value` is its upper end and `best` is the most likely value: a bound, not a
    measurement.
    """

    best: float
    low: float
    high: float
    samples: int

    @classmethod
    def exactly(cls, value: float, samples: int = 0) -> "DriftEstimate":
        """A number without an interval: chosen, or taken from elsewhere."""
        return cls(value, value, value, samples)

    @property
    def value(self) -> float:
        return self.best if self.low > 0 else self.high

    def scaled(self, factor: float) -> "DriftEstimate":
        return DriftEstimate(self.best * factor, self.low * factor, self.high * factor, self.samples)


def sizes(observed: Array, free: Array, effects: Sequence[Array], *, intervals: bool = True) -> list[DriftEstimate]:
    """Restricted-maximum-likelihood sizes of effects in observations (N,) with a free linear part (N, P): standard
    deviations by which the effects' covariances (N, N) are scaled. Intervals come from the profile likelihood; without
    `intervals`, which is quicker, they are left at the value."""
    u, singular, _ = np.linalg.svd(free, full_matrices=True)
    contrasts = u[:, np.sum(singular > 1e-9 * singular[0]) :]
    y = contrasts.T @ observed
    # In units of each effect's own share of the observations all sizes are of order one.
    covariances = [contrasts.T @ k @ contrasts for k in effects]
    units = np.array([np.sqrt(np.mean(y**2) / (np.trace(k) / len(y))) for k in covariances])
    covariances = [k * unit**2 for k, unit in zip(covariances, units, strict=True)]

    def cost(log_sizes: Array) -> tuple[float, Array]:
        scaled = [np.exp(2 * s) * k for s, k in zip(log_sizes, covariances, strict=True)]
        factor = np.linalg.cholesky(sum(scaled) + 1e-12 * np.eye(len(y)))
        white = cho_solve((factor, True), y)
        inverse = cho_solve((factor, True), np.eye(len(y)))
        slope = np.array([np.sum(inverse * k) - white @ k @ white for k in scaled])
        return float(0.5 * y @ white + np.sum(np.log(np.diag(factor)))), slope

    bounds = (-7.0, 3.0)

    def best(fixed: dict[int, float], start: Array) -> tuple[float, Array]:
        limits = [(fixed[i], fixed[i]) if i in fixed else bounds for i in range(len(start))]
        optimum = minimize(cost, np.clip(start, *np.array(limits).T), jac=True, method="L-BFGS-B", bounds=limits)
        return float(optimum.fun), optimum.x

    least, at = best({}, np.full(len(units), np.log(0.5)))
    out = []
    for i, unit in enumerate(units):
        if not intervals:
            out.append(DriftEstimate.exactly(float(np.exp(at[i]) * unit), len(y)))
            continue

        def rise(log_size: float, i: int = i) -> float:
            return best({i: log_size}, at)[0] - least - _ONE_SIGMA

        low = np.exp(brentq(rise, bounds[0], at[i], xtol=1e-4)) if rise(bounds[0]) > 0 else 0.0
        high = np.exp(brentq(rise, at[i], bounds[1], xtol=1e-4))
        out.append(DriftEstimate(float(np.exp(at[i]) * unit), float(low * unit), float(high * unit), len(y)))
    return out


@dataclass(frozen=True, eq=False)
class Segments:
    """Ways from a tag to the next one visited, S of all walks: walk (S,), pair (S,) as an index, vector (S, 3) from the
    pair's lower to its higher tag, path_m (S,) walked, along_m (S,) of the middle."""

    walk: NDArray[np.int64]
    pair: NDArray[np.int64]
    vector: Array
    path_m: Array
    along_m: Array


def segments(walks: Sequence[TagWalk]) -> Segments:
    """The segments of all walks."""
    rows = []
    pairs: dict[tuple[int, int], int] = {}
    for w, walk in enumerate(walks):
        for i in range(len(walk.tag) - 1):
            a, b = int(walk.tag[i]), int(walk.tag[i + 1])
            path = walk.along_m[i + 1] - walk.along_m[i]
            vector = (walk.position[i + 1] - walk.position[i]) * (1 if a < b else -1)
            if a == b or path <= 0 or np.hypot(vector[0], vector[2]) < _LEAST_SEGMENT_M:
                continue
            pair = pairs.setdefault((min(a, b), max(a, b)), len(pairs))
            rows.append((w, pair, vector, path, (walk.along_m[i] + walk.along_m[i + 1]) / 2))
    walk_index, pair_index, vectors, paths, middles = zip(*rows, strict=True)
    return Segments(np.array(walk_index), np.array(pair_index), np.array(vectors), np.array(paths), np.array(middles))


@dataclass(frozen=True)
class PositionFit:
    """`scale`: relative, over sessions. `walk`: m/sqrt(m), each horizontal axis. `correlation_m`: see `fit_position`.
    `tag`: m, where a tag is seen."""

    scale: DriftEstimate
    walk: DriftEstimate
    tag: DriftEstimate
    correlation_m: float


def fit_position(walks: Sequence[TagWalk], rpe_m: float) -> PositionFit:
    """Scale and position errors from the lengths of segments that were walked more than once.

    Lengths of some metres say how fast errors grow over metres. How they begin within the first metre they can't tell:
    the correlation length is the one for which two poses 1 m of path apart have a horizontal root-mean-square error
    of rpe_m.
    """
    s = segments(walks)
    length = np.linalg.norm(s.vector, axis=1)
    place = _indicator(s.pair)
    session = _same(s.walk)

    def fit(correlation_m: float, *, intervals: bool) -> list[DriftEstimate]:
        walk = np.diag(wander_variance(s.path_m, correlation_m) / length**2)
        return sizes(np.log(length), place, [session, walk, np.diag(2 / length**2)], intervals=intervals)

    def excess(log_correlation: float) -> float:
        correlation_m = np.exp(log_correlation)
        walk = fit(correlation_m, intervals=False)[1].best
        return float(walk * np.sqrt(2 * wander_variance(1.0, correlation_m)) - rpe_m)

    correlation_m = float(np.exp(brentq(excess, np.log(0.1), np.log(30.0), xtol=1e-3)))
    scale, walk, tag = fit(correlation_m, intervals=True)
    return PositionFit(scale, walk, tag, correlation_m)


@dataclass(frozen=True)
class HeightFit:
    """`tilt`: rad, each horizontal axis, over sessions. `walk`: m/sqrt(m). `tag`: m."""

    tilt: DriftEstimate
    walk: DriftEstimate
    tag: DriftEstimate


def fit_height(walks: Sequence[TagWalk]) -> HeightFit:
    """Gravity and height errors from the heights at which the tags appear.

    A session's tilt shows in the tags' heights as a plane; its lever is where the session saw the tag first, before the
    yaw drifted much.
    """
    session = np.concatenate([np.full(len(w.tag), i) for i, w in enumerate(walks)])
    tag = np.concatenate([w.tag for w in walks])
    height = np.concatenate([w.position[:, 1] for w in walks])
    along = np.concatenate([w.along_m for w in walks])
    lever = np.concatenate([_first_seen(w) for w in walks])
    same = _same(session)
    effects = [same * (lever @ lever.T), same * np.minimum.outer(along, along), np.eye(len(tag))]
    free = np.concatenate([_indicator(tag), _indicator(session)], axis=1)
    return HeightFit(*sizes(height, free, effects))


@dataclass(frozen=True)
class YawFit:
    """`bias`: deg/m, over sessions. `walk`: deg/sqrt(m), over all sessions. `sideways`: m, of a segment's end.
    `spread`: over sessions, of the logarithm of the walk. `walk_by_session`: deg/sqrt(m), the bias within."""

    bias: DriftEstimate
    walk: DriftEstimate
    sideways: DriftEstimate
    spread: DriftEstimate
    walk_by_session: list[DriftEstimate]


def fit_yaw_drift(walks: Sequence[TagWalk]) -> YawFit:
    """Yaw errors from the headings of segments that were walked more than once."""
    s = segments(walks)
    heading = _unwrapped(np.degrees(np.arctan2(s.vector[:, 0], s.vector[:, 2])), s)
    across = np.diag(np.degrees(1 / np.hypot(s.vector[:, 0], s.vector[:, 2])) ** 2)
    drift = np.minimum.outer(s.along_m, s.along_m)
    same = _same(s.walk)
    free = np.concatenate([_indicator(s.pair), _indicator(s.walk)], axis=1)
    bias, walk, sideways = sizes(heading, free, [same * np.outer(s.along_m, s.along_m), same * drift, across])

    one_by_one = []
    for w in range(len(walks)):
        mine = s.walk == w
        grid = np.ix_(mine, mine)
        # The sideways noise is a matter of seeing tags; it takes all sessions to tell it from drift.
        effects = [drift[grid], across[grid]]
        one_by_one.append(sizes(heading[mine], np.c_[_indicator(s.pair[mine]), np.ones(mine.sum())], effects)[0])
    return YawFit(bias, walk, sideways, _log_spread(one_by_one), one_by_one)


def _log_spread(estimates: Sequence[DriftEstimate]) -> DriftEstimate:
    """Spread of the logarithm of a size over sessions, beyond what its uncertainty makes (method of moments)."""
    measured = [e for e in estimates if e.low > 0]
    logs = np.log([e.best for e in measured])
    noise = np.mean([(np.log(e.high / e.low) / 2) ** 2 for e in measured])
    degrees = len(measured) - 1
    variance = float(np.var(logs, ddof=1))
    low, high = (variance * degrees / chi2.ppf(q, degrees) for q in reversed(_CHI2_SIGMA))
    best, low, high = (float(np.sqrt(max(v - noise, 0.0))) for v in (variance, low, high))
    return DriftEstimate(best, low, high, len(measured))


@dataclass(frozen=True)
class SteadyFit:
    """White noise of a frame (m and deg, each axis) and corrections of at least JUMP_MIN_M: how many, in how long, and
    their mean length."""

    jitter_m: DriftEstimate
    jitter_deg: DriftEstimate
    jumps: int
    duration_s: float
    jump_mean_m: DriftEstimate


def fit_steady(logs: Sequence[SteadyLog]) -> SteadyFit:
    """Jitter and small jumps from poses at 60 Hz.

    Around each gap between two frames a cubic and a step are fitted to 12 positions; the step's length has a median
    that jitter makes, and peaks that corrections make. Rotation jitter is the median third difference. Both hold the
    hand's own tremble too: they are upper bounds.
    """
    basis = np.arange(-_STEP_FRAMES, _STEP_FRAMES) + 0.5
    design = np.c_[(basis[:, None] / _STEP_FRAMES) ** np.arange(4), basis > 0]
    row = np.linalg.pinv(design)[-1]
    all_steps, all_turns, peaks = [], [], []
    duration_s = 0.0
    for log in logs:
        gaps_ns = np.diff(log.t_ns)
        duration_s += float((log.t_ns[-1] - log.t_ns[0]) * 1e-9)
        position = log.world_T_cam[:, :3, 3]
        step = np.stack([np.convolve(position[:, i], row[::-1], "valid") for i in range(3)], axis=-1)
        # A dropped frame looks like a jump.
        windows = np.lib.stride_tricks.sliding_window_view(gaps_ns, 2 * _STEP_FRAMES - 1)
        size = np.where(windows.max(axis=1) < 1.5 * np.median(gaps_ns), np.linalg.norm(step, axis=1), 0.0)
        near = np.lib.stride_tricks.sliding_window_view(np.pad(size, _STEP_FRAMES), 2 * _STEP_FRAMES + 1).max(axis=1)
        peaks += list(size[(size == near) & (size >= JUMP_MIN_M)])
        all_steps.append(size)

        turns = relative(log.world_T_cam[:-1], log.world_T_cam[1:])[:, :3, :3]
        skew = np.stack(
            [turns[:, 2, 1] - turns[:, 1, 2], turns[:, 0, 2] - turns[:, 2, 0], turns[:, 1, 0] - turns[:, 0, 1]]
        )
        all_turns.append(np.linalg.norm(np.diff(skew.T / 2, n=2, axis=0), axis=1))

    steps, third = np.concatenate(all_steps), np.concatenate(all_turns)
    jitter_m = np.median(steps) / _MAXWELL_MEDIAN / np.linalg.norm(row)
    # A third difference has weights 1, 3, 3, 1.
    jitter_deg = np.degrees(np.median(third) / _MAXWELL_MEDIAN / np.sqrt(20))
    mean, error = float(np.mean(peaks)), float(np.std(peaks, ddof=1) / np.sqrt(len(peaks)))
    return SteadyFit(
        _precise(jitter_m, len(steps)),
        _precise(jitter_deg, len(third)),
        len(peaks),
        duration_s,
        DriftEstimate(mean, mean - error, mean + error, len(peaks)),
    )


def _precise(value: float, samples: int) -> DriftEstimate:
    """A robust spread: its median has a relative error of about 0.74 over the square root of the samples (Maxwell)."""
    error = value * 0.74 / np.sqrt(samples)
    return DriftEstimate(float(value), float(value - error), float(value + error), samples)


def rate(events: int, duration: float) -> DriftEstimate:
    """Events of a Poisson process a unit of duration, with the exact 68 % interval."""
    low = chi2.ppf(_CHI2_SIGMA[0], 2 * events) / 2 if events else 0.0
    high = chi2.ppf(_CHI2_SIGMA[1], 2 * (events + 1)) / 2
    return DriftEstimate(events / duration, float(low / duration), float(high / duration), events)


@dataclass(frozen=True)
class TruthCheck:
    """Odometry against motion capture: truth over odometry as a scale, positions' root-mean-square error after a Sim3
    fit and over 1 s (m), path (m)."""

    name: str
    scale: float
    rms_m: float
    rpe_1s_m: float
    path_m: float


def check_against_truth(pair: TruthPair) -> TruthCheck:
    """Compares a session with its ground truth; the two clocks' offset is the one with the least residual."""

    def aligned(offset_s: float) -> tuple[Array, Array, float]:
        t_s = pair.t_s + offset_s
        inside = (t_s >= pair.truth_t_s[0]) & (t_s <= pair.truth_t_s[-1])
        truth = np.stack([np.interp(t_s[inside], pair.truth_t_s, pair.truth_position[:, i]) for i in range(3)], axis=-1)
        fit = fit_sim3(truth, pair.position[inside])
        return t_s[inside], truth - fit.points(pair.position[inside]), fit.scale

    offsets = np.arange(-0.1, 0.1, 0.002)
    t_s, error, scale = aligned(min(offsets, key=lambda o: float(np.sum(aligned(o)[1] ** 2))))
    later = np.searchsorted(t_s, t_s + 1.0)
    pairs = later < len(t_s)
    rpe = np.linalg.norm(error[later[pairs]] - error[pairs], axis=1)
    return TruthCheck(
        pair.name,
        scale,
        float(np.sqrt(np.mean(np.sum(error**2, axis=1)))),
        float(np.sqrt(np.mean(rpe**2))),
        float(np.sum(np.linalg.norm(np.diff(pair.position, axis=0), axis=1))),
    )


def _first_seen(walk: TagWalk) -> Array:
    """Horizontal position (V, 2) at which the walk saw each visit's tag first, from their mean."""
    first = np.array([np.flatnonzero(walk.tag == tag)[0] for tag in walk.tag])
    lever = walk.position[first][:, [0, 2]]
    return lever - lever.mean(axis=0)


def _indicator(labels: NDArray[np.int64]) -> Array:
    return (labels[:, None] == np.unique(labels)).astype(float)


def _same(labels: NDArray[np.int64]) -> Array:
    return (labels[:, None] == labels[None]).astype(float)


def _wrapped(angle_deg: float) -> float:
    return (angle_deg + 180.0) % 360.0 - 180.0


def _unwrapped(heading_deg: Array, s: Segments) -> Array:
    """Headings (S,) less those of their place and session as first met, so that no difference crosses +-180 degrees."""
    of_place: dict[int, float] = {}
    out = np.zeros(len(heading_deg))
    for w in np.unique(s.walk):
        mine = np.flatnonzero(s.walk == w)
        known = [np.radians(heading_deg[i] - of_place[s.pair[i]]) for i in mine if s.pair[i] in of_place]
        offset = float(np.degrees(np.angle(np.mean(np.exp(1j * np.array(known)))))) if known else 0.0
        for i in mine:
            place = of_place.setdefault(s.pair[i], heading_deg[i] - offset)
            out[i] = _wrapped(heading_deg[i] - offset - place)
    return out
