"""Walks through every place: how fast, how smooth, how near to things, and that several meet the same views."""

import functools

import numpy as np
import pytest

from groundwalk.simulation.scenes import NAMES, scenery
from groundwalk.simulation.session import outline
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.simulation.walks import MARGIN_M, PlannedWalk, plan_walk

SWAY_M = 0.06  # gait moves the camera off the walked line by no more


@functools.cache
def walks(name: str) -> list[PlannedWalk]:
    plan = scenery(name, 0)
    sessions = outline(SimulateSettings(), name, 0)
    return [
        plan_walk(plan.route, plan.place, 100.0, s.side, s.start, np.random.default_rng(k))
        for k, s in enumerate(sessions)
    ]


@pytest.mark.parametrize("name", NAMES)
def test_walks_are_slow_smooth_and_bump_into_nothing(name: str) -> None:
    place = scenery(name, 0).place
    t = np.arange(0, 40, 1 / 60)
    for walk in walks(name):
        poses = walk.world_T_cam(t)
        velocity_mps = walk.position(t, 1)
        assert np.linalg.norm(velocity_mps, axis=1).max() <= 1.4
        assert place.clearance_m(poses[:, :3, 3]).min() > MARGIN_M - SWAY_M
        # Continuous velocity: no jump between ticks beyond what gait's acceleration explains.
        assert np.linalg.norm(np.diff(velocity_mps, axis=0), axis=1).max() < 0.12
        turn = np.degrees(np.linalg.norm(walk.angles(t, 1), axis=1))
        assert turn.max() < 75


@pytest.mark.parametrize("name", NAMES)
def test_most_views_are_seen_by_other_sessions_from_alike(name: str) -> None:
    t = np.arange(0, 100, 1.0)
    poses = [walk.world_T_cam(t) for walk in walks(name)]
    near = {"Stairs": 1.0, "Office": 1.0}.get(name, 3.0)
    for k, mine in enumerate(poses):
        others = np.concatenate(poses[:k] + poses[k + 1 :])
        away = np.linalg.norm(mine[:, None, :3, 3] - others[None, :, :3, 3], axis=2)
        cosine = np.einsum("ni,mi->nm", mine[:, :3, 2], others[:, :3, 2])
        met = ((away < near) & (cosine > np.cos(np.radians(40)))).sum(axis=1)
        assert (met >= 2).mean() > 0.85
