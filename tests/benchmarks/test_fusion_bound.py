"""What the benchmark of drift_aware's limits tells it is what it goes by."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.fusion_bound import ROWS, Told, covariance_of, errors_of, outcome, wrong_alike
from benchmarks.fusion_inputs import Case, Track, predicted_walk
from groundwalk.fusion.evaluation.fuse import Run, fuse
from groundwalk.fusion.walk import Walk
from groundwalk.geometry.poses import make_pose, yaw_rotation

COVARIANCE = np.diag([0.02, 0.3, 0.02, 0.9, 0.1, 0.4]) ** 2


def walk(name: str, seed: int, seconds: int = 40) -> Walk:
    """A loop with exact odometry, and predictions of which a few are far off."""
    rng = np.random.default_rng(seed)
    turn = 0.15 * np.arange(seconds)
    truth = make_pose(yaw_rotation(turn), np.column_stack([6 * np.sin(turn), 0 * turn, 6 * np.cos(turn)]))
    error = rng.normal(size=(seconds, 6)) * np.sqrt(COVARIANCE.diagonal() / rng.chisquare(3, (seconds, 1)) * 3)
    moved = truth[:, :3, 3] + np.einsum("nij,nj->ni", truth[:, :3, :3], error[:, 3:])
    predictions = make_pose(truth[:, :3, :3] @ Rotation.from_rotvec(error[:, :3]).as_matrix(), moved)
    t_ns = np.arange(seconds, dtype=np.int64) * 10**9
    return predicted_walk("Hall", Track(name, t_ns, truth, truth), predictions)


def test_what_is_told_stays_and_helps() -> None:
    case = Case("real", "Hall", "PN", tuple(walk(f"seq{i}~0", i) for i in range(4)), (None,) * 4)
    covariance = covariance_of(errors_of(case.walks))
    sd = np.sqrt(covariance.diagonal())
    assert np.allclose(sd, np.sqrt(COVARIANCE.diagonal()), rtol=0.25)
    told = Told(covariance)
    fuse(Run("", "", "PN"), case.walks[0], told)
    assert np.allclose(told.save()["covariance"], covariance / np.outer(sd, sd), atol=1e-4)
    outcomes = [outcome(case, make) for make in ROWS.values()]
    as_it_is, _, _, smoother, weighed, oracle, *_ = (o.errors for o in outcomes)
    assert (weighed < as_it_is).all() and (smoother < as_it_is).all() and (oracle < 1e-6).all()
    assert all((o.inside > 0.8).all() for o in outcomes[:5]) and np.isnan(outcomes[5].inside).all()


def test_predictions_that_are_wrong_alike_are_counted() -> None:
    """Of forty a second apart, five in a row have headings that are 20 degrees off."""
    walked = walk("seq0~0", 0)
    turned = walked.map_T_cam.copy()
    turned[10:15, :3, :3] = yaw_rotation(np.full(5, np.radians(20.0))) @ turned[10:15, :3, :3]
    walked = replace(walked, map_T_cam_apr=turned)
    assert [wrong_alike([walked], count) for count in (1, 3, 5, 6)] == [12.5, 300 / 38, 100 / 36, 0]


def test_a_later_answer_is_told_the_same() -> None:
    case = Case("real", "Hall", "PN", tuple(walk(f"seq{i}~0", i) for i in range(2)), (None,) * 2)
    in_time, late = (outcome(case, ROWS[name]).errors for name in ROWS if name[0] in "28")
    assert (late < in_time).all()
