"""Where each session's VIO frame lies in the map, and how well it fits: the rows of align.sessions and residuals."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from groundwalk.alignment.components import PlacedComponent
from groundwalk.alignment.segments import Segment
from groundwalk.consistency.windows import POSE_SD, fit_rigid
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import direction_angles, fit_poses, fit_sim3, pose_residuals
from groundwalk.geometry.poses import Array
from groundwalk.store.schemas import schema
from groundwalk.store.tables import pose_frame

# A rigid fit of fewer poses has no residual.
_MIN_FRAMES = 3


class PoseResiduals(NamedTuple):
    """What a fit leaves of n poses: metres and degrees (n,)."""

    position_m: Array
    rotation_deg: Array


_NO_RESIDUALS = PoseResiduals(np.empty(0), np.empty(0))


@dataclass(frozen=True, kw_only=True)
class SessionFit:
    """A segment with its frames' map_T_cam (N, 4, 4) against the map: map_T_vio (4, 4), rigid, and the residuals of its
    frames with ground truth, all NaN or empty where there are too few; `compared` (n,) are those frames' indices.
    `sim3`: residuals by a similarity, of all frames with both poses. `is_upright`: VIO and map have their vertical in
    common."""

    segment: Segment
    map_T_cam: Array
    has_ground_truth: np.ndarray
    compared: np.ndarray
    map_T_vio: Array
    rigid: PoseResiduals
    sim3: PoseResiduals
    is_upright: bool = True


def fit_session(
    segment: Segment, map_T_cam: Array, has_ground_truth: np.ndarray, *, is_metric: bool = True, is_upright: bool = True
) -> SessionFit:
    """Fit a segment's VIO to the map: poses map_T_cam (N, 4, 4) of all its frames, of which those that have ground
    truth (N,) are fitted. Nothing but a similarity fits metres to a map that isn't metric (`is_metric`). `is_upright`:
    the map is.

    The similarity's residuals are by a plain least-squares fit: of positions for positions, and of rotations alone for
    rotations, as a short or straight path says little of these.
    """
    compared = np.flatnonzero(has_ground_truth & segment.has_both)
    compared = compared if is_metric and len(compared) >= _MIN_FRAMES else compared[:0]
    both = segment.has_both
    map_T_vio, rigid = np.full((4, 4), np.nan), _NO_RESIDUALS
    if len(compared):
        map_T_vio, metres, radians = fit_rigid(map_T_cam[compared], segment.vio_T_cam[compared], POSE_SD)
        rigid = PoseResiduals(metres, np.degrees(radians))
    return SessionFit(
        segment=segment,
        map_T_cam=map_T_cam,
        has_ground_truth=has_ground_truth,
        compared=compared,
        map_T_vio=map_T_vio,
        rigid=rigid,
        sim3=_similarity_residuals(map_T_cam[both], segment.vio_T_cam[both]),
        is_upright=is_upright and segment.has_gravity,
    )


def _similarity_residuals(map_T_cam: Array, vio_T_cam: Array) -> PoseResiduals:
    try:
        vio_S_map = fit_sim3(vio_T_cam[:, :3, 3], map_T_cam[:, :3, 3], line_ok=True)
    except GeometryError:
        return _NO_RESIDUALS
    metres, _ = pose_residuals(vio_T_cam, vio_S_map.poses(map_T_cam), np.eye(4))
    vio_T_map = fit_poses(vio_T_cam, map_T_cam, position_sd_m=np.inf, rotation_sd=1.0)
    _, radians = pose_residuals(vio_T_cam, map_T_cam, vio_T_map)
    return PoseResiduals(metres, np.degrees(radians))


def sessions_table(fits: list[SessionFit], placed: list[PlacedComponent]) -> pd.DataFrame:
    """The align.sessions table."""
    of_component = {each.component.index: each for each in placed}
    table = pd.DataFrame([_session_row(fit, of_component[fit.segment.component]) for fit in fits])
    return pd.concat([table, pose_frame("map_vio", np.stack([fit.map_T_vio for fit in fits]))], axis=1)


def _session_row(fit: SessionFit, placed: PlacedComponent) -> dict[str, object]:
    s, scale, vertical = fit.segment, placed.component.scale, placed.component.vertical
    of_recording, up = scale.recordings.get(s.recording), vertical.recordings.get(s.recording)
    ratio = None if of_recording is None else float(np.exp(of_recording.log - scale.log))
    up_error = None
    if up is not None and vertical.source.is_known:
        up_error = float(np.degrees(direction_angles(up.up_sfm[None], vertical.up_sfm)[0]))
    return {
        "session_id": s.session_id,
        "segment": s.index,
        "component": s.component,
        "vio_link_m": None if placed.link is None else placed.link.gap_m,
        "t_start_ns": int(s.t_ns[0]),
        "t_end_ns": int(s.t_ns[-1]),
        "frames": len(s.rows),
        "registered": int(s.registered.sum()),
        "with_ground_truth": int(fit.has_ground_truth.sum()),
        "path_m": s.path_m,
        "scale_source": scale.source,
        "scale": ratio,
        "scale_sd": None if of_recording is None or ratio is None else ratio * of_recording.sd,
        "up_error_deg": up_error,
        **_statistics("position", "m", fit.rigid.position_m),
        **_statistics("rotation", "deg", fit.rigid.rotation_deg),
        "sim3_position_rms_m": rms(fit.sim3.position_m),
        "sim3_rotation_median_deg": _median(fit.sim3.rotation_deg),
    }


def residuals_table(
    fits: list[SessionFit], frame_id: np.ndarray, window_position_m: Array, window_rotation_deg: Array
) -> pd.DataFrame:
    """The align.residuals table; frame_id and the windows' residuals are over all rows of the frames table."""
    tables = []
    for fit in fits:
        s, rows = fit.segment, fit.segment.rows[fit.compared]
        columns = {
            "frame_id": frame_id[rows],
            "session_id": s.session_id,
            "segment": s.index,
            "component": s.component,
            "t_ns": s.t_ns[fit.compared],
            "travelled_m": s.travelled_m[fit.compared] - s.travelled_m[0],
            "position_m": fit.rigid.position_m,
            "rotation_deg": fit.rigid.rotation_deg,
            "window_position_m": window_position_m[rows],
            "window_rotation_deg": window_rotation_deg[rows],
        }
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)[schema("align", "residuals").column_names]


def _statistics(name: str, unit: str, values: Array) -> dict[str, float | None]:
    largest = float(values.max()) if len(values) else None
    return {f"{name}_rms_{unit}": rms(values), f"{name}_median_{unit}": _median(values), f"{name}_max_{unit}": largest}


def rms(values: Array) -> float | None:
    """Root mean square; None of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def _median(values: Array) -> float | None:
    return float(np.median(values)) if len(values) else None
