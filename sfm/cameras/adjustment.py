"""Bundle adjustment with a camera as phones have it: a lens and a rolling shutter that a device's frames share, a focal
length that a session's frames share up to a factor, and a focus that breathes.

Of an observation the point is seen from where the camera was at tau = share readout after the middle row, share = y /
height - 1/2 where the sensor's rows are the image's (`groundwalk.geometry.shutter`): with angular velocity w and
velocity v in the axes of the camera, a point p there is seen along exp(-w tau) (p - v tau). The lens is OpenCV's k1,
k2, k3 (`groundwalk.geometry.lens`), further coefficients stay as they are stated.

Unknowns: poses and points; k1, k2, k3, readout time and principal point of each lens; the logarithm of the factor of
each session's focal lengths; and of each frame what its focal length deviates by from that and its angular velocity.
All but poses and points have priors. Gauss-Newton with Levenberg's damping on Cauchy's loss, points eliminated (Triggs
et al., "Bundle adjustment - a modern synthesis", 2000). Each point's residuals count by its own variance
(`point_noise`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array
from scipy.spatial.transform import Rotation

from groundwalk.geometry.lens import distort_with_slope, fold_radius, slope_by_numerator
from groundwalk.geometry.poses import Array, skew
from groundwalk.geometry.robust import CAUCHY_WIDTH, SIGMA_OF_MEDIAN, cauchy_weights
from groundwalk.geometry.rows import summed
from groundwalk.geometry.shutter import readout_fraction, sensor_axes
from groundwalk.sfm.cameras.normal_equations import (
    MAX_FACTORED,
    IterativeSolver,
    Solver,
    System,
    block_rows,
    inverse_of,
    similarities,
)
from groundwalk.store.progress import track

Ints = NDArray[np.int64]

_POSE, _FOCUS, _ANGULAR = slice(0, 6), 6, slice(7, 10)
_LOCAL = 10
# k1, k2, k3, readout and principal point of a lens; the numbers of the last two.
LENS_UNKNOWNS, READOUT, CENTRE = 6, 3, slice(4, 6)
RADIAL = [0, 1, 4]
"""k1, k2, k3 of OpenCV's coefficients."""
_MIN_LOSS_PX = 0.05
_MAX_STEPS = 15
# While cameras may be far off: misfit in the corners is no outlier, so a wider loss lets it count.
_ROUGH_MAX_STEPS, _ROUGH_LOSS_WIDENING = 8, 4.0
# Variances of points' errors differ as inverse chi-squared numbers of so many degrees of freedom (three to five in
# captures); residuals beyond so many sigmas count as that.
_NOISE_FREEDOM, _MAX_NOISE_SIGMAS, _NOISE_STEPS = 4.0, 3.0, 5
_MAX_DAMPINGS = 6
_OBSERVATIONS = 1 << 15  # at once
_MIN_READOUT_S = 1e-6
_MIN_COST_DECREASE = 1e-4  # relative change of the cost
# How long a focus stays as it is, and the share of its variance that is each frame's alone.
_FOCUS_LAG_S, _FOCUS_NOISE = 5.0, 1e-3


@dataclass(frozen=True)
class Cameras:
    """Cameras of N frames of S sessions and L lenses: what a device states and what is estimated of it.

    `intrinsics` (N, 4) are fx, fy, cx, cy as logged, `readout_line` (N, 3) says when a pixel is exposed
    (`groundwalk.geometry.shutter`), `lens` and `session` (N,) indices, `t_s` (N,);
    `coefficients` (L, 8) OpenCV's, `readout_s` (L,), `centre_px` (L, 2) by how much principal points are off the logged
    ones along the sensor's rows and columns; `log_focal` (S,) and `focus` (N,) logarithms of factors to the
    focal lengths; `angular` (N, 3) rad/s and `velocity` (N, 3) sfm units/s in the camera's axes.
    """

    intrinsics: Array
    readout_line: Array
    lens: Ints
    session: Ints
    t_s: Array
    coefficients: Array
    readout_s: Array
    centre_px: Array
    log_focal: Array
    focus: Array
    angular: Array
    velocity: Array

    @property
    def centre(self) -> Array:
        """(N, 2) principal points in pixels."""
        return self.intrinsics[:, 2:] + np.einsum(
            "nk,nkx->nx", self.centre_px[self.lens], sensor_axes(self.readout_line)
        )

    @property
    def focal(self) -> Array:
        """(N, 2) focal lengths in pixels, all factors applied."""
        return self.intrinsics[:, :2] * np.exp(self.log_focal[self.session] + self.focus)[:, None]


@dataclass(frozen=True)
class CameraPriors:
    """Means of the unknowns of cameras, as `Cameras`; covariance (L, 6, 6) of k1, k2, k3, readout in s and principal
    point in px; and one sigma of log focal factors (S,), of a frame's focus by session (S,) and of a frame's angular
    velocity (N, 3) in rad/s."""

    mean: Cameras
    lens_covariance: Array
    log_focal_sd: Array
    focus_sd: Array
    angular_sd: Array


@dataclass(frozen=True)
class Bundle:
    """What is adjusted: poses sfm_T_cam (N, 4, 4), points (P, 3), and where M observations lie in the images (M, 2;
    px), in the order of their frames. `held_frames` and `held_points` are indices of those that stay as they are, with
    the cameras of such frames; where there are any, they fix the gauge."""

    sfm_T_cam: Array
    xyz: Array
    frame: Ints
    point: Ints
    observed_px: Array
    held_frames: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    held_points: Ints = field(default_factory=lambda: np.empty(0, np.int64))


@dataclass(frozen=True)
class Linearization:
    """Residuals (M, 2) px and their derivatives: by camera (M, 2, 17), that is by the 10 unknowns of the frame, the 6
    of its lens and the 1 of its session; and by the point (M, 2, 3)."""

    residual: Array
    by_camera: Array
    by_point: Array

    def over(self, noise_M: Array) -> "Linearization":
        """The same in units of each observation's noise (M,): residuals and derivatives are divided in place,
        for memory."""
        for values in (self.residual, self.by_camera, self.by_point):
            np.divide(values.T, noise_M, out=values.T)
        return self


@dataclass(frozen=True)
class Adjusted:
    """An adjusted bundle, its cameras, the width of the Cauchy loss in px, and what that is multiplied by for the
    observations of each point, (P,), as `point_noise` says."""

    bundle: Bundle
    cameras: Cameras
    priors: CameraPriors
    loss_px: float
    noise: Array

    @property
    def noise_M(self) -> Array:
        """`noise` of each observation."""
        return np.asarray(self.noise[self.bundle.point], float)


def project(bundle: Bundle, cameras: Cameras, *, shutter: bool = True) -> Array:
    """Where each observation's point is seen, (M, 2) px; without the shutter: as if all rows were the middle one."""
    parts = [_forward(_part(bundle, own), cameras, shutter=shutter).pixel for own in _chunks(bundle)]
    return np.concatenate([np.empty((0, 2)), *parts])


def folded(bundle: Bundle, cameras: Cameras) -> np.ndarray:
    """Which observations (M,) are of points outside the field of view that the distortion polynomial, which isn't
    monotonic, folds back into the image. One of them can spoil a lens: it has far more leverage than any other."""
    limit_L = np.array([fold_radius(coefficients) for coefficients in cameras.coefficients])
    ideal = [_forward(_part(bundle, own), cameras).ideal for own in _chunks(bundle)]
    radius = np.linalg.norm(np.concatenate([np.empty((0, 2)), *ideal]), axis=1)
    return np.asarray(radius > limit_L[cameras.lens[bundle.frame]])


@dataclass(frozen=True)
class _Forward:
    """On the way from points to pixels (M, 2): the point minus its camera in the sfm frame (M, 3), in the camera's axes
    at its row's time (M, 3), at unit focal length before the lens (M, 2), the lens's derivative there (M, 2, 2); the
    row's share of the readout (M,), its time after the middle row (M,) s, and the camera's turn since then."""

    pixel: Array
    cam_R_sfm: Array
    offset: Array
    in_row: Array
    ideal: Array
    slope: Array
    row: Array
    tau: Array
    row_R_cam: Rotation


def _forward(bundle: Bundle, cameras: Cameras, *, shutter: bool = True) -> _Forward:
    i = bundle.frame
    cam_R_sfm = np.swapaxes(bundle.sfm_T_cam[:, :3, :3], 1, 2)[i]
    offset = bundle.xyz[bundle.point] - bundle.sfm_T_cam[i, :3, 3]
    p = np.einsum("mij,mj->mi", cam_R_sfm, offset)
    row = readout_fraction(cameras.readout_line[i], bundle.observed_px)
    tau = row * cameras.readout_s[cameras.lens[i]] if shutter else np.zeros(len(i))
    turn = Rotation.from_rotvec(-cameras.angular[i] * tau[:, None])
    q = turn.apply(p - cameras.velocity[i] * tau[:, None])
    n = q[:, :2] / q[:, 2:]
    d, slope = distort_with_slope(n, cameras.coefficients[cameras.lens[i]])
    pixel = cameras.focal[i] * d + cameras.centre[i]
    return _Forward(pixel, cam_R_sfm, offset, q, n, slope, row, tau, turn)


def linearize(bundle: Bundle, cameras: Cameras) -> Linearization:
    """Residuals, projected minus observed, and their derivatives."""
    count, width = len(bundle.frame), _LOCAL + LENS_UNKNOWNS + 1
    linear = Linearization(np.empty((count, 2)), np.empty((count, 2, width)), np.empty((count, 2, 3)))
    for own in _chunks(bundle):
        linear.residual[own] = _linearize(_part(bundle, own), cameras, linear.by_camera[own], linear.by_point[own])
    return linear


def _linearize(bundle: Bundle, cameras: Cameras, by_camera: Array, by_point: Array) -> Array:
    """The residuals; fills in their derivatives."""
    forward = _forward(bundle, cameras)
    pixel, q, n, tau, turn = forward.pixel, forward.in_row, forward.ideal, forward.tau, forward.row_R_cam
    i = bundle.frame
    focal = cameras.focal[i]
    x, y = n.T
    by_n = focal[:, :, None] * forward.slope
    z = q[:, 2]
    n_by_q = np.zeros((len(n), 2, 3))
    n_by_q[:, 0, 0] = n_by_q[:, 1, 1] = 1 / z
    n_by_q[:, 0, 2], n_by_q[:, 1, 2] = -x / z, -y / z
    by_q = by_n @ n_by_q
    by_p = by_q @ turn.as_matrix()
    by_point[:] = by_p @ forward.cam_R_sfm
    by_frame, by_shared = by_camera[:, :, :_LOCAL], by_camera[:, :, _LOCAL:]
    by_frame[:, :, :3] = by_point @ skew(forward.offset)
    by_frame[:, :, 3:6] = -by_point
    by_frame[:, :, _FOCUS] = pixel - cameras.centre[i]
    by_frame[:, :, _ANGULAR] = by_q @ (tau[:, None, None] * skew(q))
    by_shared[:, :, : len(RADIAL)] = focal[:, :, None] * slope_by_numerator(n, cameras.coefficients[cameras.lens[i]])
    moving = np.cross(q, cameras.angular[i]) - turn.apply(cameras.velocity[i])
    by_shared[:, :, READOUT] = np.einsum("mij,mj->mi", by_q, moving * forward.row[:, None])
    by_shared[:, :, CENTRE] = np.swapaxes(sensor_axes(cameras.readout_line), 1, 2)[i]
    by_shared[:, :, LENS_UNKNOWNS] = by_frame[:, :, _FOCUS]
    by_camera[np.isin(i, bundle.held_frames)] = 0.0
    by_point[np.isin(bundle.point, bundle.held_points)] = 0.0
    return np.asarray(pixel - bundle.observed_px)


def _chunks(bundle: Bundle) -> list[slice]:
    """Observations some at a time, for memory."""
    count = len(bundle.frame)
    return [slice(first, min(first + _OBSERVATIONS, count)) for first in range(0, count, _OBSERVATIONS)]


def _part(bundle: Bundle, own: slice) -> Bundle:
    """The bundle with some of its observations."""
    return replace(bundle, frame=bundle.frame[own], point=bundle.point[own], observed_px=bundle.observed_px[own])


def shared_columns(cameras: Cameras) -> Ints:
    """(N, 7) which shared unknowns each frame has: those of its lens, log focal of its session."""
    lenses = len(cameras.readout_s)
    of_lens = LENS_UNKNOWNS * cameras.lens[:, None] + np.arange(LENS_UNKNOWNS)
    return np.concatenate([of_lens, LENS_UNKNOWNS * lenses + cameras.session[:, None]], axis=1)


def regular_system(
    bundle: Bundle, cameras: Cameras, linear: Linearization, weight_M: Array, information: csr_array
) -> System:
    """The system, without the points, of residuals weighted by `weight_M` (M,): over the 10 N unknowns of frames, then
    those of lenses, then sessions' log focal factors.

    The information of priors (px^2) and a stiffness against moving the whole model are added: its matrix can be
    inverted; its gradient is that of the residuals alone.
    """
    frames, points = len(bundle.sfm_T_cam), len(bundle.xyz)
    columns = shared_columns(cameras)
    shared = LENS_UNKNOWNS * len(cameras.readout_s) + len(cameras.log_focal)
    size = _LOCAL * frames
    w = np.sqrt(weight_M)[:, None]
    residual, by_point = w * linear.residual, w[:, :, None] * linear.by_point
    point_blocks = summed(outer(by_point, by_point), bundle.point, points)
    point_blocks += 1e-9 * np.trace(point_blocks, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    point_blocks[bundle.held_points] = np.eye(3)
    point_pull = summed(np.sum(by_point * residual[:, :, None], axis=1), bundle.point, points)
    lower_inverse = np.linalg.inv(np.linalg.cholesky(point_blocks))
    # J^T J (N, 17, 17) and J^T r (N, 17) of each frame. With V = L L^T the points' part of the Schur complement,
    # W V^-1 W^T, is A A^T with A = W L^-T. Frame by frame, for memory.
    width, bounds = linear.by_camera.shape[2], np.searchsorted(bundle.frame, np.arange(frames + 1))
    blocks, pull = np.zeros((frames, width, width)), np.zeros((frames, width))
    of_frames, by_column = np.empty((len(w), _LOCAL, 3)), np.zeros((shared, points, 3))
    for k in range(frames):
        own = slice(bounds[k], bounds[k + 1])
        by_camera, point = w[own, :, None] * linear.by_camera[own], bundle.point[own]
        jacobian = by_camera.reshape(-1, width)
        blocks[k], pull[k] = jacobian.T @ jacobian, jacobian.T @ residual[own].ravel()
        a_blocks = outer(by_camera, by_point[own]) @ np.swapaxes(lower_inverse, 1, 2)[point]
        of_frames[own] = a_blocks[:, :_LOCAL]
        for j, column in enumerate(columns[k]):
            np.add.at(by_column[column], point, a_blocks[:, _LOCAL + j])
    # Nothing pulls at what is held; any information keeps it where it is.
    blocks[bundle.held_frames, :6, :6] = np.eye(6)
    local = block_rows(of_frames, bundle.frame, bundle.point, frames, points)
    of_shared = by_column.reshape(shared, 3 * points)
    scaled_pull = np.einsum("pij,pj->pi", lower_inverse, point_pull).ravel()
    gradient = np.empty(size + shared)
    gradient[:size] = pull[:, :_LOCAL].ravel() - local @ scaled_pull
    gradient[size:] = -of_shared @ scaled_pull
    for k in range(LENS_UNKNOWNS + 1):
        np.add.at(gradient, size + columns[:, k], pull[:, _LOCAL + k])
    position = bundle.sfm_T_cam[:, :3, 3]
    system = System(
        blocks=blocks,
        columns=columns,
        of_points=local,
        of_points_shared=of_shared,
        gradient=gradient,
        point_root=lower_inverse,
        point_gradient=point_pull,
        information=information,
        gauge=np.zeros((size, 0)),
        position=position,
        held=bundle.held_frames,
    )
    if len(bundle.held_points):
        return system
    return replace(system, gauge=_stiffness(system.diagonal(), position))


def outer(a_M2k: Array, b_M2l: Array) -> Array:
    """a^T b of each of M blocks, (M, k, l)."""
    return a_M2k[:, 0, :, None] * b_M2l[:, 0, None, :] + a_M2k[:, 1, :, None] * b_M2l[:, 1, None, :]


def prior_information(cameras: Cameras, priors: CameraPriors) -> csr_array:
    """(10 N + G, 10 N + G) information of the priors; a session's focus is one smooth (Ornstein-Uhlenbeck) process."""
    frames, lenses, sessions = len(cameras.t_s), len(cameras.readout_s), len(cameras.log_focal)
    size = _LOCAL * frames
    rows, columns, values = [], [], []

    def add(index: Ints, block: Array) -> None:
        row, column = np.meshgrid(index, index, indexing="ij")
        rows.append(row.ravel())
        columns.append(column.ravel())
        values.append(block.ravel())

    angular = (_LOCAL * np.arange(frames)[:, None] + np.arange(_ANGULAR.start, _ANGULAR.stop)).ravel()
    rows.append(angular)
    columns.append(angular)
    values.append((1 / priors.angular_sd**2).ravel())
    for session in range(sessions):
        members = np.flatnonzero(cameras.session == session)
        covariance = _focus_covariance(cameras.t_s[members], priors.focus_sd[session])
        add(_LOCAL * members + _FOCUS, np.asarray(np.linalg.inv(covariance), float))
        add(np.array([size + LENS_UNKNOWNS * lenses + session]), np.array([[1 / priors.log_focal_sd[session] ** 2]]))
    for lens in range(lenses):
        add(size + LENS_UNKNOWNS * lens + np.arange(LENS_UNKNOWNS), np.linalg.inv(priors.lens_covariance[lens]))
    total = size + LENS_UNKNOWNS * lenses + sessions
    entries = (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns)))
    return csr_array(coo_array(entries, shape=(total, total)))


def prior_draw(cameras: Cameras, priors: CameraPriors, rng: np.random.Generator) -> Array:
    """Deviations of all unknowns (10 N + G,) from their priors' means, drawn by those; 0 for poses."""
    frames = len(cameras.t_s)
    of_frame = np.zeros((frames, _LOCAL))
    of_frame[:, _ANGULAR] = priors.angular_sd * rng.standard_normal((frames, 3))
    for session in range(len(cameras.log_focal)):
        members = np.flatnonzero(cameras.session == session)
        covariance = _focus_covariance(cameras.t_s[members], priors.focus_sd[session])
        of_frame[members, _FOCUS] = np.linalg.cholesky(covariance) @ rng.standard_normal(len(members))
    of_lens = np.linalg.cholesky(priors.lens_covariance) @ rng.standard_normal(
        (len(cameras.readout_s), LENS_UNKNOWNS, 1)
    )
    log_focal = priors.log_focal_sd * rng.standard_normal(len(priors.log_focal_sd))
    return np.concatenate([of_frame.ravel(), of_lens.ravel(), log_focal])


def _focus_covariance(t_s: Array, sd: float) -> Array:
    """(n, n) of the focus of a session's frames at times (n,) s."""
    smooth = np.exp(-np.abs(t_s[:, None] - t_s) / _FOCUS_LAG_S) + _FOCUS_NOISE * np.eye(len(t_s))
    return np.asarray(sd**2 * smooth)


def camera_unknowns(cameras: Cameras) -> Array:
    """(10 N + G,) the unknowns of the cameras as a vector; 0 for poses."""
    of_frame = np.zeros((len(cameras.t_s), _LOCAL))
    of_frame[:, _FOCUS], of_frame[:, _ANGULAR] = cameras.focus, cameras.angular
    of_lens = np.concatenate([cameras.coefficients[:, RADIAL], cameras.readout_s[:, None], cameras.centre_px], axis=1)
    return np.concatenate([of_frame.ravel(), of_lens.ravel(), cameras.log_focal])


def with_step(bundle: Bundle, cameras: Cameras, step: Array, point_step: Array) -> tuple[Bundle, Cameras]:
    """The bundle and cameras moved by a step of the unknowns (10 N + G,) and of the points (P, 3)."""
    frames, lenses = len(bundle.sfm_T_cam), len(cameras.readout_s)
    of_frame = step[: _LOCAL * frames].reshape(frames, _LOCAL)
    of_lens = step[_LOCAL * frames :][: LENS_UNKNOWNS * lenses].reshape(lenses, LENS_UNKNOWNS)
    sfm_T_cam = bundle.sfm_T_cam.copy()
    sfm_T_cam[:, :3, :3] = Rotation.from_rotvec(of_frame[:, :3]).as_matrix() @ sfm_T_cam[:, :3, :3]
    sfm_T_cam[:, :3, 3] += of_frame[:, 3:6]
    coefficients = cameras.coefficients.copy()
    coefficients[:, RADIAL] += of_lens[:, :READOUT]
    moved = replace(
        cameras,
        focus=cameras.focus + of_frame[:, _FOCUS],
        angular=cameras.angular + of_frame[:, _ANGULAR],
        coefficients=coefficients,
        readout_s=cameras.readout_s + of_lens[:, READOUT],
        centre_px=cameras.centre_px + of_lens[:, CENTRE],
        log_focal=cameras.log_focal + step[_LOCAL * frames + LENS_UNKNOWNS * lenses :],
    )
    return replace(bundle, sfm_T_cam=sfm_T_cam, xyz=bundle.xyz + point_step), moved


def adjust(bundle: Bundle, cameras: Cameras, priors: CameraPriors, *, rough: bool = False) -> Adjusted:
    """Adjust everything; raises LinAlgError where the scene is too small to tell.

    `rough` is for cameras that may be far off: fewer steps with a wider loss, in which all points count alike.
    """
    prior_mean, information = camera_unknowns(priors.mean), prior_information(cameras, priors)

    def cost_of(residual_M2: Array, cameras: Cameras, loss_px: float, variance: float) -> float:
        deviation = camera_unknowns(cameras) - prior_mean
        of_residuals = loss_px**2 * np.sum(np.log1p(np.sum(residual_M2**2, axis=1) / loss_px**2))
        return float(of_residuals + variance * deviation @ (information @ deviation)) / 2

    damping, solver = 1e-6, Solver()
    noise, loss_px = np.ones(len(bundle.xyz)), _MIN_LOSS_PX
    steps, widening = (_ROUGH_MAX_STEPS, _ROUGH_LOSS_WIDENING) if rough else (_MAX_STEPS, 1.0)
    # It mostly takes fewer steps.
    for _ in track(range(steps), "adjusting cameras"):
        linear = linearize(bundle, cameras)
        if not rough:
            noise = point_noise(bundle, linear.residual)
            linear = linear.over(noise[bundle.point])
        loss_px = loss_of(linear.residual)
        wide_px, variance = widening * loss_px, loss_variance(loss_px)
        weight = cauchy_weights(linear.residual, wide_px)
        before = cost_of(linear.residual, cameras, wide_px, variance)
        system = regular_system(bundle, cameras, linear, weight, variance * information)
        del linear  # for memory
        gradient = system.gradient + variance * (information @ (camera_unknowns(cameras) - prior_mean))
        diagonal = system.diagonal()
        for _ in range(_MAX_DAMPINGS):
            step = solver.solve(system, diagonal, damping, -gradient)
            moved = with_step(bundle, cameras, step, system.point_step(step))
            residual = (project(*moved) - bundle.observed_px) / noise[bundle.point, None]
            cost = cost_of(residual, moved[1], wide_px, variance)
            if np.isfinite(cost) and cost <= before:
                damping = max(damping / 10, 1e-9)
                break
            damping *= 30
        else:
            break
        bundle, cameras = moved
        del system  # two of them needn't fit into memory
        if before - cost < _MIN_COST_DECREASE * before:
            break
    return Adjusted(bundle, cameras, priors, loss_px, noise)


def point_noise(bundle: Bundle, residual_M2: Array) -> Array:
    """The standard deviation of each point's features over the usual one, (P,), by their residuals (M, 2) in px.

    Features of some points are found much more precisely than those of others: a point's errors are nearly normal, and
    from point to point their variance differs (docs/explanation/sfm.md). It is known by the point's residuals, three
    numbers of which went into its position, and by how variances are distributed (conjugate prior, Gelman et al.,
    Bayesian Data Analysis, 2013, 2.6).
    """
    count = np.bincount(bundle.point, minlength=len(bundle.xyz))
    square = np.sum(residual_M2**2, axis=1)
    usual = loss_variance(loss_of(residual_M2))
    variance = np.full(len(count), usual)
    for _ in range(_NOISE_STEPS):
        bounded = np.minimum(square, 2 * _MAX_NOISE_SIGMAS**2 * variance[bundle.point])
        total = _NOISE_FREEDOM * usual + np.bincount(bundle.point, bounded, len(count))
        variance = total / (_NOISE_FREEDOM + np.maximum(2 * count - 3, 0))
    return np.asarray(np.sqrt(variance / usual), float)


def is_large(frames: int) -> bool:
    """Whether a model of so many frames is too large for a matrix over all of its unknowns."""
    return _LOCAL * frames > MAX_FACTORED


def marginal_readout(adjusted: Adjusted) -> Adjusted:
    """The adjusted bundle with readout times whose bias is taken out, and all else moved along with them.

    A frame's angular velocity w times the readout r is what its rows show. Where both are adjusted together, a larger r
    makes each of its w less costly, as many times as there are frames, and r comes out too large by some per cent: the
    maximum of the posterior of all unknowns isn't where r alone is most likely (Neyman and Scott, Econometrica 16,
    1948). What is missing is the determinant of the information of the rest, whose derivative by log r is the number of
    angular velocities that images rather than VIO tell; this is one Newton step towards the maximum with it (Laplace).
    """
    bundle, cameras = adjusted.bundle, adjusted.cameras
    system = _normal_equations(adjusted)
    variances, solved = _inverse(adjusted, system)
    variance = loss_variance(adjusted.loss_px)
    by_images = np.sum(1 - variances[1] / adjusted.priors.angular_sd**2, axis=1)
    pull = np.zeros(len(system.gradient))
    readout = _LOCAL * len(cameras.t_s) + LENS_UNKNOWNS * np.arange(len(cameras.readout_s)) + READOUT
    rolls = np.abs(cameras.readout_s) > _MIN_READOUT_S
    pull[readout[rolls]] = variance * np.bincount(cameras.lens, by_images)[rolls] / cameras.readout_s[rolls]
    step = -solved(pull)
    at_rest = replace(system, point_gradient=np.zeros_like(system.point_gradient))
    moved = with_step(bundle, cameras, step, at_rest.point_step(step))
    return replace(adjusted, bundle=moved[0], cameras=moved[1])


def frame_variances(adjusted: Adjusted) -> tuple[Array, Array]:
    """The variances of each frame's focus (N,) and angular velocity (N, 3), rad^2/s^2, by images and priors."""
    return _inverse(adjusted, _normal_equations(adjusted))[0]


def _inverse(adjusted: Adjusted, system: System) -> tuple[tuple[Array, Array], Callable[[Array], Array]]:
    """`frame_variances` of the adjusted bundle's system, and what multiplies a vector by its inverse; what is held has
    its priors' variances, and isn't moved."""
    cameras, priors, held = adjusted.cameras, adjusted.priors, adjusted.bundle.held_frames
    free = system.of_free
    if is_large(len(free.blocks)):
        solver = IterativeSolver(free, free.diagonal(), 0.0)
        diagonal = np.append(solver.preconditioner.variances(), np.zeros(len(free.gradient) - free.size))

        def product(right: Array) -> Array:
            return solver.solve(right)[0]

    else:
        inverse = inverse_of(free.matrix())
        diagonal = np.diag(inverse)

        def product(right: Array) -> Array:
            return np.asarray(inverse @ right)

    variances = loss_variance(adjusted.loss_px) * system.with_held(diagonal)
    of_frame = variances[: _LOCAL * len(cameras.t_s)].reshape(-1, _LOCAL)
    focus, angular = of_frame[:, _FOCUS], of_frame[:, _ANGULAR]
    focus[held], angular[held] = priors.focus_sd[cameras.session[held]] ** 2, priors.angular_sd[held] ** 2
    return (focus, angular), lambda right: system.with_held(product(right[system.free]))


def _normal_equations(adjusted: Adjusted) -> System:
    """The system at an adjusted model."""
    linear = linearize(adjusted.bundle, adjusted.cameras).over(adjusted.noise_M)
    weight = cauchy_weights(linear.residual, adjusted.loss_px)
    information = loss_variance(adjusted.loss_px) * prior_information(adjusted.cameras, adjusted.priors)
    return regular_system(adjusted.bundle, adjusted.cameras, linear, weight, information)


def loss_variance(loss_px: float) -> float:
    """The variance of the residuals (px^2) that a loss of this width is for."""
    return (loss_px / CAUCHY_WIDTH) ** 2


def local_unknowns(frames: int) -> Ints:
    """(N, 10) where each frame's unknowns are among all: rotation, position, focus, angular velocity."""
    return np.arange(_LOCAL * frames).reshape(frames, _LOCAL)


def loss_of(residual_M2: Array) -> float:
    """The width of a Cauchy loss for residuals (M, 2), px."""
    return max(CAUCHY_WIDTH * SIGMA_OF_MEDIAN * float(np.median(np.abs(residual_M2))), _MIN_LOSS_PX)


def _stiffness(diagonal: Array, position_N3: Array) -> Array:
    """G (10 N, 7) of a stiffness G G^T against moving, turning and scaling all poses together."""
    frames = len(position_N3)
    gauge = np.zeros((frames, _LOCAL, 7))
    gauge[:, :6] = similarities(position_N3)
    extent2 = float(np.mean(gauge[:, 3:6, 6] ** 2) * 3)
    gauge[:, :3] *= extent2
    directions = gauge.reshape(-1, 7)
    pose_diagonal = diagonal[: _LOCAL * frames].reshape(frames, _LOCAL)[:, :6].sum()
    return np.asarray(np.sqrt(pose_diagonal / np.sum(directions**2)) * directions)
