"""Averages of positions and rotations that resist outliers or respect the sphere."""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array, canonical_quaternion

_MAX_ITERATIONS = 10_000
_TOLERANCE = 1e-12  # of positions relative to their spread, of rotations in radians


def geometric_median(points: ArrayLike) -> Array:
    """The point (D,) with the least sum of distances to points (N, D).

    Weiszfeld's iteration in the form of Vardi and Zhang (PNAS 97, 2000), which stays defined on a data point, with
    Newton's step taken instead wherever it lowers the cost further: near a data point, or for points close to a line,
    Weiszfeld's alone all but stands still. Three points have a closed form. For an even number of points on a line,
    where a whole segment is optimal, the result is one of its points. Raises GeometryError for no points or a value
    that isn't finite.
    """
    x = np.asarray(points, dtype=float)
    if x.ndim != 2 or not len(x) or not np.isfinite(x).all():
        raise GeometryError(f"the geometric median needs finite points (N, D), N > 0; got shape {x.shape}")
    spread = float(np.abs(x - x.mean(axis=0)).max())
    if spread == 0:
        return x[0].copy()
    if len(x) == 3:
        return fermat_points(x[None])[0]
    # A data point is the median exactly when the pull of the others doesn't exceed its own; testing them
    # first spares the slow convergence towards such a point.
    difference = x[None, :, :] - x[:, None, :]
    distance = np.linalg.norm(difference, axis=2)
    same = distance <= 1e-15 * spread
    unit = difference / np.where(same, 1.0, distance)[..., None]
    pull = np.linalg.norm(np.where(same[..., None], 0.0, unit).sum(axis=1), axis=1)
    slack = same.sum(axis=1) - pull
    if slack.max() >= 0:
        return x[int(np.argmax(slack))].copy()
    y = x.mean(axis=0)
    for _ in range(_MAX_ITERATIONS):
        d = np.linalg.norm(x - y, axis=1)
        on = d <= 1e-15 * spread
        inverse = np.where(on, 0.0, 1 / np.where(on, 1.0, d))
        target = inverse @ x / inverse.sum()
        if on.any():
            # Vardi-Zhang: a data point holds the iterate back by its own weight against the others' pull.
            residual = np.linalg.norm(inverse @ (x - y))
            hold = min(1.0, float(on.sum() / residual))
            target = (1 - hold) * target + hold * y
        else:
            target = _newton(x, y, inverse, target)
        if np.abs(target - y).max() <= _TOLERANCE * spread:
            return np.asarray(target)
        y = target
    return np.asarray(y)


def _newton(x: Array, y: Array, inverse: Array, fallback: Array) -> Array:
    """The cheapest of Newton's step from y (D,), its halvings, and fallback (D,).

    y lies on no point; inverse (N,) is one over distance.
    """
    difference = x - y
    unit = difference / np.linalg.norm(difference, axis=1)[:, None]
    hessian = inverse.sum() * np.eye(x.shape[1]) - np.einsum("n,ni,nj->ij", inverse, unit, unit)
    step = np.linalg.lstsq(hessian, inverse @ difference, rcond=None)[0]
    candidates = np.concatenate([y + step * 0.5 ** np.arange(24)[:, None], fallback[None]])
    cost = np.linalg.norm(x[None] - candidates[:, None], axis=2).sum(axis=1)
    return np.asarray(candidates[int(np.argmin(cost))])


def fermat_points(triangles: ArrayLike) -> Array:
    """The points (N, D) of least summed distance to the corners of triangles (N, 3, D): `geometric_median` of each.

    A corner of 120 degrees or more, or one that is there twice, else by trilinear coordinates csc(A + 60 deg)
    (Kimberling, "Encyclopedia of Triangle Centers", X(13)).
    """
    x = np.asarray(triangles, dtype=float)
    to_next, to_last = np.roll(x, -1, axis=1) - x, np.roll(x, 1, axis=1) - x
    opposite = np.linalg.norm(to_next - to_last, axis=2)
    near = np.linalg.norm(to_next, axis=2) * np.linalg.norm(to_last, axis=2)
    # A corner that coincides with another has no angle, and is the median.
    cosine = np.where(near > 0, np.sum(to_next * to_last, axis=2) / np.where(near > 0, near, 1.0), -1.0)
    wide = cosine <= -0.5
    angle = np.arccos(np.clip(cosine, -0.5, 1.0))
    weight = opposite / np.maximum(np.sin(angle + np.pi / 3), 1e-300)
    weight = np.where(wide.any(axis=1, keepdims=True), np.arange(3) == np.argmax(wide, axis=1)[:, None], weight)
    return np.einsum("nc,ncd->nd", weight / weight.sum(axis=1, keepdims=True), x)


def quaternion_mean(quaternions: ArrayLike) -> Array:
    """The sign-aligned, normalised mean (..., 4) of xyzw quaternions (..., N, 4): Gramkow's average (JMIV 15, 2001).

    Signs are aligned to the first quaternion. Raises GeometryError for no quaternions or when they cancel.
    """
    q = np.asarray(quaternions, dtype=float)
    if q.ndim < 2 or not q.shape[-2]:
        raise GeometryError(f"a rotation average needs quaternions (..., N, 4), N > 0; got shape {q.shape}")
    q = canonical_quaternion(q)
    aligned = np.where((q @ q[..., 0, :, None] < 0), -q, q)
    return canonical_quaternion(aligned.mean(axis=-2))


def karcher_mean(quaternions: ArrayLike) -> Array:
    """The rotation (4,), xyzw, with the least sum of squared angles to quaternions (N, 4).

    Riemannian gradient descent from Gramkow's average; unique while all rotations lie within 90 degrees of it.
    """
    q = canonical_quaternion(quaternions)
    mean = Rotation.from_quat(quaternion_mean(q))
    rotations = Rotation.from_quat(q)
    for _ in range(_MAX_ITERATIONS):
        step = (mean.inv() * rotations).as_rotvec().mean(axis=0)
        mean = mean * Rotation.from_rotvec(step)
        if np.linalg.norm(step) <= _TOLERANCE:
            break
    return canonical_quaternion(mean.as_quat())
