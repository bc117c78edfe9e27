"""Rigid transforms as 4x4 matrices: building, taking apart, measuring and interpolating them."""

import numpy as np
import scipy  # which loads its subpackages as they are used: spatial takes half a second
from numpy.typing import ArrayLike

from groundwalk.geometry import Array, GeometryError

# ARKit's camera looks along -z with y up; ours (OpenCV's) along +z with y down.
ARKIT_CAM_T_CAM: Array = np.diag([1.0, -1.0, -1.0, 1.0])


def make_pose(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Poses (..., 4, 4) from rotations (..., 3, 3) and translations (..., 3)."""
    rotation = np.asarray(rotation, dtype=float)
    translation = np.asarray(translation, dtype=float)
    shape = np.broadcast_shapes(rotation.shape[:-2], translation.shape[:-1])
    pose = np.zeros((*shape, 4, 4))
    pose[..., :3, :3] = rotation
    pose[..., :3, 3] = translation
    pose[..., 3, 3] = 1.0
    return pose


def pose_from_tq(translation: ArrayLike, quaternion: ArrayLike) -> Array:
    """Poses (..., 4, 4) from translations (..., 3) and xyzw quaternions (..., 4), normalised here."""
    return make_pose(matrix_from_quaternion(quaternion), translation)


def tq_from_pose(pose: ArrayLike) -> tuple[Array, Array]:
    """Translations (..., 3) and canonical xyzw quaternions (..., 4) of poses (..., 4, 4)."""
    pose = np.asarray(pose, dtype=float)
    return pose[..., :3, 3].copy(), quaternion_from_matrix(pose[..., :3, :3])


def canonical_quaternion(quaternion: ArrayLike) -> Array:
    """The same rotations as unit xyzw quaternions with w >= 0 (for w = 0 the first non-zero entry is positive).

    Raises GeometryError for a quaternion of length 0 or with a NaN.
    """
    q = np.asarray(quaternion, dtype=float)
    norm = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(norm > 1e-12):
        raise GeometryError(f"quaternion of length {float(np.min(norm)):.3g} is no rotation")
    q = q / norm
    # +0.0 turns -0.0 into 0.0, so that equal rotations are equal bytes.
    significant = q[..., 3:4]
    if not significant.all():
        first = np.argmax(q[..., :3] != 0, axis=-1)[..., None]
        significant = np.where(significant != 0, significant, np.take_along_axis(q[..., :3], first, axis=-1))
    return np.where(significant < 0, -q, q) + 0.0


def quaternion_from_matrix(rotation: ArrayLike) -> Array:
    """Canonical xyzw quaternions (..., 4) of rotation matrices (..., 3, 3)."""
    rotation = np.asarray(rotation, dtype=float)
    flat = scipy.spatial.transform.Rotation.from_matrix(rotation.reshape(-1, 3, 3)).as_quat()
    return canonical_quaternion(flat.reshape(*rotation.shape[:-2], 4))


def matrix_from_quaternion(quaternion: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of xyzw quaternions (..., 4)."""
    q = canonical_quaternion(quaternion)
    return scipy.spatial.transform.Rotation.from_quat(q.reshape(-1, 4)).as_matrix().reshape(*q.shape[:-1], 3, 3)


def inverse(a_T_b: ArrayLike) -> Array:
    """b_T_a of rigid a_T_b (..., 4, 4)."""
    a_T_b = np.asarray(a_T_b, dtype=float)
    b_R_a = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    return make_pose(b_R_a, -np.einsum("...ij,...j->...i", b_R_a, a_T_b[..., :3, 3]))


def relative(world_T_a: ArrayLike, world_T_b: ArrayLike) -> Array:
    """a_T_b (..., 4, 4): where b is, seen from a."""
    return inverse(world_T_a) @ np.asarray(world_T_b, dtype=float)


def transform(a_T_b: ArrayLike, points_b: ArrayLike) -> Array:
    """Points (..., 3) given in b, in a."""
    a_T_b = np.asarray(a_T_b, dtype=float)
    return np.einsum("...ij,...j->...i", a_T_b[..., :3, :3], np.asarray(points_b, dtype=float)) + a_T_b[..., :3, 3]


def path_length(xyz: ArrayLike) -> Array:
    """Length (N,) of the path through positions (N, 3) from the first one to each."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(np.asarray(xyz, dtype=float), axis=0), axis=1))])


def rotation_angle(rotation: ArrayLike) -> Array:
    """Angles in radians, 0..pi, of rotation matrices (..., 3, 3); exact for small and large angles alike."""
    rotation = np.asarray(rotation, dtype=float)
    flat = scipy.spatial.transform.Rotation.from_matrix(rotation.reshape(-1, 3, 3)).magnitude()
    return np.asarray(flat).reshape(rotation.shape[:-2])


def quaternion_angle(a: ArrayLike, b: ArrayLike) -> Array:
    """Angles in radians between unit quaternions (..., 4): 2 acos(min(1, |<a, b>|)), the paper's step_rot."""
    dot = np.abs(np.sum(np.asarray(a, dtype=float) * np.asarray(b, dtype=float), axis=-1))
    return 2.0 * np.arccos(np.minimum(1.0, dot))


def nearest_rotation(matrix: ArrayLike) -> Array:
    """The rotations (..., 3, 3) nearest to matrices in the Frobenius norm (Kabsch)."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=float))
    sign = np.sign(np.linalg.det(u @ vt))
    u[..., :, -1] *= sign[..., None]
    return u @ vt


def rigidity_error(pose: ArrayLike) -> Array:
    """How far poses (..., 4, 4) are from rigid: the largest entry of |R^T R - 1|, or of the last row's deviation,
    or infinity for a mirrored rotation or a value that isn't finite. A valid pose has about 1e-6 or less."""
    pose = np.asarray(pose, dtype=float)
    finite = np.isfinite(pose).all(axis=(-1, -2))
    safe = np.where(finite[..., None, None], pose, np.eye(4))
    rotation = safe[..., :3, :3]
    gram = np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)
    error = np.maximum(np.abs(gram).max(axis=(-1, -2)), np.abs(safe[..., 3, :] - [0, 0, 0, 1]).max(axis=-1))
    return np.where(finite & (np.linalg.det(rotation) > 0), error, np.inf)


def interpolate(t_ns: ArrayLike, poses: ArrayLike, query_ns: ArrayLike) -> Array:
    """Poses (M, 4, 4) at times query_ns (M,) from poses (N, 4, 4) at rising times t_ns (N,): linear position,
    slerped rotation.

    Raises GeometryError where times don't rise or a query lies outside them.
    """
    times = np.asarray(t_ns, dtype=np.int64)
    query = np.asarray(query_ns, dtype=np.int64)
    poses = np.asarray(poses, dtype=float)
    if len(times) < 2 or np.any(np.diff(times) <= 0):
        raise GeometryError("interpolation needs two or more poses at strictly rising times")
    if query.size and (query.min() < times[0] or query.max() > times[-1]):
        raise GeometryError(f"query times {query.min()}..{query.max()} ns lie outside {times[0]}..{times[-1]} ns")
    # Relative seconds keep nanoseconds exact enough in float64.
    seconds = (times - times[0]) * 1e-9
    query_s = (query - times[0]) * 1e-9
    rotations = scipy.spatial.transform.Rotation.from_matrix(poses[:, :3, :3])
    rotation = scipy.spatial.transform.Slerp(seconds, rotations)(query_s).as_matrix()
    translation = np.stack([np.interp(query_s, seconds, poses[:, i, 3]) for i in range(3)], axis=-1)
    return make_pose(rotation, translation)


def yaw_rotation(angle: ArrayLike) -> Array:
    """Rotations (..., 3, 3) by an angle in radians about +y, the up axis of the vio and map frames."""
    angle = np.asarray(angle, dtype=float)
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([np.stack([c, zero, s], -1), np.stack([zero, one, zero], -1), np.stack([-s, zero, c], -1)], -2)


def heading(rotation: ArrayLike) -> Array:
    """The yaw in radians, about +y, that is nearest to rotations (..., 3, 3)."""
    rotation = np.asarray(rotation, dtype=float)
    return np.arctan2(rotation[..., 0, 2] - rotation[..., 2, 0], rotation[..., 0, 0] + rotation[..., 2, 2])


def skew(v: ArrayLike) -> Array:
    """Matrices (..., 3, 3) of the cross product with vectors (..., 3)."""
    v = np.asarray(v, dtype=float)
    x, y, z, zero = v[..., 0], v[..., 1], v[..., 2], np.zeros(v.shape[:-1])
    rows = ((zero, -z, y), (z, zero, -x), (-y, x, zero))
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
