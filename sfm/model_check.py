"""Do the frames of a built model move as the phones' VIO does? A low reprojection error doesn't say so.

The same comparison that align gives out ground truth by: windows of VIO path, VIO fitted to the model in each, within
what it may drift by there. Each recording has a scale of its own in each model here: a phone whose scale is off against
the others' is no fault of the model. Nor does anything that images and VIO have wrong together speak against it; what
pairs show of that ends the stage before anything is mapped.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from groundwalk.consistency.decisions import Status, decide
from groundwalk.consistency.diagnosis import FOLDED_LIMIT, TURN_GAIN_LIMIT, diagnose
from groundwalk.consistency.scale import STEP_M, STEP_SCALE_SD, recording_scale
from groundwalk.consistency.trajectories import TrajectoryPair
from groundwalk.consistency.vio_drift import VioDrift
from groundwalk.consistency.windows import POSE_SD, WINDOW_M, compare_windows
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array
from groundwalk.sfm.odometry import Odometry

# Millimetres are nothing against the limits, which are a decimetre and more: a few rounds of each fit will do.
_TOLERANCE = 0.05
# A wrong focal length leaves so large a share of the steps alike; in a model that is wrong in other ways turns say
# nothing of it.
_EXPLAINED = 0.8


@dataclass(frozen=True)
class ModelCheck:
    """Which frames (N,) are in a model that moves as VIO does there, and where nothing else explains those that aren't:
    the sessions in which a model moves as VIO does but turns by another angle, with the share, 1.1 for a tenth more."""

    agrees: NDArray[np.bool_]
    turned: dict[str, float]


def check_models(
    sfm_T_cam: Array,
    model_N: NDArray[np.int64],
    vio: Odometry,
    recording_N: NDArray[np.object_],
    t_ns_N: NDArray[np.int64],
    drift: VioDrift,
) -> ModelCheck:
    """Hold models against VIO: poses (N, 4, 4), each in the gauge of its model, and its number, -1 for none.

    A frame disagrees where it is beyond VIO's drift in any window, and all frames of a model do where places that VIO
    has far apart are folded together in it. Where VIO has nothing to say, nothing speaks against a frame.
    """
    agrees = model_N >= 0
    turned: dict[str, float] = {}
    for number in range(int(model_N.max(initial=-1)) + 1):
        own = model_N == number
        for recording in np.unique(recording_N[own]):
            parts = _stretches(own & (recording_N == recording), vio, t_ns_N)
            agrees[own] &= ~_moving_otherwise(parts, sfm_T_cam, vio, drift, len(agrees))[own]
        for session in np.unique(vio.session[own]):
            parts = _stretches(own & (vio.session == session), vio, t_ns_N)
            if not parts:
                continue
            found = diagnose([TrajectoryPair(sfm_T_cam[rows], vio.vio_T_cam[rows]) for rows in parts], drift)
            if found.folded > FOLDED_LIMIT:
                agrees[own] = False
            motions = found.motions
            verdict = decide(abs(motions.turn_gain - 1), motions.turn_gain_sd, TURN_GAIN_LIMIT)
            if verdict is Status.FAILED and motions.explained >= _EXPLAINED:
                turned[str(session)] = motions.turn_gain
    otherwise = set(vio.session[(model_N >= 0) & ~agrees].tolist())
    return ModelCheck(agrees, turned if otherwise <= turned.keys() else {})


def _stretches(chosen: NDArray[np.bool_], vio: Odometry, t_ns_N: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """The rows of the chosen frames with VIO between its jumps, session by session, in order of time."""
    parts = []
    for session in np.unique(vio.session[chosen]):
        rows = np.flatnonzero(chosen & (vio.session == session) & np.isfinite(vio.vio_T_cam[:, 0, 0]))
        rows = rows[np.argsort(t_ns_N[rows], kind="stable")]
        jumps = (np.diff(vio.jumped_m[rows]) > 0) | (np.diff(vio.jumped_rad[rows]) > 0)
        parts += [part for part in np.split(rows, np.flatnonzero(jumps) + 1) if len(part)]
    return parts


def _moving_otherwise(
    parts: list[NDArray[np.intp]], sfm_T_cam: Array, vio: Odometry, drift: VioDrift, frames: int
) -> NDArray[np.bool_]:
    """(N,) frames of a recording's parts in one model that are beyond a limit in some window."""
    wrong = np.zeros(frames, bool)
    try:
        scale = recording_scale(
            [TrajectoryPair(sfm_T_cam[rows], vio.vio_T_cam[rows]) for rows in parts],
            step_m=STEP_M,
            step_sd=STEP_SCALE_SD,
            tolerance=_TOLERANCE,
        )
    except GeometryError:
        # The model has in one place what VIO has apart.
        for rows in parts:
            wrong[rows] = True
        return wrong
    if scale is None:
        return wrong
    metric_S_sfm = Sim3(float(np.exp(scale.log)), np.eye(3), np.zeros(3))
    for rows in parts:
        metric_T_cam = metric_S_sfm.poses(sfm_T_cam[rows])
        for window in compare_windows(metric_T_cam, vio.vio_T_cam[rows], WINDOW_M, drift, POSE_SD, _TOLERANCE):
            wrong[rows[window.inside[window.wrong]]] = True
    return wrong
