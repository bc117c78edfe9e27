"""Why SfM's poses and a reference's don't agree: a usual mistake in reading the reference, another world, or a bend."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from groundwalk.alignment.reference.poses import extent_of
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.pose_conventions import POSE_CONVENTIONS
from groundwalk.geometry.pose_similarity import PoseSimilarity, fit_similar_poses
from groundwalk.geometry.poses import Array, nearest_rotation, rotation_angle
from groundwalk.store.hints import setting_of

# Parts of a walk that are fitted on their own have at least so many frames, and are at most so many.
_MIN_PART, _MAX_PARTS = 6, 8
_REFITS = 5
# No lens turns cameras further: a fifth of the focal length, as the principal point's place.
_MAX_LENS_DEG = 10.0


@dataclass(frozen=True)
class Limits:
    """How far a pose may be from its reference: a fraction of the extent of the reference's positions and a constant in
    its unit, and an angle in radians; and which fraction of frames within them agrees."""

    fraction: float
    constant: float
    rotation: float
    min_consistent: float

    def position(self, extent: float) -> float:
        """In the reference's unit."""
        return self.fraction * extent + self.constant

    def agrees(self, fit: PoseSimilarity, extent: float) -> bool:
        """Whether enough poses of a fit are within the limits."""
        within = (fit.position <= self.position(extent)) & (fit.rotation <= self.rotation)
        return bool(within.mean() >= self.min_consistent)


def explain(reference_T_cam: Array, sfm_T_cam: Array, frame_ids: np.ndarray, limits: Limits) -> str:
    """What it looks like that poses (N, 4, 4) of the same frames, in the order of their walk, don't agree."""
    return (
        _convention(reference_T_cam, sfm_T_cam, limits)
        or _turned_cameras(reference_T_cam, sfm_T_cam, limits)
        or _bend(reference_T_cam, sfm_T_cam, frame_ids, limits)
    )


def fit_if_any(reference_T_cam: Array, sfm_T_cam: Array) -> PoseSimilarity | None:
    """The similarity of poses (N, 4, 4); None where they don't determine one."""
    try:
        return fit_similar_poses(reference_T_cam, sfm_T_cam)
    except GeometryError:
        return None


def _convention(reference_T_cam: Array, sfm_T_cam: Array, limits: Limits) -> str:
    """The mistake in reading the reference without which it would agree, the poses alone as they are included."""
    as_is = "its world is another one than that of the model's other frames: fitted without them, it agrees"
    candidates: list[tuple[float, str]] = []
    for name, poses in (
        (as_is, reference_T_cam),
        *((f"it agrees where {name}", change(reference_T_cam)) for name, change in POSE_CONVENTIONS),
    ):
        fit = fit_if_any(poses, sfm_T_cam)
        if fit is not None and limits.agrees(fit, extent_of(poses)):
            candidates.append((float(np.median(fit.rotation)), name))
    return min(candidates)[1] if candidates else ""


def _turned_cameras(reference_T_cam: Array, sfm_T_cam: Array, limits: Limits) -> str:
    """That all cameras are turned alike about their own axes, as where poses are those of another body."""
    try:
        turn = fit_sim3(reference_T_cam[:, :3, 3], sfm_T_cam[:, :3, 3]).rotation
    except GeometryError:
        return ""
    corrected = reference_T_cam
    for _ in range(_REFITS):
        turns = np.swapaxes(turn @ sfm_T_cam[:, :3, :3], 1, 2) @ reference_T_cam[:, :3, :3]
        cam_R_stated = nearest_rotation(np.median(turns, axis=0))
        corrected = reference_T_cam.copy()
        corrected[:, :3, :3] = reference_T_cam[:, :3, :3] @ cam_R_stated.T
        fit = fit_if_any(corrected, sfm_T_cam)
        if fit is None:
            return ""
        turn = fit.a_S_b.rotation
    if fit is None or not limits.agrees(fit, extent_of(corrected)):
        return ""
    degrees = np.degrees(rotation_angle(cam_R_stated))
    alike = f"it agrees where all cameras are turned alike, by {degrees:.1f} degrees"
    if degrees < _MAX_LENS_DEG:
        return f"{alike}: as by a principal point, or a lens, that isn't the stated one"
    axes = ", ".join("(" + ", ".join(f"{v + 0.0:.2f}" for v in np.round(axis, 2)) + ")" for axis in cam_R_stated.T)
    return (
        f"{alike}; the stated x, y and z axes are then {axes} in the camera's (x right, y down, z forward): poses of a "
        "robot, an IMU or another body than the camera"
    )


def _bend(reference_T_cam: Array, sfm_T_cam: Array, frame_ids: np.ndarray, limits: Limits) -> str:
    """Where along the walk the two turn against each other most, by fits of parts of it."""
    extent = extent_of(reference_T_cam)
    parts = np.array_split(np.arange(len(frame_ids)), int(np.clip(len(frame_ids) // _MIN_PART, 1, _MAX_PARTS)))
    fits = [(part, fit_if_any(reference_T_cam[part], sfm_T_cam[part])) for part in parts]
    good = [(part, fit) for part, fit in fits if fit is not None and limits.agrees(fit, extent)]
    other_run = setting_of("sfm", 'lens = "stated"')
    undecided = (
        "Which of the two is wrong can't be told from them alone: SfM is, where another run of it agrees with the "
        f"reference ({other_run}, other features or mapper); the reference is, where such runs, a ruler or VIO agree "
        "with SfM"
    )
    if len(good) < max(2, len(parts) / 2):
        return f"they differ all along, in parts of {len(parts[0])} frames fitted on their own, too. {undecided}"
    turns = [np.degrees(rotation_angle(a.a_S_b.rotation.T @ b.a_S_b.rotation)) for (_, a), (_, b) in pairwise(good)]
    most = int(np.argmax(turns))
    return (
        f"one is bent against the other: of {len(parts)} parts, each fitted on its own, {len(good)} agree, but from "
        f"one to the next they turn against each other by up to {turns[most]:.1f} degrees, most between "
        f"{frame_ids[good[most][0][0]]} and {frame_ids[good[most + 1][0][-1]]}. {undecided}"
    )
