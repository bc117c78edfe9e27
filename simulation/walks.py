"""Hand-held walks: a course through a place, walked with gait, pauses and looking around."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from scipy.interpolate import CubicSpline, make_interp_spline
from scipy.ndimage import gaussian_filter1d

from groundwalk.geometry.poses import Array, make_pose, path_length
from groundwalk.simulation.place import UP, Place, Route, Vec

MARGIN_M = 0.35  # kept from everything solid
EYE_M = 1.5
_STEP_M = 0.05
_TICK_S = 1 / 60
_GAIT_HZ = 1.8
_FAR_DEG = (40.0, 110.0)


@dataclass(frozen=True)
class PlannedWalk:
    """Where a camera is and looks at any time from 0 to duration_s: splines with continuous velocity."""

    duration_s: float
    position: CubicSpline
    angles: CubicSpline

    def world_T_cam(self, t_s: Vec) -> Vec:
        """Poses (N, 4, 4), OpenCV camera axes."""
        yaw, pitch, roll = self.angles(t_s).T
        forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(pitch), np.sin(yaw) * np.cos(pitch)], axis=1)
        level = np.stack([-np.sin(yaw), np.zeros_like(yaw), np.cos(yaw)], axis=1)
        down = np.cross(forward, level)
        c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
        right = c * level + s * down
        return make_pose(np.stack([right, np.cross(forward, right), forward], axis=2), self.position(t_s))


def plan_walk(route: Route, place: Place, duration_s: float, side: float, start: float, rng: Generator) -> PlannedWalk:
    """A walk of duration_s along the route, round after round.

    `side` (-1 to 1) is which side of the course the walker prefers, `start` (0 to 1) where on it he begins. The
    course is the same function of chance for the same arguments. Raises ValueError where the course itself, without
    any sideways freedom, runs into something.
    """
    course = _Course(route)
    start_m = start * course.length_m
    offset = _offsets(course, route, place, side, start_m + 1.2 * route.speed_mps * (duration_s + 4), rng)
    clock = _clock(course, route, offset, start_m, duration_s + 1.0, rng)
    t = np.arange(-1.0, duration_s + 1.0, _TICK_S)
    s = clock(t)
    pace = clock(t, 1) / route.speed_mps

    position = course.place(s, offset)
    phase = 2 * math.pi * _GAIT_HZ * t + rng.uniform(0, 6)
    vigour = np.clip(np.abs(pace), 0, 1)
    sideways = course.left(s)
    position[:, 1] += EYE_M + rng.uniform(-0.08, 0.08) + 0.018 * vigour * np.sin(phase)
    position[:, 1] += 0.03 * wander(t, 0.02, 0.1, rng)
    position += (0.015 * vigour * np.sin(phase / 2))[:, None] * sideways

    yaw = course.gaze(s) + math.radians(route.look_deg) * wander(t, 0.03, 0.16, rng)
    yaw += _glances(t, duration_s, route, rng)
    pitch = math.radians(route.tilt_deg) + math.radians(2.5) * wander(t, 0.05, 0.3, rng) + course.slope(s) * 0.4
    roll = math.radians(1.3) * wander(t, 0.05, 0.4, rng)
    shake = vigour * math.radians(0.25)
    pitch += shake * np.sin(phase + 0.7)
    roll += shake * np.sin(phase / 2 + 0.3)
    yaw += shake * np.sin(phase / 2 + 1.1) + math.radians(0.06) * wander(t, 2, 6, rng)
    return PlannedWalk(duration_s, CubicSpline(t, position), CubicSpline(t, np.stack([yaw, pitch, roll], axis=1)))


class _Course:
    """A route as smooth closed functions of the distance walked along it."""

    def __init__(self, route: Route) -> None:
        points = np.array([(p[0], p[3] if len(p) > 3 else 0.0, p[1]) for p in route.points])
        gaze = np.radians([p[2] for p in route.points])
        closed = np.vstack([points, points[:1]])
        chord = np.concatenate([[0], np.cumsum(np.sqrt(np.linalg.norm(np.diff(closed[:, [0, 2]], axis=0), axis=1)))])
        curve = make_interp_spline(chord, closed, k=3, bc_type="periodic")
        fine = np.linspace(0, chord[-1], 4000)
        xyz = curve(fine)
        # Heights follow the stairs piece by piece; a cubic would swing over at their ends.
        along = path_length(xyz[:, [0, 2]])
        marks = np.interp(chord, fine, along)
        self.length_m = float(along[-1])
        count = max(50, round(self.length_m / _STEP_M))
        grid = np.linspace(0, self.length_m, count + 1)
        flat = np.stack([np.interp(grid, along, xyz[:, k]) for k in (0, 2)], axis=1)
        height = _smooth_closed(np.interp(grid[:-1], marks, closed[:, 1]), 0.25 / self.length_m * count)
        ahead = np.roll(flat[:-1], -1, axis=0) - np.roll(flat[:-1], 1, axis=0)
        heading = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
        turns = round((heading[-1] - heading[0]) / (2 * math.pi)) * 2 * math.pi
        offset = np.interp(grid[:-1], marks, np.append(gaze, gaze[0]))
        ramp = turns * grid[:-1] / self.length_m
        # To the left of the way ahead is towards smaller yaw: yaw runs from +x to +z, clockwise seen from above.
        look = ramp + _smooth_closed(heading - offset - ramp, 1.6 / self.length_m * count)
        self._turns = turns
        self._flat = self._periodic(grid, flat[:-1])
        self._height = self._periodic(grid, height)
        self._heading = self._periodic(grid, heading - ramp)
        self._look = self._periodic(grid, look - ramp)

    @staticmethod
    def _periodic(grid: Vec, values: Vec) -> CubicSpline:
        return CubicSpline(grid, np.concatenate([values, values[:1]]), bc_type="periodic")

    def place(self, s: Vec, offset: Callable[[Vec], Vec]) -> Vec:
        """Points (N, 3) on the floor at distances s, moved to the left by `offset`."""
        x, z = self._flat(s).T
        return np.stack([x, self._height(s), z], axis=1) + offset(s)[:, None] * self.left(s)

    def left(self, s: Vec) -> Vec:
        """Unit vectors (N, 3) to the left of the way."""
        d = self._flat(s, 1)
        left = np.stack([d[:, 1], np.zeros(len(d)), -d[:, 0]], axis=1)
        return left / np.linalg.norm(left, axis=1, keepdims=True)

    def gaze(self, s: Vec) -> Vec:
        """Where one looks, as a continuous yaw in radians."""
        return self._look(s) + self._turns * s / self.length_m

    def slope(self, s: Vec) -> Vec:
        """Rise of the floor per metre walked, as an angle."""
        return np.arctan(self._height(s, 1))

    def bend(self, s: Vec) -> Vec:
        """How fast the gaze or the way turns, radians a metre."""
        per_m = self._turns / self.length_m
        return np.maximum(np.abs(self._look(s, 1) + per_m), np.abs(self._heading(s, 1) + per_m))


def _smooth_closed(values: Vec, sigma: float) -> Vec:
    """A closed sequence smoothed by a Gaussian of `sigma` samples."""
    spectrum = np.fft.rfft(values)
    frequency = np.fft.rfftfreq(len(values))
    return np.fft.irfft(spectrum * np.exp(-2 * (math.pi * sigma * frequency) ** 2), len(values))


def _offsets(course: _Course, route: Route, place: Place, side: float, reach_m: float, rng: Generator) -> CubicSpline:
    """Metres to the left of the course, as a function of the distance, drawn in wherever something stands there."""
    knots = np.linspace(-8.0, reach_m + 8.0, max(8, round(reach_m / 4)))
    wish = route.spread_m * np.clip(0.75 * side + 0.3 * rng.standard_normal(len(knots)), -1, 1)
    damping = np.ones(len(knots))
    fine = np.arange(knots[0], knots[-1], 2 * _STEP_M)
    owner = np.round((fine - knots[0]) / (knots[1] - knots[0])).astype(int)
    for _ in range(30):
        offset = CubicSpline(knots, wish * damping)
        feet = course.place(fine, offset)
        near = np.minimum(*(place.clearance_m(feet + h * UP) for h in (0.9, EYE_M))) < MARGIN_M
        if not near.any():
            return offset
        touched = np.unique(owner[near])
        for k in (-1, 0, 1):
            damping[np.clip(touched + k, 0, len(knots) - 1)] *= 0.7
    worst = feet[near][0]
    raise ValueError(f"the course through {place.name} is too narrow near x {worst[0]:.2f}, z {worst[2]:.2f}")


def _clock(
    course: _Course, route: Route, offset: CubicSpline, start_m: float, duration_s: float, rng: Generator
) -> CubicSpline:
    """Distance along the course as a smooth function of time: slower in bends, with pauses."""
    times = np.arange(-2.0, duration_s + 2.0, 0.1)
    mood = 1 + 0.08 * np.clip(wander(times, 0.02, 0.1, rng), -1.5, 1.5)
    for moment in np.arange(rng.uniform(8, 25), duration_s, 25):
        mood *= 1 - 0.9 * np.exp(-(((times - moment - rng.uniform(-6, 6)) / 1.2) ** 2))
    reach = start_m + route.speed_mps * 1.2 * np.array([-3.0, duration_s + 3.0])
    grid = np.arange(reach[0], reach[1], 2 * _STEP_M)
    lengthening = np.linalg.norm(np.gradient(course.place(grid, offset), grid, axis=0), axis=1)
    pace = np.minimum(route.speed_mps, math.radians(route.turn_deg_s) / course.bend(grid)) / lengthening
    pace = gaussian_filter1d(pace, 0.6 / (2 * _STEP_M))
    s = np.full(len(times), start_m)
    for k in range(1, len(times)):
        s[k] = s[k - 1] + 0.1 * mood[k] * np.interp(s[k - 1], grid, pace)
    return CubicSpline(times, s)


def _glances(t: Vec, duration_s: float, route: Route, rng: Generator) -> Vec:
    """Looks aside and back, a few a minute. Some go far aside, to where no other walk may have looked from there:
    it's in such views that regressors fail by metres, and that gives their errors the long tail that real ones have."""
    yaw = np.zeros_like(t)
    for moment in np.arange(rng.uniform(4, 14), duration_s, 14):
        middle, side = moment + rng.uniform(-4, 4), rng.choice([-1, 1])
        far = rng.random() < route.far_glances
        reach_deg = rng.uniform(*_FAR_DEG) if far else rng.uniform(8, 22)
        half = max(rng.uniform(1.2, 2.2), reach_deg / route.turn_deg_s)
        yaw += math.radians(side * reach_deg) * np.exp(-(((t - middle) / half) ** 2))
    return yaw


def wander(t_s: Array, low_hz: float, high_hz: float, rng: Generator) -> Array:
    """Smooth noise (N,) of about unit deviation with frequencies from low to high."""
    n = 9
    frequency = np.exp(rng.uniform(math.log(low_hz), math.log(high_hz), n))
    phase = rng.uniform(0, 2 * math.pi, n)
    return np.sin(2 * math.pi * np.outer(t_s, frequency) + phase).sum(axis=1) * math.sqrt(2 / n)
