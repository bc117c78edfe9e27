"""A ruler in a model: corners triangulated with known poses, compared with where they are on the printed board.

Everything is in the model's frame and units; a ruler's nominal corners are in metres, so its scale is model units per
metre. Board axes are OpenCV's: x right, y down, z into the board, away from whoever looks at its front.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import Sim3, fit_robust, fit_sim3
from groundwalk.geometry.poses import Array, skew
from groundwalk.geometry.rows import summed

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

_STEPS = 3
# The least squares are of observations with at least this weight in a robust fit: residuals of up to four sigma.
_INLIER_WEIGHT = 0.05
_IRLS_TOLERANCE = 1e-3
# A ridge, relative to the mean curvature: rays without parallax give a far point instead of a singular matrix.
_RIDGE = 1e-12
# Corners of a part that lie on a line have no front side.
_LINE = 1e-3


@dataclass(frozen=True)
class Corners:
    """Nominal corners (K, 3) in metres, and the rigid part (K,) that each belongs to: a board is one, a tag is one."""

    xyz_m: Array
    part: Indices


@dataclass(frozen=True)
class Observations:
    """M observations: corner (M,) by index, frame (M,) by index of its pose, undistorted normalised image coordinates
    (M, 2), and the focal length (M,) that turns these into pixels. `cam_T_row` (M, 4, 4): the camera when the
    observation's row was exposed, in the axes of the frame's pose; None without a rolling shutter."""

    corner: Indices
    frame: Indices
    xy: Array
    focal_px: Array
    cam_T_row: Array | None = None

    def poses(self, model_T_cam: Array) -> Array:
        """(M, 4, 4) where the camera was at each observation, of the frames' poses (F, 4, 4)."""
        poses = model_T_cam[self.frame]
        return poses if self.cam_T_row is None else poses @ self.cam_T_row

    def where(self, mask: Mask) -> "Observations":
        """Those of a mask (M,)."""
        rows = None if self.cam_T_row is None else self.cam_T_row[mask]
        return Observations(self.corner[mask], self.frame[mask], self.xy[mask], self.focal_px[mask], rows)


@dataclass(frozen=True)
class RulerFit:
    """A ruler measured in a model.

    `log_scale`: logarithm of model units per metre of the ruler, and `sd`, its standard error. `xyz` (K, 3) and
    `fitted` (K, 3): corners as triangulated, and nominal ones by the similarity, NaN where not seen from two frames.
    `residual_px` (M, 2): triangulated corner minus observation, `inlier` (M,) the observations in the fit.
    `frames`: indices of the frames in the fit. `angle`: largest angle between two of their rays, radians.
    `pixel_sd`: standard deviation of an observation in an image axis. `mirrored`: the frames are behind the board's
    front.
    """

    log_scale: float
    sd: float
    xyz: Array
    fitted: Array
    residual_px: Array
    inlier: Mask
    frames: Indices
    angle: float
    pixel_sd: float
    mirrored: bool
    flatness: float

    @property
    def reprojection_px(self) -> float:
        """Root mean square distance in the image, triangulated corners to inlier observations."""
        return float(np.sqrt(np.mean(np.sum(self.residual_px[self.inlier] ** 2, axis=1))))

    @property
    def corner_rms_m(self) -> float:
        """Root mean square distance of triangulated from fitted corners, metres of the ruler."""
        return float(np.sqrt(np.nanmean(np.sum((self.xyz - self.fitted) ** 2, axis=1))) / np.exp(self.log_scale))

    @property
    def flatness_m(self) -> float:
        """Root mean square distance of triangulated corners from the best plane of their part; NaN without one."""
        return float(self.flatness / np.exp(self.log_scale))


@dataclass(frozen=True)
class _Linearization:
    """Residuals (M, 2) in pixels and their derivatives: by the corner (M, 2, 3), by the frame's pose error (M, 2, 6),
    rotation before position, as in the tables' covariances."""

    residual: Array
    by_corner: Array
    by_pose: Array


def in_two_frames(observations: Observations, count: int) -> Mask:
    """(M,) observations of a corner that two or more frames see; `count` corners in all."""
    pairs = np.unique(np.stack([observations.corner, observations.frame]), axis=1)
    return np.asarray(np.bincount(pairs[0], minlength=count)[observations.corner] >= 2)


def triangulate(observations: Observations, model_T_cam: Array, count: int, weights: Array) -> Array:
    """Corners (count, 3) with the least weighted sum of squared reprojection errors; NaN for those without
    observations. `model_T_cam` (F, 4, 4) are the frames' poses, `weights` (M,)."""
    corner, poses = observations.corner, observations.poses(model_T_cam)
    rays = np.einsum("mij,mj->mi", poses[:, :3, :3], np.column_stack([observations.xy, np.ones(len(corner))]))
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    centres = poses[:, :3, 3]
    origin = centres.mean(axis=0)
    offsets = _sums(across @ (centres - origin)[:, :, None], corner, count, weights)
    xyz = origin + _solve(_sums(across, corner, count, weights), offsets)
    for _ in range(_STEPS):
        at = _linearise(observations, model_T_cam, xyz)
        transposed = np.swapaxes(at.by_corner, 1, 2)
        hessian = _sums(transposed @ at.by_corner, corner, count, weights)
        xyz = xyz - _solve(hessian, _sums(transposed @ at.residual[:, :, None], corner, count, weights))
    return xyz


def measure(
    corners: Corners, observations: Observations, model_T_cam: Array, covariance: Array, *, min_pixel_sd: float
) -> RulerFit:
    """Triangulate a ruler's corners and fit the ruler to them by a similarity.

    `covariance` (F, 6, 6) of the poses' (rotation, position) errors, NaN where unknown: then only the scatter of the
    residuals counts. Wrong detections and frames with wrong poses lose their weight in a robust triangulation; least
    squares of the rest follow, in which a frame weighs less the more its pose may be off by in pixels.

    The standard error is the larger of two: by propagation of the pixels' sigma (at least `min_pixel_sd`) and of the
    poses' covariances, frames independent of each other; and by the scatter between frames of their share in the scale
    (Liang and Zeger, Biometrika 73, 1986, with frames as clusters), which includes errors that no covariance has.
    Raises GeometryError where no part has two corners that two frames see.
    """
    count = len(corners.xyz_m)
    usable, inlier = _inliers(observations, model_T_cam, count, min_pixel_sd)
    part, seen = corners.part, observations.corner[inlier]
    inlier[inlier] = np.bincount(part[np.unique(seen)], minlength=part.max() + 1)[part[seen]] >= 2
    if not inlier.any():
        raise GeometryError("no part of the ruler has two corners that two frames see")
    used = observations.where(inlier)
    xyz, weights, pixel_sd = _triangulate_inliers(used, model_T_cam, covariance, count, min_pixel_sd)
    covariance = np.nan_to_num(covariance)
    at = _linearise(used, model_T_cam, xyz)
    observed = np.unique(used.corner)
    hessian = _sums(np.swapaxes(at.by_corner, 1, 2) @ at.by_corner, used.corner, count, weights)
    hessian = _ridged(hessian[observed])
    certainty = np.zeros(count)  # of triangulated corners: one over their variance, up to a factor
    certainty[observed] = 1 / np.trace(np.linalg.inv(hessian), axis1=1, axis2=2)
    scale, fitted, gradient = _similarity(corners, xyz, certainty)
    moved = np.zeros_like(gradient)
    moved[observed] = np.linalg.solve(hessian, gradient[observed, :, None])[:, :, 0]
    # d log scale = sum of influence . residual, over all observations.
    influence = -weights[:, None] * np.einsum("mij,mj->mi", at.by_corner, moved[used.corner])
    sd = _scale_sd(at, used, covariance, influence, pixel_sd)
    residual = np.full((len(usable), 2), np.nan)
    residual[usable] = _linearise(observations.where(usable), model_T_cam, xyz).residual
    frames = np.unique(used.frame)
    rays = model_T_cam[frames, :3, 3] - np.nanmean(xyz, axis=0)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    spread = float(np.arccos(np.clip(rays @ rays.T, -1, 1)).max())
    shape = _is_seen_from_behind(corners, fitted, model_T_cam[frames, :3, 3]), _flatness(corners, xyz)
    return RulerFit(float(np.log(scale)), sd, xyz, fitted, residual, inlier, frames, spread, pixel_sd, *shape)


def triangulate_points(
    observations: Observations, model_T_cam: Array, covariance: Array, count: int, *, min_pixel_sd: float
) -> tuple[Array, Array, Mask]:
    """Points (count, 3) by the observations that fit, the covariances (count, 3, 3) of each, and which observations
    (M,) took part; NaN for points that two frames don't see. Arguments and method are `measure`'s."""
    _, inlier = _inliers(observations, model_T_cam, count, min_pixel_sd)
    xyz, point_covariance = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    if not inlier.any():
        return xyz, point_covariance, inlier
    used = observations.where(inlier)
    xyz, weights, pixel_sd = _triangulate_inliers(used, model_T_cam, covariance, count, min_pixel_sd)
    at, transposed = _linearise(used, model_T_cam, xyz), lambda m: np.swapaxes(m, 1, 2)
    seen = np.bincount(used.corner, minlength=count) > 0
    inverse = np.linalg.inv(_ridged(_sums(transposed(at.by_corner) @ at.by_corner, used.corner, count, weights)[seen]))
    # A residual is off by its pixel and by its frame's pose.
    of_residual = at.by_pose @ np.nan_to_num(covariance)[used.frame] @ transposed(at.by_pose) + pixel_sd**2 * np.eye(2)
    spread = _sums(transposed(at.by_corner) @ of_residual @ at.by_corner, used.corner, count, weights**2)[seen]
    point_covariance[seen] = inverse @ spread @ inverse
    return xyz, point_covariance, inlier


def _inliers(observations: Observations, model_T_cam: Array, count: int, min_pixel_sd: float) -> tuple[Mask, Mask]:
    """(M,) observations of corners that two frames see, and of these those that a robust triangulation keeps."""
    usable = in_two_frames(observations, count)
    robust = np.zeros(len(usable))
    if usable.any():
        seen = observations.where(usable)
        _, robust[usable] = fit_robust(
            lambda weights: triangulate(seen, model_T_cam, count, weights),
            lambda xyz: np.linalg.norm(_linearise(seen, model_T_cam, xyz).residual, axis=1),
            len(seen.corner),
            floor=2 * min_pixel_sd,
            tolerance=_IRLS_TOLERANCE,
        )
    inlier = usable & (robust >= _INLIER_WEIGHT)
    inlier[inlier] = in_two_frames(observations.where(inlier), count)
    return usable, inlier


def _triangulate_inliers(
    used: Observations, model_T_cam: Array, covariance: Array, count: int, min_pixel_sd: float
) -> tuple[Array, Array, float]:
    """Corners (count, 3) by least squares, the weights (M,) of observations in it, and their pixels' sigma."""
    xyz = triangulate(used, model_T_cam, count, np.ones(len(used.corner)))
    at = _linearise(used, model_T_cam, xyz)
    # What a frame's pose may be off by, as variance in an image axis, mean over its corners.
    variance = np.einsum("mij,mjk,mik->m", at.by_pose, np.nan_to_num(covariance)[used.frame], at.by_pose) / 2
    by_poses = (np.bincount(used.frame, variance) / np.maximum(np.bincount(used.frame), 1))[used.frame]
    # The residuals' scatter less that of the poses' errors.
    freedom = at.residual.size - 3 * len(np.unique(used.corner))
    pixel_sd = float(np.sqrt(max(np.sum(at.residual**2) / freedom - by_poses.mean(), min_pixel_sd**2)))
    weights = pixel_sd**2 / (pixel_sd**2 + by_poses)
    return triangulate(used, model_T_cam, count, weights), weights, pixel_sd


def _linearise(observations: Observations, model_T_cam: Array, xyz: Array) -> _Linearization:
    pose = observations.poses(model_T_cam)
    cam_R_model = np.swapaxes(pose[:, :3, :3], 1, 2)
    arm = xyz[observations.corner] - pose[:, :3, 3]
    x, y, z = np.moveaxis(np.einsum("mij,mj->mi", cam_R_model, arm), 1, 0)
    # A point in a camera's plane has no image; far off is where its residual belongs.
    z = np.where(np.abs(z) < 1e-9, 1e-9, z)
    projection = np.zeros((len(z), 2, 3))
    projection[:, 0, 0] = projection[:, 1, 1] = 1 / z
    projection[:, 0, 2], projection[:, 1, 2] = -x / z**2, -y / z**2
    by_corner = observations.focal_px[:, None, None] * projection @ cam_R_model
    residual = observations.focal_px[:, None] * (np.column_stack([x / z, y / z]) - observations.xy)
    # The camera truly is at exp(rotation) R, t + position: what is observed differs by the opposite of this.
    by_pose = np.concatenate([-by_corner @ skew(arm), by_corner], axis=2)
    return _Linearization(residual, by_corner, by_pose)


def _similarity(corners: Corners, xyz: Array, weights: Array) -> tuple[float, Array, Array]:
    """The scale that all parts share, nominal corners (K, 3) at each part's best place, and the derivative (K, 3) of
    the scale's logarithm by the triangulated corners (Umeyama, PAMI 13, 1991, eq. 41 and 42, summed over parts)."""
    strength, spread = 0.0, 0.0
    pulls, poses = np.zeros_like(xyz), {}
    for part in np.unique(corners.part[weights > 0]):
        rows = (corners.part == part) & (weights > 0)
        weight = weights[rows, None]
        nominal, measured = corners.xyz_m[rows], xyz[rows]
        rotation = fit_sim3(measured, nominal, weights[rows], line_ok=True).rotation
        middle, centre = (weight * nominal).sum(0) / weight.sum(), (weight * measured).sum(0) / weight.sum()
        pulls[rows] = weight * ((nominal - middle) @ rotation.T)
        strength += float(np.sum(pulls[rows] * (measured - centre)))
        spread += float(np.sum(weight * (nominal - middle) ** 2))
        poses[part] = rotation, middle, centre
    scale = strength / spread
    fitted = np.full_like(xyz, np.nan)
    for part, (rotation, middle, centre) in poses.items():
        rows = (corners.part == part) & (weights > 0)
        fitted[rows] = Sim3(scale, rotation, centre - scale * rotation @ middle).points(corners.xyz_m[rows])
    return scale, fitted, pulls / strength


def _scale_sd(at: _Linearization, used: Observations, covariance: Array, influence: Array, pixel_sd: float) -> float:
    by_pose = np.zeros((len(covariance), 6))
    np.add.at(by_pose, used.frame, np.einsum("mij,mi->mj", at.by_pose, influence))
    propagated = np.einsum("fi,fij,fj->", by_pose, covariance, by_pose) + pixel_sd**2 * np.sum(influence**2)
    frames = len(np.unique(used.frame))
    by_frame = np.bincount(used.frame, np.sum(influence * at.residual, axis=1))
    scatter = np.sum(by_frame**2) * frames / (frames - 1)
    return float(np.sqrt(max(propagated, scatter)))


def _is_seen_from_behind(corners: Corners, fitted: Array, centres: Array) -> bool:
    """Most of the frames (F, 3) are on the side that the parts' +z points to; a line has no sides."""
    sides = []
    for part in np.unique(corners.part):
        rows = (corners.part == part) & np.isfinite(fitted).all(axis=1)
        if rows.sum() < 3 or not _is_plane(corners.xyz_m[rows]):
            continue
        rotation = fit_sim3(fitted[rows], corners.xyz_m[rows]).rotation
        sides.append((centres - fitted[rows].mean(axis=0)) @ rotation[:, 2] > 0)
    return bool(sides) and float(np.mean(np.concatenate(sides))) > 0.5


def _flatness(corners: Corners, xyz: Array) -> float:
    """Root mean square distance from each part's best plane, in the model's units."""
    squares, count = 0.0, 0
    for part in np.unique(corners.part):
        rows = (corners.part == part) & np.isfinite(xyz).all(axis=1)
        if rows.sum() >= 4 and _is_plane(corners.xyz_m[rows]):
            squares += float(np.linalg.svd(xyz[rows] - xyz[rows].mean(axis=0), compute_uv=False)[2] ** 2)
            count += int(rows.sum())
    return float(np.sqrt(squares / count)) if count else float("nan")


def _is_plane(xyz: Array) -> bool:
    singular = np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)
    return bool(singular[1] > _LINE * singular[0])


def _sums(values: Array, index: Indices, count: int, weights: Array) -> Array:
    """Weighted sums (count, ...) of values (M, ...) with the same index (M,)."""
    return summed(weights.reshape(-1, *[1] * (values.ndim - 1)) * values, index, count)


def _solve(matrices: Array, vectors: Array) -> Array:
    """(K, 3) solutions of (K, 3, 3), (K, 3, 1); NaN where the matrix is empty."""
    result = np.full((len(matrices), 3), np.nan)
    is_full = np.trace(matrices, axis1=1, axis2=2) > 0
    result[is_full] = np.linalg.solve(_ridged(matrices[is_full]), vectors[is_full])[:, :, 0]
    return result


def _ridged(matrices: Array) -> Array:
    trace = np.trace(matrices, axis1=1, axis2=2)
    return np.asarray(matrices + _RIDGE * trace[:, None, None] * np.eye(3))
