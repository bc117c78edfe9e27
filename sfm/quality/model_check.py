"""Is the motion of a built model's frames consistent with VIO? A low reprojection error doesn't say so.

The same comparison as the checks of align: windows of VIO path, VIO fitted to the model in each, within its drift
there. Each recording has a scale for itself in each model here: a phone whose scale is off against the others' is no
fault of the model. Nor is an input in which images and VIO don't belong together; where pairs show that, the stage ends
before anything is mapped.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundwalk.consistency.decisions import Status, decide
from groundwalk.consistency.diagnosis import MAX_ALIASED_FRACTION, MAX_TURN_GAIN_ERROR, diagnose
from groundwalk.consistency.scale import STEP_M, STEP_SCALE_SD, recording_scale
from groundwalk.consistency.trajectories import TrajectoryPair
from groundwalk.consistency.vio_drift import VioDrift
from groundwalk.consistency.windows import POSE_SD, WINDOW_M, compare_windows
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array
from groundwalk.sfm.pairs.odometry import Odometry

# The limits are a decimetre and more: a few rounds of each fit are enough.
_TOLERANCE = 0.05
# With a wrong focal length at least this fraction of the steps agrees; in a model that is wrong in other ways turns say
# nothing about it.
_MIN_EXPLAINED_FRACTION = 0.8


@dataclass(frozen=True)
class ModelCheck:
    """Which frames (N,) are in a model whose motion is consistent with VIO there; and, where that explains all others,
    the turn gains of sessions whose model turns by another angle than VIO, 1.1 for a tenth more, as a wrong focal
    length does."""

    consistent: NDArray[np.bool_]
    turn_gains: dict[str, float]


def check_models(
    sfm_T_cam: Array,
    model_N: NDArray[np.int64],
    vio: Odometry,
    recording_N: NDArray[np.object_],
    t_ns_N: NDArray[np.int64],
    drift: VioDrift,
) -> ModelCheck:
    """Compare models with VIO: poses (N, 4, 4), each in the gauge of its model, and its number, -1 for none.

    A frame is inconsistent where it is beyond VIO's drift in any window, and all frames of a model are where it merges
    distinct places. A frame that VIO says nothing about is consistent.
    """
    consistent = model_N >= 0
    turn_gains: dict[str, float] = {}
    for number in range(int(model_N.max(initial=-1)) + 1):
        members = model_N == number
        for recording in np.unique(recording_N[members]):
            parts = _parts_of(members & (recording_N == recording), vio, t_ns_N)
            consistent[members] &= ~_inconsistent(parts, sfm_T_cam, vio, drift, len(consistent))[members]
        for session in np.unique(vio.session[members]):
            parts = _parts_of(members & (vio.session == session), vio, t_ns_N)
            if not parts:
                continue
            diagnosis = diagnose(_pairs_of(parts, sfm_T_cam, vio), drift)
            if diagnosis.aliased_fraction > MAX_ALIASED_FRACTION:
                consistent[members] = False
            motions = diagnosis.motions
            status = decide(abs(motions.turn_gain - 1), motions.turn_gain_sd, MAX_TURN_GAIN_ERROR)
            if status is Status.FAILED and motions.explained >= _MIN_EXPLAINED_FRACTION:
                turn_gains[str(session)] = motions.turn_gain
    inconsistent = set(vio.session[(model_N >= 0) & ~consistent].tolist())
    return ModelCheck(consistent, turn_gains if inconsistent <= turn_gains.keys() else {})


def _pairs_of(parts: list[NDArray[np.intp]], sfm_T_cam: Array, vio: Odometry) -> list[TrajectoryPair]:
    return [TrajectoryPair(sfm_T_cam[rows], vio.vio_T_cam[rows], vio.travelled_m[rows]) for rows in parts]


def _parts_of(is_member: NDArray[np.bool_], vio: Odometry, t_ns_N: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """The rows of member frames with VIO, parted at its jumps, session by session, in order of time."""
    parts = []
    for session in np.unique(vio.session[is_member]):
        rows = np.flatnonzero(is_member & (vio.session == session) & vio.posed)
        rows = rows[np.argsort(t_ns_N[rows], kind="stable")]
        jumps = (np.diff(vio.jumped_m[rows]) > 0) | (np.diff(vio.jumped_rad[rows]) > 0)
        parts += [part for part in np.split(rows, np.flatnonzero(jumps) + 1) if len(part)]
    return parts


def _inconsistent(
    parts: list[NDArray[np.intp]], sfm_T_cam: Array, vio: Odometry, drift: VioDrift, frames: int
) -> NDArray[np.bool_]:
    """(N,) frames of a recording's parts in one model that are beyond a limit in some window."""
    beyond, pairs = np.zeros(frames, bool), _pairs_of(parts, sfm_T_cam, vio)
    try:
        scale = recording_scale(pairs, step_m=STEP_M, step_sd=STEP_SCALE_SD, tolerance=_TOLERANCE)
    except GeometryError:
        # The model merges frames that are apart in VIO.
        for rows in parts:
            beyond[rows] = True
        return beyond
    if scale is None:
        return beyond
    metric_S_sfm = Sim3(float(np.exp(scale.log)), np.eye(3), np.zeros(3))
    for rows, pair in zip(parts, pairs, strict=True):
        metric = pair._replace(sfm_T_cam=metric_S_sfm.poses(pair.sfm_T_cam))
        for window in compare_windows(metric, WINDOW_M, drift, POSE_SD, _TOLERANCE):
            beyond[rows[window.inside[window.wrong]]] = True
    return beyond
