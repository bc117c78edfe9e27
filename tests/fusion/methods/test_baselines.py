"""The methods that ours is held against: each against a slow definition of its own, and what all of them promise."""

from collections.abc import Iterable

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from groundwalk.fusion.methods import METHODS
from groundwalk.fusion.methods.drift_aware import Smoother
from groundwalk.fusion.methods.error_state import ErrorState, ErrorStateOptions
from groundwalk.fusion.methods.last_good import LastGood
from groundwalk.fusion.methods.localiser import Estimate, Localiser, Status
from groundwalk.fusion.methods.odometry import PairOptions
from groundwalk.fusion.methods.offline import stepped
from groundwalk.fusion.methods.pose_graph import PoseGraph, PoseGraphOptions
from groundwalk.fusion.methods.vio_oracle import VioOracle
from groundwalk.fusion.methods.window import Window, WindowOptions
from groundwalk.geometry.fits import pose_residuals
from groundwalk.geometry.pose_graph import smooth_chain
from groundwalk.geometry.poses import Array, inverse, make_pose, relative, yaw_rotation
from tests.fusion.literal_rule import literal_frames, pair_is_consistent
from tests.fusion.random_walks import random_walk
from tests.fusion.upright_walks import as_walk, upright_walk
from tests.known import there

BASELINES = ["last_good", "window30", "pose_graph", "global_graph", "error_state"]


def poses(estimates: Iterable[Estimate]) -> Array:
    none = np.full((4, 4), np.nan)
    return np.array([none if e.map_T_cam is None else e.map_T_cam for e in estimates])


def made(name: str) -> Localiser:
    method = METHODS[name]
    localiser = method.make(method.options())
    assert isinstance(localiser, Localiser)
    return localiser


@pytest.mark.parametrize("name", BASELINES)
@pytest.mark.parametrize("every", [1, 3])
def test_exact_predictions_and_odometry_give_exact_answers(name: str, every: int) -> None:
    """Between predictions, too."""
    t_ns, truth, _, _ = upright_walk(0, 60)
    vio = make_pose(yaw_rotation(1.0), [5.0, 1.0, -3.0]) @ truth
    rare = [pose if i % every == 0 else None for i, pose in enumerate(truth)]
    answers = stepped(made(name), as_walk(t_ns // every, truth, vio, rare))
    carried = 0 if every == 1 else every  # `last_good` carries from the second prediction on
    assert np.allclose(poses(answers)[carried:], truth[carried:], atol=1e-6)
    assert np.allclose(answers[-1].map_T_vio @ vio[-1], truth[-1], atol=1e-6)


@pytest.mark.parametrize("name", BASELINES)
def test_jumps_and_lost_odometry(name: str) -> None:
    t_ns, truth, _, _ = upright_walk(2, 30)
    vio = make_pose(yaw_rotation(0.4), [2.0, 0.0, 0.0]) @ truth
    vio[15:, :3, 3] += [9.0, 0.0, 9.0]
    lost = [None if i == 8 else pose for i, pose in enumerate(vio)]
    answers = stepped(made(name), as_walk(t_ns, truth, lost, truth))
    assert answers[8].status is Status.PREDICTED and answers[8].reasons == ("no_odometry",)
    assert answers[15].reasons[0] == "odometry_jump"
    assert np.allclose(poses(answers), truth, atol=1e-6)


def test_last_good_is_the_last_pair_that_the_literal_check_passes() -> None:
    options = PairOptions(vio_jump_m=1e6)
    for seed in range(20):
        walk = random_walk(seed)
        frames = literal_frames(walk)
        answers = stepped(LastGood(options), as_walk(walk.t_ns, walk.map_T_cam, walk.vio, walk.apr))
        last, good = None, None
        for i, frame in enumerate(frames):
            if not frame.has_vio:
                continue
            if frame.has_apr:
                if last is not None and pair_is_consistent(frames[last], frame, options):
                    good = i
                last = i
            if good is None:
                expected = walk.apr[i]
            else:
                expected = there(walk.apr[good]) @ inverse(there(walk.vio[good])) @ there(walk.vio[i])
            assert np.allclose(poses([answers[i]])[0], np.nan if expected is None else expected, equal_nan=True)
            assert (answers[i].status is Status.RELIABLE) == (good == i)


def test_window_fits_its_pairs_better_than_any_alignment_nearby() -> None:
    """At its answer, a small motion any way makes the robust cost (Geman and McClure's) no smaller."""
    t_ns, truth, vio, apr = upright_walk(3, 45)
    options = WindowOptions()
    answer = there(stepped(Window(options), as_walk(t_ns, truth, vio, apr))[-1].map_T_vio)
    kept = slice(-options.pairs, None)

    def sizes(map_T_vio: Array) -> Array:
        metres, angle = pose_residuals(apr[kept], vio[kept], map_T_vio)
        return np.hypot(metres / options.position_sd_m, angle / np.radians(options.rotation_sd_deg))

    width = max(2 * np.median(sizes(answer)), 1.0)

    def cost(map_T_vio: Array) -> float:
        r2 = (sizes(map_T_vio) / width) ** 2
        return np.sum(r2 / (1 + r2))

    # Turned about the middle of the walk, so that turning alone hardly moves it.
    middle = make_pose(np.eye(3), answer[:3, :3] @ vio[kept, :3, 3].mean(axis=0) + answer[:3, 3])
    rng = np.random.default_rng(0)
    for size in (0.1, 0.5):
        for _ in range(40):
            turn = Rotation.from_rotvec(size * 0.1 * rng.normal(size=3)).as_matrix()
            moved = middle @ make_pose(turn, size * rng.normal(size=3)) @ inverse(middle) @ answer
            assert cost(moved) > cost(answer)


@pytest.mark.parametrize("huber", [np.inf, 1.0])
def test_chain_is_at_the_least_cost(huber: float) -> None:
    """Against scipy's general solver, on poses that are turned any way."""
    rng = np.random.default_rng(4)
    truth = make_pose(Rotation.random(6, rng=rng).as_matrix(), rng.normal(0, 2, (6, 3)))

    def wrong(poses: Array, metres: float, radians: float) -> Array:
        turn = Rotation.from_rotvec(radians * rng.normal(size=(len(poses), 3))).as_matrix()
        return make_pose(poses[:, :3, :3] @ turn, poses[:, :3, 3] + metres * rng.normal(size=(len(poses), 3)))

    measured, steps = wrong(truth, 0.5, 0.1), wrong(relative(truth[:-1], truth[1:]), 0.05, 0.02)
    measured[2, :3, 3] += 5.0
    sds = {"measured_sd": (0.5, 0.1), "step_sd": (0.05, 0.02)}
    solved, covariance = smooth_chain(measured, steps, measured, **sds, huber=huber)

    def residuals(v: Array) -> Array:
        chain = make_pose(Rotation.from_rotvec(v[:, :3]).as_matrix(), v[:, 3:])
        turn = Rotation.from_matrix(measured[:, :3, :3].swapaxes(1, 2) @ chain[:, :3, :3]).as_rotvec() / 0.1
        own = np.hstack([turn, (chain[:, :3, 3] - measured[:, :3, 3]) / 0.5])
        sds = np.linalg.norm(own, axis=1, keepdims=True)
        own *= np.sqrt(np.where(sds <= huber, sds**2, 2 * min(huber, 1e9) * sds - min(huber, 1e9) ** 2)) / sds
        left = inverse(steps) @ relative(chain[:-1], chain[1:])
        turn = Rotation.from_matrix(left[:, :3, :3]).as_rotvec() / 0.02
        off = (relative(chain[:-1], chain[1:])[:, :3, 3] - steps[:, :3, 3]) / 0.05
        return np.concatenate([own.ravel(), turn.ravel(), off.ravel()])

    start = np.hstack([Rotation.from_matrix(solved[:, :3, :3]).as_rotvec(), solved[:, :3, 3]])
    found = least_squares(lambda v: residuals(v.reshape(6, 6)), start.ravel(), xtol=1e-12, ftol=1e-12)
    assert np.allclose(found.x.reshape(6, 6), start, atol=2e-4)
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_pose_graph_window_is_the_chain_of_its_frames() -> None:
    t_ns, truth, vio, apr = upright_walk(5, 30)
    options = PoseGraphOptions()
    answers = stepped(PoseGraph(options), as_walk(t_ns, truth, vio, apr))
    kept = slice(-options.frames, None)
    chain, _ = smooth_chain(
        apr[kept],
        relative(vio[kept][:-1], vio[kept][1:]),
        truth[kept],
        measured_sd=(options.position_sd_m, np.radians(options.rotation_sd_deg)),
        step_sd=(options.step_sd_m, np.radians(options.step_sd_deg)),
    )
    assert np.allclose(there(answers[-1].map_T_cam), chain[-1], atol=1e-5)


def test_error_state_without_drift_is_the_average_of_the_predictions() -> None:
    """Without drift and gate the filter is least squares: standing still, the mean, and a covariance that says so."""
    rng = np.random.default_rng(6)
    options = ErrorStateOptions(drift_m=1e-9, drift_deg=1e-9, gate=1 - 1e-12)
    apr = make_pose(np.tile(np.eye(3), (50, 1, 1)), rng.normal(0, 1.0, (50, 3)))
    walk = as_walk(np.arange(50, dtype=np.int64) * 10**9, apr, np.tile(np.eye(4), (50, 1, 1)), apr)
    answer = stepped(ErrorState(options), walk)[-1]
    assert np.allclose(there(answer.map_T_cam)[:3, 3], apr[:, :3, 3].mean(axis=0), atol=1e-9)
    assert np.allclose(there(answer.covariance)[3:, 3:], np.eye(3) / 50, atol=1e-9)


def test_error_state_refuses_outliers_and_begins_anew() -> None:
    t_ns, truth, _, _ = upright_walk(7, 60)
    moved = truth.copy()
    moved[20, :3, 3] += 30.0
    moved[40:, :3, 3] += [50.0, 0.0, 0.0]  # carried away without odometry's knowledge
    answers = stepped(ErrorState(), as_walk(t_ns, truth, truth, moved))
    assert answers[20].reasons == ("outlier",) and np.allclose(there(answers[20].map_T_cam), truth[20], atol=1e-6)
    restarts = [i for i, e in enumerate(answers) if e.reasons == ("restart",)]
    assert restarts == [40 + ErrorStateOptions().restart_after - 1]
    assert np.allclose(there(answers[-1].map_T_cam), moved[-1], atol=1e-6)


def test_oracle_is_exact_for_odometry_without_drift_between_jumps() -> None:
    t_ns, truth, _, apr = upright_walk(8, 50)
    vio = make_pose(yaw_rotation(1.0), [3.0, 0.0, 0.0]) @ truth
    vio[25:, :3, 3] += [9.0, 0.0, 9.0]
    lost = [None if i == 10 else pose for i, pose in enumerate(vio)]
    hidden = np.where((np.arange(50) % 2 == 0)[:, None, None], truth, np.nan)
    answers = VioOracle().estimates(as_walk(t_ns, hidden, lost, apr))
    assert answers[10].status is Status.NONE
    tracked = np.arange(50) != 10
    assert np.allclose(poses(answers)[tracked], truth[tracked], atol=1e-9)
    nothing = VioOracle().estimates(as_walk(t_ns, np.full((50, 4, 4), np.nan), lost, apr))
    assert {e.reasons for e in nothing} == {("no_odometry",), ("no_ground_truth",)}


def test_smoother_answers_every_frame_that_can_be() -> None:
    walk = random_walk(5, 40)
    given = as_walk(walk.t_ns, walk.map_T_cam, walk.vio, [None] * 3 + walk.apr[3:])
    answers = Smoother().estimates(given)
    for estimate, vio, apr in zip(answers, given.vio_T_cam, given.map_T_cam_predicted, strict=True):
        assert (estimate.map_T_cam is not None) == bool(np.isfinite(vio).all() or np.isfinite(apr).all())
