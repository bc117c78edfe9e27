"""Walks past tags with simulated odometry: what the drift model makes of the recorded walks, for checks of the fit."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.vio_drift.recordings import TagWalk
from groundwalk.geometry.poses import Array
from groundwalk.simulation.vio import VioModel, simulate_vio

_STEP_M = 0.5
_SPEED_M_PER_S = 0.75


def rewalk(walk: TagWalk, place: Mapping[int, ArrayLike], tag_m: ArrayLike, seed: int, model: VioModel) -> TagWalk:
    """The same visits in the same order, seen by simulated odometry.

    The tags hang at `place` (3,) and the way from one to the next has the length of the walk's, as two straight lines.
    Tags are seen with noise of spread tag_m (m, a number or one for each axis). Visits to tags without a place are
    left out. Tracking is never lost, as the recorded visits are those of one uninterrupted session.
    """
    known = [i for i, tag in enumerate(walk.tag) if int(tag) in place]
    stops = np.array([place[int(walk.tag[i])] for i in known], dtype=float)
    ways = [_way(a, b, p) for a, b, p in zip(stops, stops[1:], np.diff(walk.along_m[known]), strict=False)]
    truth = np.concatenate([stops[:1], *ways])
    visits = np.cumsum([0, *(len(way) for way in ways)])

    world_T_cam = np.tile(np.eye(4), (len(truth), 1, 1))
    world_T_cam[:, :3, 3] = truth
    step = np.linalg.norm(np.diff(truth, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(step)])
    # A visit takes a moment, and times have to rise where the way has no length.
    t_ns = np.round((along / _SPEED_M_PER_S + 1e-3 * np.arange(len(truth))) * 1e9).astype(np.int64)
    track = simulate_vio(t_ns, world_T_cam, seed, replace(model, interruptions_per_min=0.0))
    noise = np.asarray(tag_m, dtype=float) * np.random.default_rng([seed, 99]).standard_normal((len(visits), 3))
    seen = track.vio_T_cam[visits, :3, 3] + noise
    return TagWalk(walk.name, walk.tag[known], seen, along[visits])


def _way(start: Array, end: Array, path_m: float) -> Array:
    """Positions (W, 3) after `start`, up to `end`, on two straight lines of path_m in all (or on one, if shorter)."""
    straight = end - start
    length = float(np.linalg.norm(straight))
    sideways = np.array([-straight[2], 0.0, straight[0]]) if length > 0 else np.array([1.0, 0.0, 0.0])
    aside = np.sqrt(max(path_m**2 - length**2, 0.0)) / 2
    corner = (start + end) / 2 + sideways / np.linalg.norm(sideways) * aside
    count = max(int(np.ceil(max(path_m, length) / (2 * _STEP_M))), 1)
    share = np.linspace(0, 1, count + 1)[1:, None]
    return np.concatenate([start + share * (corner - start), corner + share * (end - corner)])
