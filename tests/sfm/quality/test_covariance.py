"""The covariance that sfm writes against the errors that bundle adjustment really makes."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array, inverse, make_pose
from groundwalk.geometry.shutter import readout_lines
from groundwalk.sfm.cameras.adjustment import CENTRE, Adjusted, Bundle, CameraPriors, Cameras
from groundwalk.sfm.quality.covariance import SHARED_ERRORS, Covariances, covariances
from tests.known import there

_FRAMES, _POINTS, _RUNS = 8, 300, 25
_NOISE_PX = 0.7
_LOSS_PX = 1.5
_FOCAL_PX = 500.0
_SIZE_PX = (800, 600)
_EXACT = 1e-7


def _independent(rng: np.random.Generator) -> Array:
    return rng.normal(0, _NOISE_PX, (_FRAMES, _POINTS, 2))


def _with_gross_errors(rng: np.random.Generator) -> Array:
    """One in twenty observations is off by pixels."""
    gross = rng.uniform(size=(_FRAMES, _POINTS, 1)) < 0.05
    return np.where(gross, rng.uniform(-8, 8, (_FRAMES, _POINTS, 2)), _independent(rng))


def _sliding(rng: np.random.Generator) -> Array:
    """Features that slide with the view: a point's errors change slowly from frame to frame."""
    steps = rng.normal(0, 0.5 * _NOISE_PX, (_FRAMES, _POINTS, 2))
    return np.cumsum(steps, axis=0) + 0.3 * _independent(rng)


@pytest.mark.parametrize("noise", [_independent, _with_gross_errors, _sliding])
def test_normalised_errors_have_the_size_that_the_covariance_says(
    noise: Callable[[np.random.Generator], Array],
) -> None:
    exact, rng = _exact(3)
    squared, rotation_too = [], []
    for _ in range(_RUNS):
        noisy_px = exact.observed_px.reshape(_FRAMES, _POINTS, 2) + noise(rng)
        adjusted, xyz = _bundle_adjusted(exact.sfm_T_cam, exact.xyz, noisy_px)
        bundle = replace(exact, sfm_T_cam=adjusted, xyz=xyz, observed_px=noisy_px.reshape(-1, 2))
        covariance = there(_covariances(bundle)).poses / SHARED_ERRORS  # these keypoints have nothing in common
        error = _error_without_gauge(exact.sfm_T_cam, adjusted)
        squared.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error))
        rotation_too.append(error**2 / np.diagonal(covariance, axis1=1, axis2=2))
    # Chi square with 6 degrees of freedom; the 200 samples hang together a little.
    assert abs(np.mean(squared) - 6) < 1.2
    assert 0.9 < np.mean(np.array(squared) < 12.59) < 0.99
    # Each of the six axes on its own, so that no mixed-up order or unit goes unseen.
    assert np.allclose(np.mean(rotation_too, axis=(0, 1)), 1, atol=0.35)


def test_covariance_follows_the_gauge() -> None:
    bundle, other = _noisy(4), Sim3(3.0, Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix(), np.array([5.0, -3.0, 2.0]))
    moved = replace(bundle, sfm_T_cam=other.poses(bundle.sfm_T_cam), xyz=other.points(bundle.xyz))
    here, elsewhere = (there(_covariances(one)).poses for one in (bundle, moved))
    jacobian = np.kron(np.diag([1.0, other.scale]), other.rotation)
    assert np.allclose(elsewhere, jacobian @ here @ jacobian.T, rtol=1e-5, atol=1e-12)


def test_a_keypoint_that_is_there_twice_tells_no_more_than_once() -> None:
    once, two = _noisy(5), np.arange(2 * _FRAMES * _POINTS) // 2
    point = once.point[two] + _POINTS * (np.arange(len(two)) % 2)
    xyz, px = np.concatenate([once.xyz, once.xyz]), once.observed_px[two]
    twice = replace(once, xyz=xyz, frame=once.frame[two], point=point, observed_px=px)
    of_once, of_twice = (there(_covariances(bundle)).poses for bundle in (once, twice))
    assert np.allclose(of_twice, of_once, rtol=1e-3, atol=1e-9)


def test_no_covariance_where_the_observations_do_not_determine_the_poses() -> None:
    frame, point = (index.ravel() for index in np.indices((_FRAMES, 2)))
    truth, xyz = _ring_of_cameras(), np.eye(3)[:2]
    assert _covariances(Bundle(truth, xyz, frame, point, _project(truth, xyz, frame, point) + 1)) is None


def test_residuals_that_hang_together_widen_what_images_tell_and_no_prior() -> None:
    bundle = _noisy(6)
    apart_px = np.where(bundle.observed_px[:, :1] < 400, 1.0, -1.0)
    found = there(_covariances(replace(bundle, observed_px=bundle.observed_px + apart_px)))
    assert found.by_region > 3
    assert np.allclose(np.sqrt(np.diag(found.shared)), _EXACT, rtol=0.05)


def test_a_principal_point_that_is_hardly_known_turns_cameras_but_not_their_rays() -> None:
    bundle = _noisy(7)
    known, unknown = (there(_covariances(bundle, centre_sd_px=sd, focal_sd=0.1)) for sd in (_EXACT, 150.0))
    assert np.sqrt(unknown.shared[CENTRE, CENTRE]).max() > 10
    sd, expected = (np.sqrt(np.diagonal(of.poses, axis1=1, axis2=2)) for of in (unknown, known))
    assert (np.abs(sd / expected - 1) < 0.1).all()


def test_a_principal_point_that_is_off_is_off_to_the_same_side_of_the_sensor_in_turned_images() -> None:
    upright = _noisy(7)
    # Every second image a quarter turn clockwise: what was right is down, what was down is left.
    turned = np.arange(_FRAMES) % 2 > 0
    cam_R_turned = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    poses, seen_px = upright.sfm_T_cam.copy(), upright.observed_px.copy()
    poses[turned, :3, :3] = poses[turned, :3, :3] @ cam_R_turned
    middle, rows = np.array(_SIZE_PX) / 2, turned[upright.frame]
    seen_px[rows] = (seen_px[rows] - middle) @ cam_R_turned[:2, :2] + middle
    bundle = replace(upright, sfm_T_cam=poses, observed_px=seen_px)

    def centre_sd(bundle: Bundle, turned: np.ndarray | None = None) -> Array:
        found = there(_covariances(bundle, turned, centre_sd_px=150.0, focal_sd=0.1))
        return np.sqrt(np.diag(found.shared)[CENTRE])

    expected = centre_sd(upright)
    assert np.allclose(centre_sd(bundle, turned), expected, rtol=1e-6)
    assert not np.allclose(centre_sd(bundle), expected, rtol=0.1)


def _exact(seed: int) -> tuple[Bundle, np.random.Generator]:
    """Cameras in a ring, and what they see of points between them."""
    rng = np.random.default_rng(seed)
    truth, xyz = _ring_of_cameras(), rng.uniform(-1, 1, (_POINTS, 3))
    frame, point = (index.ravel() for index in np.indices((_FRAMES, _POINTS)))
    return Bundle(truth, xyz, frame, point, _project(truth, xyz, frame, point)), rng


def _noisy(seed: int) -> Bundle:
    exact, rng = _exact(seed)
    return replace(exact, observed_px=exact.observed_px + rng.normal(0, _NOISE_PX, exact.observed_px.shape))


def _covariances(
    bundle: Bundle, turned: np.ndarray | None = None, *, centre_sd_px: float = _EXACT, focal_sd: float = _EXACT
) -> Covariances | None:
    """Of a model adjusted with pinhole cameras that are known exactly but for these; those of frames that are `turned`
    (N,) by a quarter clockwise."""
    size = np.array(_SIZE_PX) / 2
    cameras = Cameras(
        np.tile([_FOCAL_PX, _FOCAL_PX, *size], (_FRAMES, 1)),
        readout_lines(np.where(np.zeros(_FRAMES, bool) if turned is None else turned, "right", "top"), *_SIZE_PX),
        np.zeros(_FRAMES, int),
        np.zeros(_FRAMES, int),
        np.arange(_FRAMES, dtype=float),
        np.zeros((1, 8)),
        np.zeros(1),
        np.zeros((1, 2)),
        np.zeros(1),
        np.zeros(_FRAMES),
        np.zeros((_FRAMES, 3)),
        np.zeros((_FRAMES, 3)),
    )
    one, rates = np.full(1, _EXACT), np.full((_FRAMES, 3), _EXACT)
    lens_sd = [_EXACT] * 4 + [centre_sd_px] * 2
    priors = CameraPriors(cameras, np.diag(lens_sd)[None] ** 2, np.full(1, focal_sd), one, rates)
    adjusted = Adjusted(bundle, cameras, priors, _LOSS_PX, np.ones(len(bundle.xyz)))
    return covariances(adjusted)


def _ring_of_cameras() -> Array:
    """Cameras around the origin, looking at it, (N, 4, 4)."""
    angle = np.linspace(0, 1.2 * np.pi, _FRAMES)
    centre = np.stack([4 * np.sin(angle), 0.3 * np.cos(3 * angle), -4 * np.cos(angle)], axis=1)
    forward = -centre / np.linalg.norm(centre, axis=1, keepdims=True)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    return make_pose(np.stack([right, np.cross(forward, right), forward], axis=2), centre)


def _project(world_T_cam: Array, xyz: Array, frame: np.ndarray, point: np.ndarray) -> Array:
    cam_T_world = inverse(world_T_cam)[frame]
    p = np.einsum("mij,mj->mi", cam_T_world[:, :3, :3], xyz[point]) + cam_T_world[:, :3, 3]
    return p[:, :2] / p[:, 2:] * _FOCAL_PX + np.array(_SIZE_PX) / 2


def _bundle_adjusted(world_T_cam: Array, xyz: Array, seen_px_NP2: Array) -> tuple[Array, Array]:
    model = pycolmap.Reconstruction()
    for row, cam_T_world in enumerate(inverse(world_T_cam)):
        camera = pycolmap.Camera(
            camera_id=row + 1,
            model="PINHOLE",
            width=_SIZE_PX[0],
            height=_SIZE_PX[1],
            params=[_FOCAL_PX, _FOCAL_PX, _SIZE_PX[0] / 2, _SIZE_PX[1] / 2],
        )
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=str(row), keypoints=seen_px_NP2[row], camera_id=row + 1, image_id=row + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(cam_T_world[:3]))
    for number, position in enumerate(xyz):
        track = pycolmap.Track([pycolmap.TrackElement(row + 1, number) for row in range(len(world_T_cam))])
        model.add_point3D(position, track)
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = _LOSS_PX
    options.ceres.solver_options.num_threads = 1
    pycolmap.bundle_adjustment(model, options)
    poses = np.array([model.image(row + 1).cam_from_world().inverse().matrix() for row in range(len(world_T_cam))])
    points = model.points3D
    return make_pose(poses[:, :, :3], poses[:, :, 3]), np.array([points[i].xyz for i in sorted(points)])


def _error_without_gauge(truth: Array, adjusted: Array) -> Array:
    """Rotation and position errors (N, 6) that no similarity of all positions explains, by least squares."""
    rotation = Rotation.from_matrix(truth[:, :3, :3] @ np.swapaxes(adjusted[:, :3, :3], 1, 2)).as_rotvec()
    error = np.concatenate([rotation, truth[:, :3, 3] - adjusted[:, :3, 3]], axis=1)
    centred = truth[:, :3, 3] - truth[:, :3, 3].mean(axis=0)
    moves = np.zeros((len(truth), 6, 7))
    for axis in range(3):
        moves[:, axis, axis] = moves[:, 3 + axis, 3 + axis] = 1
        moves[:, 3:, axis] = np.cross(np.eye(3)[axis], centred)
    moves[:, 3:, 6] = centred
    weight = np.repeat([0.0, 1.0], 3)[:, None]
    explained, *_ = np.linalg.lstsq((weight * moves).reshape(-1, 7), (weight[:, 0] * error).ravel(), rcond=None)
    return error - (moves @ explained)
