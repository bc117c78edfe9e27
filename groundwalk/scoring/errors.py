"""The paper's errors: relative (eq. 4 to 7), absolute (APE, AOE), and the shares within its accuracy levels.

"RPE" and "ROE" here are the paper's: differences of the *lengths* of two steps, blind to their direction.
`relative_error` is the usual one, the motion left between two relative poses.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation
from scipy.special import chdtri

from groundwalk.geometry.poses import Array, inverse, quaternion_angle, relative, rotation_angle, tq_from_pose

# (metres, degrees): high, medium and low accuracy.
ACCURACY_LEVELS = {"high": (0.25, 2.0), "medium": (0.5, 5.0), "low": (5.0, 10.0)}
# 95 % of a chi square with 3 degrees of freedom, a position's or a rotation's.
BOUND_95 = float(chdtri(3, 0.05))
# Quality classes of ground truth that lies within every accuracy level's bounds with 95 % (2.8 sigma, three axes):
# A within 0.06 m and 0.3 degrees, B within 0.14 m and 0.9 degrees. C has no limits, so it promises nothing.
SURE_CLASSES = ("A", "B")


def step_lengths(poses: ArrayLike) -> tuple[Array, Array]:
    """Lengths of the steps between consecutive poses (N, 4, 4): metres (N-1,) and degrees (N-1,), eq. 1 to 3."""
    t, q = tq_from_pose(poses)
    return np.linalg.norm(np.diff(t, axis=0), axis=1), np.degrees(quaternion_angle(q[1:], q[:-1]))


def rpe_roe(poses_a: ArrayLike, poses_b: ArrayLike) -> tuple[Array, Array]:
    """The paper's RPE (metres) and ROE (degrees), both (N-1,), between consecutive poses of two paths (N, 4, 4).

    Eq. 4 to 7: the absolute difference of step lengths. The paths may be given in different frames.
    """
    trans_a, rot_a = step_lengths(poses_a)
    trans_b, rot_b = step_lengths(poses_b)
    return np.abs(trans_a - trans_b), np.abs(rot_a - rot_b)


def relative_error(poses_a: ArrayLike, poses_b: ArrayLike) -> tuple[Array, Array]:
    """The motion left between consecutive relative poses of two paths (N, 4, 4): metres and degrees, both (N-1,)."""
    poses_a, poses_b = np.asarray(poses_a, dtype=float), np.asarray(poses_b, dtype=float)
    left = inverse(relative(poses_a[:-1], poses_a[1:])) @ relative(poses_b[:-1], poses_b[1:])
    return np.linalg.norm(left[:, :3, 3], axis=1), np.degrees(rotation_angle(left[:, :3, :3]))


def position_error(estimated: ArrayLike, true: ArrayLike) -> Array:
    """APE in metres (...,): distance of the positions of poses (..., 4, 4)."""
    difference = np.asarray(estimated, dtype=float)[..., :3, 3] - np.asarray(true, dtype=float)[..., :3, 3]
    return np.linalg.norm(difference, axis=-1)


def rotation_error_deg(estimated: ArrayLike, true: ArrayLike) -> Array:
    """AOE in degrees (...,): angle between the rotations of poses (..., 4, 4).

    The paper's 2 acos|<q, q'>|, computed so that small angles keep their digits.
    """
    return np.degrees(rotation_angle(relative(estimated, true)[..., :3, :3]))


def pose_error(estimated: ArrayLike, true: ArrayLike) -> Array:
    """Errors (..., 6) of (rotation, position) of poses (..., 4, 4) in the map's axes: rad, m.

    The true rotation is exp(rotation error) after the estimated one, as in the covariances (6, 6) of poses.
    """
    estimated, true = np.asarray(estimated, dtype=float), np.asarray(true, dtype=float)
    turn = true[..., :3, :3] @ np.swapaxes(estimated[..., :3, :3], -1, -2)
    rotation = Rotation.from_matrix(turn.reshape(-1, 3, 3)).as_rotvec().reshape(*turn.shape[:-2], 3)
    return np.concatenate([rotation, true[..., :3, 3] - estimated[..., :3, 3]], axis=-1)


def normalised_squares(errors: Array, covariances: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis lengths of the rotation (N,) and the position (N,) of errors (N, 6), covariances
    (N, 6, 6)."""
    parts = []
    for part in (slice(0, 3), slice(3, 6)):
        e, c = errors[:, part], covariances[:, part, part]
        parts.append(np.einsum("ni,ni->n", e, np.linalg.solve(c, e[:, :, None])[:, :, 0]))
    return parts[0], parts[1]


def within_bounds(estimated: ArrayLike, true: ArrayLike, covariances: ArrayLike) -> NDArray[np.bool_]:
    """Whether position and rotation errors of poses (N, 4, 4) lie within the 95 % bounds of covariances (N, 6, 6) of
    (rotation, position) in the map's axes, (N, 2)."""
    rotation, position = normalised_squares(pose_error(estimated, true), np.asarray(covariances, dtype=float))
    return np.asarray(np.column_stack([position, rotation]) <= BOUND_95)


def sure_enough(quality: ArrayLike) -> NDArray[np.bool_]:
    """Whether ground truth of quality classes (N,) can tell if a pose is within the accuracy levels, (N,).

    A class that isn't stated (None or NaN) is taken as sure: nobody said otherwise.
    """
    stated = np.asarray(quality, dtype=object)
    return np.array([c is None or c != c or c in SURE_CLASSES for c in stated], dtype=bool)


def accuracy_shares(position_m: ArrayLike, rotation_deg: ArrayLike) -> dict[str, float]:
    """The share (0..1) of frames within each accuracy level. NaN errors reach no level. NaN for no frames."""
    position_m, rotation_deg = np.asarray(position_m, dtype=float), np.asarray(rotation_deg, dtype=float)
    total = len(position_m)
    return {
        name: float(np.sum((position_m <= metres) & (rotation_deg <= degrees)) / total) if total else float("nan")
        for name, (metres, degrees) in ACCURACY_LEVELS.items()
    }
