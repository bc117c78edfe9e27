"""The rule on whole walks at once against the rule frame by frame."""

import numpy as np
import pytest

from groundwalk.fusion.evaluation.fuse import Fused, Run, fuse
from groundwalk.fusion.methods.decide import Decisions, RuleWalk
from groundwalk.fusion.methods.mobilearloc import MobileARLoc, MobileARLocOptions
from groundwalk.fusion.walk import Walk
from groundwalk.geometry import GeometryError
from tests.fusion.methods.test_mobilearloc import random_options
from tests.fusion.random_walks import random_walk
from tests.fusion.upright_walks import as_walk

RUN = Run("mobilearloc", "{}", "PN")


def given(seed: int, frames: int = 40) -> Walk:
    walk = random_walk(seed, frames)
    return as_walk(walk.t_ns, walk.map_T_cam, walk.vio, walk.apr)


def assert_same(decided: Decisions, fused: Fused) -> None:
    for name in ("status", "live_status"):
        assert list(getattr(decided, name)) == list(getattr(fused, name))
    for name in ("map_T_cam", "live_map_T_cam"):
        assert np.allclose(getattr(decided, name), getattr(fused, name), atol=1e-9, equal_nan=True)


@pytest.mark.parametrize("block", range(4))
def test_says_what_the_steps_say(block: int) -> None:
    """On each frame of 200 walks: half with the defaults, half with random readings of the open points."""
    for seed in range(50 * block, 50 * block + 50):
        options = MobileARLocOptions() if seed % 2 else random_options(seed)
        walk = given(seed)
        assert_same(RuleWalk(walk).decide(options), fuse(RUN, walk, MobileARLoc(options)))


def test_a_sweep_over_one_walk_says_what_single_runs_say() -> None:
    """What is kept for the next options is no other's."""
    walk = given(3, 120)
    prepared = RuleWalk(walk)
    for seed in range(40):
        options = random_options(seed)
        assert_same(prepared.decide(options), fuse(RUN, walk, MobileARLoc(options)))


def test_many_unreliable_frames_between_reliable_ones_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Similarities are worked out some frames ahead; the next reliable frame may be further away."""
    monkeypatch.setattr("groundwalk.fusion.methods.decide._AHEAD", 1)
    for seed in range(30):
        walk, options = given(seed), random_options(seed)
        assert_same(RuleWalk(walk).decide(options), fuse(RUN, walk, MobileARLoc(options)))


def test_walks_with_nothing_to_judge() -> None:
    walk = random_walk(1)
    nothing = as_walk(walk.t_ns, walk.map_T_cam, walk.vio, [None] * 40)
    assert set(RuleWalk(nothing).decide(MobileARLocOptions()).status) == {"none"}
    lost = as_walk(walk.t_ns, walk.map_T_cam, [None] * 40, walk.apr)
    assert set(RuleWalk(lost).decide(MobileARLocOptions()).status) == {"none"}
    with pytest.raises(GeometryError, match="times"):
        RuleWalk(as_walk(walk.t_ns[::-1], walk.map_T_cam, walk.vio, walk.apr))
