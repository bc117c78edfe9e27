"""Walks through every place: how fast, how smooth, how near to things, and that several meet the same views."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from groundwalk.simulation.scenes import NAMES, scenery
from groundwalk.simulation.session import outline
from groundwalk.simulation.settings import MAX_SESSION_S, SimulateSettings
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


def test_far_glances_turn_the_view_aside_and_back() -> None:
    plan = scenery("Church", 0)
    t = np.arange(0, 90, 0.2)
    near, far = (
        plan_walk(replace(plan.route, far_glances=share), plan.place, 90, 0.0, 0.1, np.random.default_rng(4))
        for share in (0.0, 1.0)
    )
    aside = np.abs(np.degrees(far.angles(t)[:, 0] - near.angles(t)[:, 0]))
    assert 15 < aside.max() < 130
    assert 0.4 < (aside < 5).mean() < 0.9  # most of the time one looks where one goes
    np.testing.assert_allclose(far.position(t), near.position(t))


def test_sessions_walk_differently() -> None:
    t = np.arange(0, 60, 1.0)
    positions = [w.world_T_cam(t)[:, :3, 3] for w in walks("Church")]
    for k, a in enumerate(positions):
        for b in positions[k + 1 :]:
            assert np.linalg.norm(a - b, axis=1).mean() > 0.5


def test_table_one_counts_decide_the_sessions() -> None:
    settings = SimulateSettings(frame_fraction=1.0, train_frames=1643, test_frames=853)
    sessions = outline(settings, "Church", 0)
    for kind, total in (("train", 1643), ("test", 853)):
        images = [s.images for s in sessions if s.name.startswith(kind)]
        assert sum(images) == total
        assert max(images) / settings.image_hz <= MAX_SESSION_S + 1
    starts = np.array([s.boot_s for s in sessions])
    assert np.diff(starts).min() > 3600
