"""Bundle adjustment with lens, rolling shutter and focus: derivatives, recovery, honest sigmas."""

import gc
import weakref
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.poses import Array, inverse
from groundwalk.geometry.robust import cauchy_weights
from groundwalk.geometry.shutter import readout_lines
from groundwalk.sfm.cameras import adjustment, normal_equations
from groundwalk.sfm.cameras.adjustment import (
    CENTRE,
    Adjusted,
    Bundle,
    CameraPriors,
    Cameras,
    adjust,
    camera_unknowns,
    folded,
    frame_variances,
    linearize,
    marginal_readout,
    prior_information,
    project,
    regular_system,
    shared_columns,
    with_step,
)
from groundwalk.sfm.cameras.model_adjustment import with_likeliest_sds, with_shrunk_sds
from groundwalk.sfm.cameras.normal_equations import Solver, System
from groundwalk.sfm.quality import covariance
from groundwalk.sfm.quality.covariance import coherence, covariances
from tests.known import there

_FRAMES, _POINTS, _NOISE_PX = 24, 2500, 0.2
_LENS, _READOUT_S = (0.092, -0.125), 0.02
_INTRINSICS = [483.0, 483.0, 320.0, 236.0]
_ANGULAR_SD, _FOCUS_SD = 0.02, 0.003


def walk_of(seed: int, first_row: str = "top", k3: float = 0.0, straight: bool = False) -> tuple[Bundle, Cameras]:
    """A camera in the middle of points all around, turning, or going straight ahead; what it sees."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2.0, _FRAMES)
    pose = np.tile(np.eye(4), (_FRAMES, 1, 1))
    pose[:, :3, 3] = np.column_stack([4 * np.sin(angle), 0.3 * rng.normal(size=_FRAMES), 4 * np.cos(angle)])
    turn = np.column_stack([angle, 0.1 * rng.normal(size=_FRAMES), 0.1 * rng.normal(size=_FRAMES)])
    if straight:
        pose[:, :3, 3] = np.column_stack([np.zeros((_FRAMES, 2)), 4 * np.sin(angle / 2)])
        turn[:] = 0
    pose[:, :3, :3] = Rotation.from_euler("yxz", turn).as_matrix()
    points = 2 * _POINTS if straight else _POINTS
    direction = rng.normal(size=(points, 3)) * [1, 0.5, 1]
    xyz = direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(7, 13, (points, 1))
    cameras = Cameras(
        np.tile(_INTRINSICS, (_FRAMES, 1)),
        readout_lines([first_row] * _FRAMES, 640, 480),
        np.zeros(_FRAMES, int),
        np.arange(_FRAMES) * 2 // _FRAMES,
        np.arange(_FRAMES, dtype=float),
        np.array([[*_LENS, 0, 0, k3, 0, 0, 0]], float),
        np.array([_READOUT_S]),
        np.zeros((1, 2)),
        rng.normal(0, 0.004, 2),
        rng.normal(0, 0.001, _FRAMES),
        rng.normal(0, 0.4, (_FRAMES, 3)),
        rng.normal(0, 0.6, (_FRAMES, 3)),
    )
    frame, point = [], []
    for row in range(_FRAMES):
        p = (xyz - pose[row, :3, 3]) @ pose[row, :3, :3]
        ahead = (p[:, 2] > 1) & (np.abs(p[:, 0]) < 0.62 * p[:, 2]) & (np.abs(p[:, 1]) < 0.47 * p[:, 2])
        point.append(np.flatnonzero(ahead))
        frame.append(np.full(len(point[-1]), row))
    frame_M, point_M = np.concatenate(frame), np.concatenate(point)
    often = (np.bincount(point_M, minlength=points) >= 3)[point_M]
    kept, point_M = np.unique(point_M[often], return_inverse=True)
    bundle = Bundle(pose, xyz[kept], frame_M[often], point_M, np.full((len(point_M), 2), 240.0))
    for _ in range(6):
        # The row where a point is seen decides when it is.
        bundle = replace(bundle, observed_px=project(bundle, cameras))
    return bundle, cameras


def _ring(seed: int, centre_px: Array) -> tuple[Bundle, Cameras]:
    """A camera that goes round an object, and what it sees if the principal point isn't the logged one."""
    _, cameras = walk_of(seed)
    rng = np.random.default_rng(seed)
    angle = np.linspace(0, 2 * np.pi, _FRAMES, endpoint=False)
    pose = np.tile(np.eye(4), (_FRAMES, 1, 1))
    pose[:, :3, :3] = Rotation.from_euler("y", angle[:, None]).as_matrix()
    pose[:, :3, 3] = -4 * pose[:, :3, 2]
    direction = rng.normal(size=(600, 3))
    xyz = direction / np.linalg.norm(direction, axis=1, keepdims=True) * rng.uniform(0.5, 1.2, (600, 1))
    depth = np.einsum("nj,npj->np", pose[:, :3, 2], xyz - pose[:, None, :3, 3])
    frame, point = np.nonzero(depth < 4)  # the side that it looks at
    bundle = Bundle(pose, xyz, frame, point, np.full((len(point), 2), 240.0))
    cameras = replace(cameras, intrinsics=cameras.intrinsics + np.r_[0.0, 0.0, centre_px])
    for _ in range(6):
        bundle = replace(bundle, observed_px=project(bundle, cameras))
    return bundle, cameras


def _adjusted(
    seed: int,
    first_row: str = "top",
    assumed_first_row: str | None = None,
    k3: float = 0.0,
    focus_sd: float = 0.001,
    angular_sd: float = _ANGULAR_SD,
    noise_px: float | Array = _NOISE_PX,
    straight: bool = False,
    centre_sd_px: float = 1e-4,
    walk: tuple[Bundle, Cameras] | None = None,
) -> tuple[Adjusted, Bundle, Cameras]:
    """The walk adjusted from noisy observations and VIO's angular velocities; the lens as phones have it on average.
    `noise_px` is the sd of all observations or of each point's."""
    truth, cameras = walk or walk_of(seed, first_row, k3, straight)
    assumed = readout_lines([assumed_first_row or first_row] * _FRAMES, 640, 480)
    rng = np.random.default_rng(100 + seed)
    mean = replace(
        cameras,
        intrinsics=np.tile(_INTRINSICS, (_FRAMES, 1)),
        readout_line=assumed,
        coefficients=np.array([[0.08, -0.12, 0, 0, 0, 0, 0, 0]], float),
        readout_s=np.zeros(1),
        log_focal=np.zeros(2),
        focus=np.zeros(_FRAMES),
        angular=cameras.angular + rng.normal(0, _ANGULAR_SD, (_FRAMES, 3)),
    )
    priors = CameraPriors(
        mean,
        np.diag([0.05, 0.08, 0.1, 0.02, centre_sd_px, centre_sd_px])[None] ** 2,
        np.full(2, 0.01),
        np.full(2, focus_sd),
        np.full((_FRAMES, 3), angular_sd),
    )
    pose = truth.sfm_T_cam.copy()
    pose[:, :3, 3] += rng.normal(0, 0.01, (_FRAMES, 3))
    noisy = replace(
        truth,
        sfm_T_cam=pose,
        xyz=truth.xyz + rng.normal(0, 0.02, truth.xyz.shape),
        observed_px=truth.observed_px + rng.normal(0, _of_observations(noise_px, truth), truth.observed_px.shape),
    )
    return adjust(noisy, mean, priors), truth, cameras


def _of_observations(noise_px: float | Array, bundle: Bundle) -> float | Array:
    return noise_px if isinstance(noise_px, float) else noise_px[bundle.point, None]


def test_without_shutter_a_point_is_seen_where_colmaps_opencv_camera_has_it() -> None:
    bundle, cameras = walk_of(0)
    for row in (0, _FRAMES - 1):
        seen = bundle.frame == row
        params = [*cameras.focal[row], 320, 236, *cameras.coefficients[0, :4]]
        camera = pycolmap.Camera(camera_id=1, model="OPENCV", width=640, height=480, params=params)
        cam_T_sfm = inverse(bundle.sfm_T_cam[row])
        points = bundle.xyz[bundle.point[seen]] @ cam_T_sfm[:3, :3].T + cam_T_sfm[:3, 3]
        assert np.allclose(project(bundle, cameras, shutter=False)[seen], camera.img_from_cam(points), atol=1e-8)


def test_a_row_is_seen_from_where_the_camera_is_at_its_time() -> None:
    bundle, cameras = walk_of(0)
    observation = int(np.argmax(np.abs(bundle.observed_px[:, 1] - 240)))
    row = bundle.frame[observation]
    tau = _READOUT_S * (bundle.observed_px[observation, 1] / 480 - 0.5)
    moved = bundle.sfm_T_cam.copy()
    moved[row, :3, 3] += moved[row, :3, :3] @ cameras.velocity[row] * tau
    moved[row, :3, :3] = moved[row, :3, :3] @ Rotation.from_rotvec(cameras.angular[row] * tau).as_matrix()
    still = project(replace(bundle, sfm_T_cam=moved), cameras, shutter=False)[observation]
    assert np.allclose(still, project(bundle, cameras)[observation], atol=1e-9)


@pytest.mark.parametrize(("rational", "first_row"), [((0.0, 0.0, 0.0), "right"), ((0.3, 0.1, -0.02), "top")])
def test_derivatives_are_those_of_finite_differences(rational: tuple[float, float, float], first_row: str) -> None:
    bundle, cameras = walk_of(1, first_row)
    coefficients = cameras.coefficients.copy()
    coefficients[:, 5:] = rational
    cameras = replace(cameras, coefficients=coefficients)
    rng = np.random.default_rng(1)
    linear, unknowns = linearize(bundle, cameras), len(camera_unknowns(cameras))
    step = 1e-6 * rng.normal(size=unknowns)
    point_step = 1e-6 * rng.normal(size=bundle.xyz.shape)
    change = project(*with_step(bundle, cameras, step, point_step)) - project(bundle, cameras)
    local = step[: 10 * _FRAMES].reshape(_FRAMES, 10)
    shared = step[10 * _FRAMES :][shared_columns(cameras)]
    predicted = np.einsum("mij,mj->mi", linear.by_camera, np.concatenate([local, shared], axis=1)[bundle.frame])
    predicted += np.einsum("mij,mj->mi", linear.by_point, point_step[bundle.point])
    assert np.abs(change).max() > 1e-3
    assert np.allclose(change, predicted, atol=2e-6)


def test_the_system_times_a_vector_is_its_matrix_times_it() -> None:
    system, diagonal, matrix = _system(2)
    rng = np.random.default_rng(2)
    vectors = rng.normal(size=(4, len(matrix))) / np.sqrt(diagonal)
    assert np.allclose([system.times(x) for x in vectors], vectors @ matrix, rtol=1e-9, atol=1e-9 * diagonal.max())
    assert np.allclose(diagonal, np.diag(matrix), rtol=1e-9)


def test_a_system_is_solved_with_the_factor_of_another_one() -> None:
    solver, (first, diagonal, _), (second, other_diagonal, matrix) = Solver(), _system(2), _system(3)
    solver.solve(first, diagonal, 1e-6, -first.gradient)
    step = solver.solve(second, other_diagonal, 1e-6, -second.gradient)
    exact = np.linalg.solve(matrix + 1e-6 * np.diag(other_diagonal), -second.gradient)
    apart = step - exact
    assert apart @ matrix @ apart < 1e-5 * (exact @ matrix @ exact)


def test_a_system_that_is_too_large_for_a_factor_is_solved_without_one(monkeypatch: pytest.MonkeyPatch) -> None:
    system, diagonal, matrix = _system(2)
    exact = np.linalg.solve(matrix + 1e-3 * np.diag(diagonal), -system.gradient)
    members = np.array([1, 4, 17])
    index = (system.size // len(system.blocks) * members[:, None] + np.arange(10)).ravel()
    assert np.allclose(system.part(members), matrix[np.ix_(index, index)], rtol=1e-9, atol=1e-9 * diagonal.max())
    monkeypatch.setattr(normal_equations, "MAX_FACTORED", 0)
    monkeypatch.setattr(normal_equations, "_CLUSTER", 6)
    monkeypatch.setattr(System, "matrix", None)
    apart = Solver().solve(system, diagonal, 1e-3, -system.gradient) - exact
    assert apart @ matrix @ apart < 1e-3 * (exact @ matrix @ exact)


def test_a_system_that_was_solved_does_not_stay_in_memory() -> None:
    system, diagonal, _ = _system(2)
    Solver().solve(system, diagonal, 1e-3, -system.gradient)
    left = weakref.ref(system)
    gc.disable()  # it would free a system that refers to itself, but late
    try:
        del system
        assert left() is None
    finally:
        gc.enable()


def test_a_model_too_large_for_a_factor_comes_out_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    factored, truth, _ = _adjusted(0)
    monkeypatch.setattr(normal_equations, "MAX_FACTORED", 0)
    monkeypatch.setattr(normal_equations, "_CLUSTER", 6)
    large, _, _ = _adjusted(0)
    assert _position_error_m(large.bundle, truth) < 1.05 * _position_error_m(factored.bundle, truth)
    assert np.allclose(large.cameras.coefficients, factored.cameras.coefficients, atol=2e-3)
    exact, (_, angular), marginal = covariances(factored), frame_variances(factored), marginal_readout(factored)
    monkeypatch.setattr(adjustment, "MAX_FACTORED", 0)
    monkeypatch.setattr(normal_equations, "_CLUSTER", 12)
    monkeypatch.setattr(covariance, "_SAMPLES", 240)
    sampled, (_, of_clusters), of_large = covariances(factored), frame_variances(factored), marginal_readout(factored)
    assert 0.8 < np.median(of_clusters / angular) <= 1
    assert np.allclose(of_large.cameras.readout_s, marginal.cameras.readout_s, rtol=0.01)
    assert exact is not None and sampled is not None
    ratio = np.sqrt(np.einsum("nii->ni", sampled.poses) / np.einsum("nii->ni", exact.poses))
    assert abs(np.median(ratio) - 1) < 0.1 and ratio.std() < 0.15
    assert np.allclose(sampled.shared, exact.shared, rtol=0.01, atol=0.01 * np.diag(exact.shared).min())


def _system(seed: int) -> tuple[System, Array, Array]:
    """The system of a noisy walk, with priors, its diagonal and its whole matrix."""
    adjusted, _, _ = _adjusted(0)
    bundle, cameras = adjusted.bundle, adjusted.cameras
    moved = replace(bundle, xyz=bundle.xyz + np.random.default_rng(seed).normal(0, 0.01, bundle.xyz.shape))
    linear = linearize(moved, cameras)
    weight = cauchy_weights(linear.residual, adjusted.loss_px)
    system = regular_system(moved, cameras, linear, weight, 0.04 * prior_information(cameras, adjusted.priors))
    lower = np.tril(system.matrix())
    return system, system.diagonal(), lower + np.tril(lower, -1).T


@pytest.mark.parametrize(
    ("first_row", "k3"), [("top", 0.0), ("top", 0.3), ("right", 0.0), ("bottom", 0.0), ("left", 0.0)]
)
def test_lens_readout_and_poses_are_recovered(first_row: str, k3: float) -> None:
    adjusted, truth, cameras = _adjusted(0, first_row, k3=k3)
    shared = there(covariances(adjusted)).shared
    off = adjusted.cameras.coefficients[0, [0, 1, 4]] - [*_LENS, k3]
    assert np.all(np.abs(off) < 3 * np.sqrt(np.diag(shared)[:3])) and np.sqrt(shared[2, 2]) < 0.06
    assert adjusted.cameras.readout_s[0] == pytest.approx(_READOUT_S, abs=0.0015)
    assert np.abs(adjusted.cameras.angular - cameras.angular).max() < 3 * _ANGULAR_SD
    assert _position_error_m(adjusted.bundle, truth) < 0.008


def test_points_that_are_found_precisely_count_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of points whose variances differ by chi-squared numbers of two degrees of freedom."""
    seeds = range(4)
    noise_px = [_NOISE_PX * np.sqrt(2 / np.random.default_rng(k).chisquare(2, len(walk_of(k)[0].xyz))) for k in seeds]

    def error_m() -> float:
        trials = [_adjusted(k, noise_px=noise_px[k]) for k in seeds]
        return float(np.mean([_position_error_m(adjusted.bundle, truth) for adjusted, truth, _ in trials]))

    adjusted, _, _ = _adjusted(0, noise_px=noise_px[0])
    assert np.corrcoef(np.log(adjusted.noise), np.log(noise_px[0]))[0, 1] > 0.7
    by_points = error_m()
    _let_points_count_alike(monkeypatch)
    assert by_points < 0.95 * error_m()


def _let_points_count_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(adjustment, "point_noise", lambda bundle, residual_M2: np.ones(len(bundle.xyz)))


def test_points_beside_the_image_that_the_lens_folds_into_it_are_known() -> None:
    bundle, cameras = walk_of(0)
    assert not folded(bundle, cameras).any()
    beside = bundle.sfm_T_cam[0, :3, 3] + bundle.sfm_T_cam[0, :3, :3] @ [9.0, 0.0, 5.0]
    seen = replace(
        bundle,
        xyz=np.concatenate([bundle.xyz, beside[None]]),
        frame=np.append(bundle.frame, 0),
        point=np.append(bundle.point, len(bundle.xyz)),
        observed_px=np.concatenate([bundle.observed_px, [[320.0, 240.0]]]),
    )
    x, _ = project(seen, cameras)[-1]
    assert 0 < x < 640
    assert np.flatnonzero(folded(seen, cameras)).tolist() == [len(bundle.point)]


def test_turns_and_sideways_steps_tell_the_focal_length() -> None:
    """What the check of focal lengths advises where it's undecided."""
    sd = []
    for straight in (True, False):
        adjusted, _, _ = _adjusted(0, straight=straight)
        estimate = there(covariances(adjusted))
        sd.append(np.sqrt(np.diag(estimate.shared)[-2:]).max())
    assert sd[1] < sd[0] / 2


def test_round_an_object_a_principal_point_that_is_off_is_found_and_spoils_no_focal_length() -> None:
    """All images have that alike, so that none of them differs by it."""
    centre_px = np.array([3.0, -4.0])
    ratios: list[list[float]] = [[], []]
    for seed in range(2):
        truth, cameras = _ring(seed, centre_px)
        for centre_sd_px, of_one in zip((1e-4, 4.0), ratios, strict=True):
            adjusted, _, _ = _adjusted(seed, walk=(truth, cameras), centre_sd_px=centre_sd_px)
            off = adjusted.cameras.log_focal - cameras.log_focal
            sd = np.sqrt(np.diag(there(covariances(adjusted)).shared))
            of_one += (off / sd[-2:]).tolist()
        assert (np.abs(adjusted.cameras.centre_px[0] - centre_px) < 3 * sd[CENTRE]).all()
        assert sd[CENTRE][0] < 0.2 and sd[CENTRE][1] < 3  # all cameras look up by as much as it is off downwards
    without, with_them = np.sqrt(np.mean(np.square(ratios), axis=1))
    assert without > 2
    assert 0.3 < with_them < 1.6


def test_a_prior_of_the_focal_length_that_images_deny_does_not_make_it_certain() -> None:
    truth, cameras = _ring(0, np.zeros(2))
    longer = replace(cameras, log_focal=cameras.log_focal + 0.06)
    for _ in range(6):
        truth = replace(truth, observed_px=project(truth, longer))
    adjusted, _, _ = _adjusted(0, walk=(truth, longer))
    assert (with_likeliest_sds(adjusted).log_focal_sd > 0.03).all()
    right, _, _ = _adjusted(0)
    assert np.array_equal(with_likeliest_sds(right).log_focal_sd, right.priors.log_focal_sd)


def test_the_opposite_side_gives_a_readout_below_0_and_another_axis_is_worse() -> None:
    right, truth, _ = _adjusted(0, "right")
    left, _, _ = _adjusted(0, "right", "left")
    assert left.cameras.readout_s[0] == pytest.approx(-_READOUT_S, abs=0.0015)
    assert left.loss_px == pytest.approx(right.loss_px, rel=0.01)
    top, _, _ = _adjusted(0, "right", "top")
    assert top.loss_px > 1.1 * right.loss_px
    assert _position_error_m(top.bundle, truth) > 2 * _position_error_m(right.bundle, truth)


def test_a_camera_without_shutter_and_lens_leaves_the_truth_wrong() -> None:
    adjusted, truth, cameras = _adjusted(0)
    pinhole = replace(cameras, coefficients=np.zeros((1, 8)), readout_s=np.zeros(1))
    exact = replace(adjusted.priors, mean=pinhole, lens_covariance=1e-14 * np.eye(6)[None])
    assert _position_error_m(adjust(adjusted.bundle, pinhole, exact).bundle, truth) > 0.02


def test_sigmas_of_lens_readout_and_poses_are_honest() -> None:
    shared, position = [], []
    for seed in range(6):
        adjusted, truth, cameras = _adjusted(seed)
        estimate = there(covariances(adjusted))
        off = (camera_unknowns(adjusted.cameras) - camera_unknowns(cameras))[10 * _FRAMES :]
        shared.append(off[:4] / np.sqrt(np.diag(estimate.shared)[:4]))
        fit = fit_sim3(truth.sfm_T_cam[:, :3, 3], adjusted.bundle.sfm_T_cam[:, :3, 3])
        error = fit.poses(adjusted.bundle.sfm_T_cam)[:, :3, 3] - truth.sfm_T_cam[:, :3, 3]
        covariance = fit.rotation @ estimate.poses[:, 3:, 3:] @ fit.rotation.T * fit.scale**2
        position.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error))
    assert 0.6 < np.sqrt(np.mean(np.square(shared))) < 1.5
    assert 2.0 < np.mean(position) < 4.5


def test_sds_of_focus_and_of_vios_angular_velocities_are_learned_from_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """The walk's focus deviates by 0.001 and its angular velocities by _ANGULAR_SD, whatever the priors say. They are
    learned where all points count alike."""
    _let_points_count_alike(monkeypatch)
    focus, angular = [], []
    for seed in range(4):
        adjusted, _, _ = _adjusted(seed, focus_sd=0.0003, angular_sd=_ANGULAR_SD / 4)
        learned = with_likeliest_sds(adjusted)
        focus.append(learned.focus_sd)
        angular.append(learned.angular_sd[[0, -1]])
        shrunk = with_shrunk_sds(adjusted)
        assert (shrunk.focus_sd < learned.focus_sd).all()
        assert (adjusted.priors.angular_sd <= shrunk.angular_sd).all()
        assert np.mean(shrunk.angular_sd) < np.mean(learned.angular_sd)
    assert 0.0006 < np.sqrt(np.mean(np.square(focus))) < 0.0015
    assert 0.6 < np.sqrt(np.mean(np.square(angular))) / _ANGULAR_SD < 1.5
    # VIO may be better than its prior.
    adjusted, _, _ = _adjusted(0, angular_sd=8 * _ANGULAR_SD)
    better = with_likeliest_sds(adjusted).angular_sd
    assert np.sqrt(np.mean(better**2)) < 0.7 * np.sqrt(np.mean(adjusted.priors.angular_sd**2))
    adjusted, _, _ = _adjusted(0)
    # One frame at a jump of VIO says nothing of the others.
    adjusted.priors.mean.angular[3] += 1.0
    assert np.sqrt(np.mean(with_likeliest_sds(adjusted).angular_sd ** 2)) / _ANGULAR_SD < 1.8


def _position_error_m(bundle: Bundle, truth: Bundle) -> float:
    centre: Array = bundle.sfm_T_cam[:, :3, 3]
    placed = fit_sim3(truth.sfm_T_cam[:, :3, 3], centre).poses(bundle.sfm_T_cam)
    return float(np.median(np.linalg.norm(placed[:, :3, 3] - truth.sfm_T_cam[:, :3, 3], axis=1)))


@pytest.mark.parametrize("left_out", [None, "lens", "shutter"])
def test_residuals_are_correlated_where_something_is_not_modelled(left_out: str | None) -> None:
    adjusted, _, _ = _adjusted(2)
    mean, priors = adjusted.cameras, adjusted.priors
    if left_out == "lens":
        mean = replace(mean, coefficients=np.zeros((1, 8)))
        priors = replace(priors, lens_covariance=np.diag([1e-14, 1e-14, 1e-14, 4e-4, 1e-8, 1e-8])[None])
    elif left_out == "shutter":
        mean = replace(mean, readout_s=np.zeros(1))
        priors = replace(priors, lens_covariance=np.diag([2.5e-3, 6.4e-3, 1e-2, 1e-14, 1e-8, 1e-8])[None])
    if left_out:
        adjusted = adjust(adjusted.bundle, mean, replace(priors, mean=mean))
    residual = linearize(adjusted.bundle, adjusted.cameras).over(adjusted.noise_M).residual
    by_rows, by_region = coherence(adjusted, residual, np.arange(len(adjusted.bundle.xyz)))
    assert (by_region > 2.5) == (left_out == "lens")
    assert (by_rows > 2) == (left_out == "shutter")
