"""What a user sees of a session, on walks small enough to count by hand."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from groundwalk.fusion.evaluation.fuse import Fused, Run
from groundwalk.fusion.evaluation.sessions import session_figures
from groundwalk.geometry.poses import Array, make_pose, yaw_rotation
from tests.fusion.upright_walks import as_walk

SECOND = 10**9


def along(metres: list[float], degrees: list[float] | None = None) -> Array:
    turn = yaw_rotation(np.radians(degrees if degrees is not None else np.zeros(len(metres))))
    return make_pose(turn, np.outer(metres, [1.0, 0.0, 0.0]))


def figures(
    seconds: Sequence[float], answers: Array, vio: Array, apr: Array | None = None, truth: Array | None = None
) -> dict[str, Any]:
    truth = vio if truth is None else truth
    walk = as_walk(np.round(np.array(seconds) * SECOND).astype(np.int64), truth, vio, vio if apr is None else apr)
    status = np.array(["fused"] * len(walk), dtype=object)
    return session_figures(Fused(Run("m", "{}", "PN"), walk, [], status, answers, status, answers))


def missing(poses: Array, *frames: int) -> Array:
    poses = poses.copy()
    poses[list(frames)] = np.nan
    return poses


def test_first_pose_and_longest_outage() -> None:
    seconds = [0, 1, 2, 3, 5, 6, 9, 10]
    vio = along([0.0] * 8)
    found = figures(seconds, missing(vio, 0, 1, 4, 5), vio)
    # The first pose comes after 2 s; from 3 s on there is none until 9 s.
    assert (found["first_fix_s"], found["longest_outage_s"]) == pytest.approx((2.0, 6.0)) and found["answered"] == 4
    # An outage may last to the end; a long step between two answered frames is none.
    assert figures(seconds, missing(vio, 7), vio)["longest_outage_s"] == pytest.approx(1.0)
    assert figures(seconds, vio, vio)["longest_outage_s"] == 0.0
    none = figures(seconds, missing(vio, *range(8)), vio)
    assert none["first_fix_s"] is none["longest_outage_s"] is none["jitter_m"] is None


def test_jitter_is_motion_beyond_odometrys_own() -> None:
    vio = along([0, 1, 2, 3], [0, 10, 20, 30])
    assert figures([0, 1, 2, 3], vio, vio)["jitter_m"] == pytest.approx(0, abs=1e-12)
    # Steps of 1.5, 1 and 0.5 m where odometry went 1 m each, and turns of 10, 13 and 10 degrees.
    answers = along([0, 1.5, 2.5, 3.0], [0, 10, 23, 33])
    straight = figures([0, 1, 2, 3], along([0, 1.5, 2.5, 3.0]), along([0, 1, 2, 3]))
    assert straight["jitter_m"] == pytest.approx((0.5 + 0 + 0.5) / 3)
    assert figures([0, 1, 2, 3], answers, vio)["jitter_deg"] == pytest.approx(3 / 3)
    # A pair with a missing answer says nothing.
    assert figures([0, 1, 2, 3], missing(along([0, 1.5, 2.5, 3.0]), 1), along([0, 1, 2, 3]))["jitter_m"] == 0.5


def test_recovery_after_a_long_time_without_a_frame() -> None:
    seconds = [*range(10), *range(60, 90)]
    truth = along([0.0] * 40)
    apr = along([1.1] * 40)  # wrong by 1.1 m throughout
    # 5 m wrong for six frames after the gap, and right from then on.
    answers = along([0.0] * 10 + [5.0] * 6 + [0.0] * 24)
    # Ten answers in a row are at most 1.1 m wrong on average from the one on that has two bad ones among them.
    assert figures(seconds, answers, truth, apr, truth)["recovery_s"] == pytest.approx(4.0)
    assert figures(seconds, missing(answers, *range(10, 16)), truth, apr, truth)["recovery_s"] == pytest.approx(6.0)
    assert figures(seconds, along([0.0] * 10 + [5.0] * 30), truth, apr, truth)["recovery_s"] == np.inf
    assert figures(list(range(40)), answers, truth, apr, truth)["recovery_s"] is None
    assert figures([*range(35), *range(60, 65)], answers, truth, apr, truth)["recovery_s"] is None
