"""Fits of one frame to another: similarity, rigid, yaw and translation, from points or poses, plain or robust.

Every fit of frame b to frame a takes a's data first and returns a_S_b or a_T_b, so that `a = a_T_b @ b` reads itself.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike

from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array, make_pose, rotation_angle, yaw_rotation

# Below this fraction of the largest singular value a direction counts as having no extent at all: it's rounding.
_RANK_TOLERANCE = 1e-10
_IRLS_ITERATIONS = 50
ROBUST_TOLERANCE = 1e-9
"""`fit_robust` goes on until no weight changes by more."""
# The first weights are the start of the second.
_IRLS_START_TOLERANCE = 1e-3

Model = TypeVar("Model")


@dataclass(frozen=True)
class Sim3:
    """The similarity a_S_b: x_a = scale * rotation @ x_b + translation."""

    scale: float
    rotation: Array
    translation: Array

    def points(self, xyz_b: ArrayLike) -> Array:
        """Points (..., 3) given in b, in a."""
        rotated = np.einsum("ij,...j->...i", self.rotation, np.asarray(xyz_b, dtype=float))
        return self.scale * rotated + self.translation

    def poses(self, b_T_cam: ArrayLike) -> Array:
        """Camera poses (..., 4, 4) given in b, in a; the camera's own axes keep their scale."""
        b_T_cam = np.asarray(b_T_cam, dtype=float)
        return make_pose(self.rotation @ b_T_cam[..., :3, :3], self.points(b_T_cam[..., :3, 3]))

    def inverse(self) -> "Sim3":
        """b_S_a."""
        return Sim3(1 / self.scale, self.rotation.T.copy(), -(self.rotation.T @ self.translation) / self.scale)

    def __matmul__(self, other: "Sim3") -> "Sim3":
        """a_S_c = a_S_b @ b_S_c."""
        return Sim3(self.scale * other.scale, self.rotation @ other.rotation, self.points(other.translation))


def fit_sim3(xyz_a: ArrayLike, xyz_b: ArrayLike, weights: ArrayLike | None = None, *, line_ok: bool = False) -> Sim3:
    """The a_S_b with the least weighted sum of squared distances |x_a - a_S_b x_b|, points (N, 3) both.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 13 (1991),
    eq. 40 to 42, with weights. Raises GeometryError for fewer than 3 points or points on a line, where the rotation
    isn't determined. With `line_ok` 2 points or points on a line give one of the best similarities: the turn about
    the line is arbitrary, the scale isn't.
    """
    a, b, w = _checked(xyz_a, xyz_b, weights, 2 if line_ok else 3)
    rotation, singular, mean_a, mean_b, spread_b = _procrustes(a, b, w)
    if not singular[0] > _rounding(a, b):
        raise GeometryError(f"{len(a)} points in one place determine no scale or rotation")
    if not line_ok:
        _require_rotation(singular)
    scale = float(singular.sum() / spread_b)
    return Sim3(scale, rotation, mean_a - scale * rotation @ mean_b)


def fit_se3(xyz_a: ArrayLike, xyz_b: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """The rigid a_T_b (4, 4) with the least weighted sum of squared distances, points (N, 3) both.

    Kabsch, Acta Cryst. A32 (1976), in Umeyama's form. Raises GeometryError like `fit_sim3`.
    """
    a, b, w = _checked(xyz_a, xyz_b, weights, 3)
    rotation, singular, mean_a, mean_b, _ = _procrustes(a, b, w)
    _require_rotation(singular)
    return make_pose(rotation, mean_a - rotation @ mean_b)


def fit_similarity(xyz_a: ArrayLike, xyz_b: ArrayLike, weights: ArrayLike, *, rigid: bool) -> Sim3:
    """As `fit_sim3`, or as `fit_se3` where it is `rigid`."""
    if not rigid:
        return fit_sim3(xyz_a, xyz_b, weights)
    a_T_b = fit_se3(xyz_a, xyz_b, weights)
    return Sim3(1.0, a_T_b[:3, :3], a_T_b[:3, 3])


def similarity_of_poses(a_T_cam: Array, b_T_cam: Array, scale: float | None = None) -> Sim3:
    """The a_S_b that took poses of b to those of a (N, 4, 4), but for rounding; where they are all in one place, its
    scale is 1 unless it is given."""
    xyz_a, xyz_b = a_T_cam[:, :3, 3], b_T_cam[:, :3, 3]
    spread_a, spread_b = (float(np.linalg.norm(xyz - xyz.mean(axis=0))) for xyz in (xyz_a, xyz_b))
    if scale is None:
        scale = spread_a / spread_b if spread_b > 0 else 1.0
    rotation = a_T_cam[0, :3, :3] @ b_T_cam[0, :3, :3].T
    return Sim3(scale, rotation, xyz_a.mean(axis=0) - scale * rotation @ xyz_b.mean(axis=0))


def fit_yaw(xyz_a: ArrayLike, xyz_b: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """The a_T_b (4, 4) of a rotation about +y and a translation with the least weighted sum of squared distances.

    The closed form of Zhang and Scaramuzza, "A tutorial on quantitative trajectory evaluation for
    visual(-inertial) odometry", IROS 2018, eq. 14 to 16, for +y up. Raises GeometryError for fewer than 2 points or
    points above each other, where the yaw isn't determined.
    """
    a, b, w = _checked(xyz_a, xyz_b, weights, 2)
    mean_a, mean_b = w @ a, w @ b
    cross = (w[:, None] * (b - mean_b)).T @ (a - mean_a)
    horizontal = [float(w @ np.sum((x - m)[:, ::2] ** 2, axis=1)) for x, m in ((a, mean_a), (b, mean_b))]
    rotation, strength = _best_yaw(cross)
    if strength <= max(_RANK_TOLERANCE * np.sqrt(horizontal[0] * horizontal[1]), _rounding(a, b)):
        raise GeometryError(f"{len(a)} points without horizontal extent don't determine a yaw")
    return make_pose(rotation, mean_a - rotation @ mean_b)


def fit_poses(
    a_T_cam: ArrayLike,
    b_T_cam: ArrayLike,
    weights: ArrayLike | None = None,
    *,
    position_sd_m: float,
    rotation_sd: float,
    yaw_only: bool = False,
) -> Array:
    """The rigid a_T_b (4, 4) that brings camera poses (N, 4, 4) of b onto those of a, N >= 1.

    Minimises the weighted sum of |position difference|^2 / position_sd_m^2 + |rotation difference|_F^2 /
    (2 rotation_sd^2); the last is angle^2 / rotation_sd^2 for small angles (radians). The camera rotations make it
    determined for straight paths and even a single pose. With `yaw_only` the rotation is about +y. Closed form: both
    terms are linear in the rotation (Horn et al., JOSA A 5, 1988, with the rotations as further matrices to match).
    Raises GeometryError for no poses.
    """
    a, b = np.asarray(a_T_cam, dtype=float), np.asarray(b_T_cam, dtype=float)
    xyz_a, xyz_b, w = _checked(a[:, :3, 3], b[:, :3, 3], weights, 1)
    mean_a, mean_b = w @ xyz_a, w @ xyz_b
    cross = (w[:, None] * (xyz_b - mean_b)).T @ (xyz_a - mean_a) / position_sd_m**2
    cross += np.einsum("n,nij,nkj->ik", w, b[:, :3, :3], a[:, :3, :3]) / (2 * rotation_sd**2)
    rotation = _best_yaw(cross)[0] if yaw_only else _best_rotation(cross)[0]
    return make_pose(rotation, mean_a - rotation @ mean_b)


def sim3_between(a_T_cam: ArrayLike, b_T_cam: ArrayLike) -> Sim3:
    """The a_S_b that turns camera poses (N, 4, 4) of b into those of a, where one similarity relates all of them.

    The camera rotations give the rotation, so that paths may be straight. GeometryError where all positions are the
    same, as nothing gives the scale then.
    """
    a, b = np.asarray(a_T_cam, dtype=float), np.asarray(b_T_cam, dtype=float)
    xyz_a, xyz_b, _ = _checked(a[:, :3, 3], b[:, :3, 3], None, 1)
    mean_a, mean_b = xyz_a.mean(axis=0), xyz_b.mean(axis=0)
    spread_a, spread_b = np.linalg.norm(xyz_a - mean_a), np.linalg.norm(xyz_b - mean_b)
    if spread_b**2 <= len(b) * _rounding(xyz_b, xyz_b):
        raise GeometryError(f"{len(a)} poses at one position don't determine a scale")
    rotation = _best_rotation(np.einsum("nij,nkj->ik", b[:, :3, :3], a[:, :3, :3]))[0]
    scale = float(spread_a / spread_b)
    return Sim3(scale, rotation, mean_a - scale * rotation @ mean_b)


def pose_residuals(a_T_cam: ArrayLike, b_T_cam: ArrayLike, a_T_b: ArrayLike) -> tuple[Array, Array]:
    """Residuals of a fit of poses (N, 4, 4): metres (N,) and radians (N,)."""
    a, moved = np.asarray(a_T_cam, dtype=float), np.asarray(a_T_b, dtype=float) @ np.asarray(b_T_cam, dtype=float)
    angle = rotation_angle(np.swapaxes(a[:, :3, :3], 1, 2) @ moved[:, :3, :3])
    return np.linalg.norm(a[:, :3, 3] - moved[:, :3, 3], axis=1), angle


def fit_robust(
    fit: Callable[[Array], Model],
    residuals: Callable[[Model], Array],
    count: int,
    *,
    floor: float,
    weights: ArrayLike | None = None,
    tolerance: float = ROBUST_TOLERANCE,
) -> tuple[Model, Array]:
    """A fit of `count` items that outliers hardly move: the model and its final weights (count,), 0 to 1.

    Iteratively reweighted least squares: first towards the least sum of absolute residuals, which resists gross
    outliers among the fitted-to data without a good start, then with Geman and McClure's weights, which let them go
    (Zhang, "Parameter estimation techniques", Image and Vision Computing 15, 1997). The kernel's width is twice the
    median residual, about three sigma for residuals of three axes, and at least `floor`, in their unit, below which
    residuals count alike. `weights` of the items are multiplied in. It ends when no weight changes by more
    than `tolerance`; the start need not be that good.

    `fit` takes weights (count,), `residuals` gives (count,) lengths for a model.
    """
    if floor <= 0:
        raise GeometryError(f"the residual floor must be positive, not {floor}")
    prior = np.ones(count) if weights is None else np.asarray(weights, dtype=float)
    model, robust = fit(prior), np.ones(count)
    for absolute in (True, False):
        max_change = max(tolerance, _IRLS_START_TOLERANCE) if absolute else tolerance
        for _ in range(_IRLS_ITERATIONS):
            r = np.asarray(residuals(model), dtype=float)
            if absolute:
                update = floor / np.maximum(r, floor)
            else:
                width = max(2 * float(np.median(r)), floor)
                update = (1 + (r / width) ** 2) ** -2.0
            change = float(np.abs(update - robust).max())
            robust = update
            model = fit(prior * robust)
            if change < max_change:
                break
    return model, robust


def mean_direction(directions: ArrayLike, weights: ArrayLike | None = None) -> Array:
    """The unit vector (3,) along the weighted sum of unit vectors (N, 3).

    The maximum-likelihood mean of the von Mises-Fisher distribution (Mardia and Jupp, "Directional Statistics",
    2000, section 10.3.1). Raises GeometryError for no vectors or vectors that cancel.
    """
    v = np.asarray(directions, dtype=float)
    if v.ndim != 2 or not len(v):
        raise GeometryError(f"a mean direction needs vectors (N, 3), N > 0; got shape {v.shape}")
    mean = np.average(v, axis=0, weights=None if weights is None else np.asarray(weights, dtype=float))
    length = float(np.linalg.norm(mean))
    if not length > 1e-9:
        raise GeometryError(f"{len(v)} directions cancel: their mean has length {length:.3g}")
    return np.asarray(mean / length)


def direction_angles(directions: ArrayLike, reference: ArrayLike) -> Array:
    """Angles in radians (N,) between unit vectors (N, 3) and one unit vector; exact for small and large ones."""
    v, u = np.asarray(directions, dtype=float), np.asarray(reference, dtype=float)
    return np.arctan2(np.linalg.norm(np.cross(v, u), axis=-1), v @ u)


def rotation_to_up(up: ArrayLike) -> Array:
    """The smallest rotation (3, 3) that takes a vector (3,) to +y; for -y, half a turn about x.

    Rodrigues' formula about the axis up x (+y). Raises GeometryError for a vector without length.
    """
    u = np.asarray(up, dtype=float)
    length = float(np.linalg.norm(u))
    if not length > 0:
        raise GeometryError(f"a vector of length {length} has no direction to turn up")
    x, y, z = u / length
    if y < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    # R = [[.., x, ..]] by hand: axis = u x (0, 1, 0) = (-z, 0, x), cos = y, sin^2 = x^2 + z^2.
    k = 1 / (1 + y)
    return np.array([[1 - k * x * x, -x, -k * x * z], [x, y, z], [-k * x * z, -z, 1 - k * z * z]])


def _checked(xyz_a: ArrayLike, xyz_b: ArrayLike, weights: ArrayLike | None, least: int) -> tuple[Array, Array, Array]:
    """Both point sets and weights of sum 1; GeometryError for too few, different, unfinite or weightless ones."""
    a, b = np.asarray(xyz_a, dtype=float), np.asarray(xyz_b, dtype=float)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 3:
        raise GeometryError(f"a fit needs two equal sets of points (N, 3); got {a.shape} and {b.shape}")
    w = np.ones(len(a)) if weights is None else np.asarray(weights, dtype=float)
    if w.shape != (len(a),) or not np.all(w >= 0):
        raise GeometryError(f"weights must be {len(a)} numbers of 0 or more; got shape {w.shape}")
    if np.count_nonzero(w) < least:
        raise GeometryError(f"this fit needs {least} or more points of weight; got {np.count_nonzero(w)}")
    if not (np.isfinite(a).all() and np.isfinite(b).all() and np.isfinite(w).all()):
        raise GeometryError("a fit needs finite points and weights")
    return a, b, w / w.sum()


def _procrustes(a: Array, b: Array, w: Array) -> tuple[Array, Array, Array, Array, float]:
    """Rotation, signed singular values of the cross-covariance, both means, and b's variance; w sums to 1."""
    mean_a, mean_b = w @ a, w @ b
    cross = (w[:, None] * (b - mean_b)).T @ (a - mean_a)
    rotation, singular = _best_rotation(cross)
    return rotation, singular, mean_a, mean_b, float(w @ np.sum((b - mean_b) ** 2, axis=1))


def _best_rotation(cross: Array) -> tuple[Array, Array]:
    """The rotation R that maximises trace(R @ cross), and the singular values with the sign that it needs."""
    u, singular, vt = np.linalg.svd(cross)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    return vt.T @ (sign[:, None] * u.T), singular * sign


def _best_yaw(cross: Array) -> tuple[Array, float]:
    """The rotation about +y that maximises trace(R @ cross), and how much it gains over none at all."""
    sine, cosine = cross[2, 0] - cross[0, 2], cross[0, 0] + cross[2, 2]
    return yaw_rotation(np.arctan2(sine, cosine)), float(np.hypot(sine, cosine))


def _require_rotation(singular: Array) -> None:
    if not (singular[0] > 0 and singular[1] > _RANK_TOLERANCE * singular[0]):
        values = ", ".join(f"{s:.3g}" for s in singular)
        raise GeometryError(f"points on a line or in one place determine no rotation (singular values {values})")


def _rounding(a: Array, b: Array) -> float:
    """The cross-covariance that rounding alone leaves in points without extent: copies of a far point differ."""
    return 1e-24 * float(np.abs(a).max() * np.abs(b).max())
