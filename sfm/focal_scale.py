"""How far a session's focal lengths are off: one factor for all of its cameras, and how well the images tell it.

A phone reports the focal length of every moment; a wrong calibration is wrong in all of them alike. So each session has
one unknown, the logarithm of what its focal lengths must be multiplied by.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_solve

from geometry.poses import Array
from sfm.model import Model
from sfm.normal_equations import factor_of, jacobians, reduced_camera_system, similarities

Ints = NDArray[np.int64]

# So few points a frame tell a factor to some hundredths of a per cent (docs/sfm.md); small models have more of them.
_POINTS_PER_FRAME, _POINTS = 30, 15_000
_MOST_FRAMES = 600


# A factor counts beyond so many of its sigmas, where it's a matter of pixels at all, and where it's known well enough:
# a walk straight on hardly tells focal length from depth, and then what isn't modelled decides.
_SIGMAS = 4.0
_LEAST = 0.002
_MOST_SD = 0.005


@dataclass(frozen=True)
class FocalScales:
    """For S sessions, in the order of their names: the factor of their focal lengths, and its sigma; both (S,)."""

    sessions: NDArray[np.str_]
    factor: Array
    sd: Array

    @property
    def differs(self) -> NDArray[np.bool_]:
        """(S,) the images say that the focal lengths aren't those that were captured."""
        return self.known & (np.abs(self.factor - 1) > np.maximum(_SIGMAS * self.sd, _LEAST))

    @property
    def known(self) -> NDArray[np.bool_]:
        """(S,) the images tell the factor well enough to act on it, or to a tenth of what it's off by."""
        return self.sd <= np.maximum(_MOST_SD, np.abs(self.factor - 1) / 10)


def estimate_focal_scales(
    model: Model, session_N: NDArray[np.str_], intrinsics_N4: Array, loss_px: float
) -> FocalScales | None:
    """The factors of a model's focal lengths by one Gauss-Newton step from where it was adjusted, all else free.

    `model` is one COLMAP model over N frames, `session_N` names their sessions, `intrinsics_N4` is fx, fy, cx, cy, and
    `loss_px` the width of the Cauchy loss that the model was adjusted with. The sigmas are of a sandwich clustered by
    point, as in `pose_covariance`. Large models tell it by some of their frames and points. None where there are too
    few of them to tell.
    """
    rows = _chosen_frames(model.registered, session_N)
    m, p = _chosen_observations(model, rows)
    used, frame = np.unique(model.frame[m], return_inverse=True)
    points, point = np.unique(p, return_inverse=True)
    sessions, session = np.unique(session_N[used], return_inverse=True)
    if len(used) < 3 or 2 * len(m) <= 6 * len(used) + 3 * len(points) + len(sessions):
        return None
    residual = model.residual_px[m]
    weight = 1 / (1 + np.sum(residual**2, axis=1) / loss_px**2)
    by_pose, by_point = jacobians(model.sfm_T_cam[used], intrinsics_N4[used, :2], model.xyz[points], frame, point)
    by_pose, by_point = weight[:, None, None] * by_pose, weight[:, None, None] * by_point
    # A pixel moves from the principal point by as much as it is away from it.
    from_centre = weight[:, None] * (model.seen_px[m] + residual - intrinsics_N4[used[frame], 2:])
    by_scale = np.where(session[frame][:, None] == np.arange(len(sessions)), 1.0, 0.0)[:, None] * from_centre[..., None]
    try:
        without_points = _Elimination(by_point, point, len(points))
        factor = factor_of(
            reduced_camera_system(by_pose, by_point, frame, point, len(used), len(points)),
            similarities(model.sfm_T_cam[used, :3, 3]),
        )
        cross = np.zeros((len(used), 6, len(sessions)))
        np.add.at(cross, frame, np.swapaxes(by_pose, 1, 2) @ without_points(by_scale))
        of_poses = cho_solve((factor, True), cross.reshape(-1, len(sessions))).reshape(cross.shape)
        # What of each column neither poses nor points can explain.
        own = without_points(by_scale - by_pose @ of_poses[frame])
        covariance = np.linalg.inv(np.einsum("mis,mit->st", own, by_scale))
    except LinAlgError:
        return None
    force = np.einsum("mis,mi->ms", own, residual)
    seen_by = np.bincount(point)
    by_track = np.zeros((len(points), len(sessions)))
    np.add.at(by_track, point, np.sqrt(2 * seen_by / (2 * seen_by - 3))[point, None] * force)
    spread = covariance @ (by_track.T @ by_track) @ covariance
    step = -covariance @ force.sum(axis=0)
    return FocalScales(sessions, np.exp(step), np.sqrt(np.diag(spread)))


class _Elimination:
    """Takes out of columns over the observations (M, 2, k) what moving the points explains of them."""

    def __init__(self, by_point: Array, point_M: Ints, points: int) -> None:
        self._by_point, self._point, self._points = by_point, point_M, points
        blocks = np.zeros((points, 3, 3))
        np.add.at(blocks, point_M, np.swapaxes(by_point, 1, 2) @ by_point)
        self._inverse = np.linalg.inv(blocks)

    def __call__(self, columns: Array) -> Array:
        sums = np.zeros((self._points, 3, columns.shape[2]))
        np.add.at(sums, self._point, np.swapaxes(self._by_point, 1, 2) @ columns)
        return columns - self._by_point @ (self._inverse @ sums)[self._point]


def _chosen_frames(registered_N: NDArray[np.bool_], session_N: NDArray[np.str_]) -> NDArray[np.bool_]:
    """(N,) all registered frames, or of more than `_MOST_FRAMES` each session's first ones, as many of each."""
    if np.count_nonzero(registered_N) <= _MOST_FRAMES:
        return registered_N
    chosen = np.zeros_like(registered_N)
    names = np.unique(session_N[registered_N])
    for name in names:
        chosen[np.flatnonzero(registered_N & (session_N == name))[: _MOST_FRAMES // len(names)]] = True
    return chosen


def _chosen_observations(model: Model, frames_N: NDArray[np.bool_]) -> tuple[Ints, Ints]:
    """Observations in the frames of the points with the longest tracks there, some for each frame; and their points."""
    inside = np.flatnonzero(frames_N[model.frame])
    length = np.bincount(model.point[inside], minlength=len(model.xyz))
    inside = inside[length[model.point[inside]] >= 3]
    order = inside[np.lexsort((model.point[inside], -length[model.point[inside]], model.frame[inside]))]
    count = np.bincount(model.frame[order], minlength=len(frames_N))
    rank = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    wanted = np.zeros(len(model.xyz), bool)
    per_frame = max(_POINTS_PER_FRAME, _POINTS // max(int(np.count_nonzero(count)), 1))
    wanted[model.point[order[rank < per_frame]]] = True
    kept = inside[wanted[model.point[inside]]]
    return kept, model.point[kept]
