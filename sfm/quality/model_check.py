"""Is the motion of a built model's frames consistent with VIO? A low reprojection error doesn't say so.

The same comparison as the checks of align: windows of VIO path, VIO fitted to the model in each, within its drift
there. Each recording has a scale for itself in each model here: a phone whose scale is off against the others' is no
fault of the model. Nor is an input in which images and VIO don't belong together; where pairs show that, the stage ends
before anything is mapped.
"""

import numpy as np
from numpy.typing import NDArray

from groundwalk.consistency.decisions import Status, decide
from groundwalk.consistency.diagnosis import MAX_ALIASED_FRACTION, MAX_TURN_GAIN_ERROR, diagnose
from groundwalk.consistency.scale import recording_scale
from groundwalk.consistency.trajectories import TrajectoryPair
from groundwalk.consistency.windows import compare_windows
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array
from groundwalk.sfm.pairs.odometry import Odometry

# The limits are a decimetre and more: a few rounds of each fit are enough.
_TOLERANCE = 0.05
# With a wrong focal length at least this fraction of the steps agrees; in a model that is wrong in other ways turns say
# nothing about it.
_MIN_EXPLAINED_FRACTION = 0.8


def check_models(sfm_T_cam: Array, model_N: NDArray[np.int64], vio: Odometry) -> tuple[NDArray[np.bool_], str]:
    """Which frames (N,) are in a model whose motion is consistent with VIO there; and, where that explains all others,
    which sessions' models turn by another angle than VIO, as a wrong focal length makes them, in words.

    Poses (N, 4, 4) are each in the gauge of the frame's model, and `model_N` is that one's number, -1 for none. A frame
    is inconsistent where it is beyond VIO's drift in any window, and all frames of a model are where it merges distinct
    places. A frame that VIO says nothing about is consistent.
    """
    consistent = model_N >= 0
    turn_gains: dict[str, float] = {}
    for number in range(int(model_N.max(initial=-1)) + 1):
        members = model_N == number
        for recording in np.unique(vio.recording[members]):
            consistent &= ~_inconsistent(members & (vio.recording == recording), sfm_T_cam, vio)
        for session in np.unique(vio.session[members]):
            _, segments = _segments(members & (vio.session == session), sfm_T_cam, vio)
            if not segments:
                continue
            diagnosis = diagnose(segments)
            if diagnosis.aliased_fraction > MAX_ALIASED_FRACTION:
                consistent[members] = False
            motions = diagnosis.motions
            status = decide(abs(motions.turn_gain - 1), motions.turn_gain_sd, MAX_TURN_GAIN_ERROR)
            if status is Status.FAILED and motions.explained >= _MIN_EXPLAINED_FRACTION:
                turn_gains[str(session)] = motions.turn_gain
    inconsistent = set(vio.session[(model_N >= 0) & ~consistent].tolist())
    faults = [
        f"the images of session {session} turn {gain:.2f} times as far as its VIO, so its focal length is wrong"
        for session, gain in turn_gains.items()
    ]
    return consistent, ", ".join(faults) if inconsistent <= turn_gains.keys() else ""


def _segments(
    is_member: NDArray[np.bool_], sfm_T_cam: Array, vio: Odometry
) -> tuple[list[NDArray[np.intp]], list[TrajectoryPair]]:
    """The rows of member frames with VIO, cut at its jumps, session by session, in order of time; and their poses."""
    rows_of_segments = []
    for session in np.unique(vio.session[is_member]):
        rows = np.flatnonzero(is_member & (vio.session == session) & vio.posed)
        rows = rows[np.argsort(vio.t_ns[rows], kind="stable")]
        jumps = (np.diff(vio.jumped_m[rows]) > 0) | (np.diff(vio.jumped_rad[rows]) > 0)
        rows_of_segments += [segment for segment in np.split(rows, np.flatnonzero(jumps) + 1) if len(segment)]
    pairs = [TrajectoryPair(sfm_T_cam[rows], vio.vio_T_cam[rows], vio.travelled_m[rows]) for rows in rows_of_segments]
    return rows_of_segments, pairs


def _inconsistent(is_member: NDArray[np.bool_], sfm_T_cam: Array, vio: Odometry) -> NDArray[np.bool_]:
    """(N,) which of a recording's frames in one model are beyond a limit in some window."""
    beyond = np.zeros(len(is_member), bool)
    rows_of_segments, segments = _segments(is_member, sfm_T_cam, vio)
    try:
        scale = recording_scale(segments, _TOLERANCE)
    except GeometryError:
        # The model merges frames that are apart in VIO.
        for rows in rows_of_segments:
            beyond[rows] = True
        return beyond
    if scale is None:
        return beyond
    metric_S_sfm = Sim3(float(np.exp(scale.log)), np.eye(3), np.zeros(3))
    for rows, segment in zip(rows_of_segments, segments, strict=True):
        metric = segment._replace(sfm_T_cam=metric_S_sfm.poses(segment.sfm_T_cam))
        for window in compare_windows(metric, _TOLERANCE):
            beyond[rows[window.inside[window.wrong]]] = True
    return beyond
