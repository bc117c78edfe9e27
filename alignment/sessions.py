"""Where each session's VIO frame lies in the map, and how well it fits: the rows of align.sessions and residuals."""

from dataclasses import dataclass

import numpy as np
import pandas as pd

from groundwalk.alignment.components import Placed
from groundwalk.alignment.segments import Segment
from groundwalk.artefacts.schemas import schema
from groundwalk.artefacts.tables import pose_frame
from groundwalk.consistency.windows import PoseSd, fit_rigid
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import direction_angles, fit_poses, fit_sim3, pose_residuals
from groundwalk.geometry.poses import Array

# A rigid fit of fewer poses has nothing left to show a residual with.
_LEAST_FRAMES = 3


@dataclass(frozen=True)
class SessionFit:
    """A segment with its frames' map_T_cam (N, 4, 4) against the map: map_T_vio (4, 4), rigid and with yaw only, and
    the residuals of its frames with ground truth, all NaN or empty where there are too few; `compared` (n,) are those
    frames' indices."""

    segment: Segment
    map_T_cam: Array
    used: np.ndarray
    compared: np.ndarray
    map_T_vio: Array
    position_m: Array
    rotation_deg: Array
    map_T_vio_yaw: Array
    yaw_position_m: Array
    yaw_rotation_deg: Array
    sim3_position_m: Array
    sim3_rotation_deg: Array


def fit_session(
    segment: Segment, map_T_cam: Array, used: np.ndarray, sd: PoseSd, *, is_metric: bool = True
) -> SessionFit:
    """Fit a segment's VIO to the map: poses map_T_cam (N, 4, 4) of all its frames, `used` (N,) those to go by. Nothing
    but a similarity fits metres to a map that isn't metric (`is_metric`).

    The similarity's residuals are over all frames with both poses, used or not, as a plain least-squares fit: of
    positions for positions, and of rotations alone for rotations, as a short or straight path says little of these.
    """
    compared = np.flatnonzero(used & segment.both)
    nowhere, nothing = np.full((4, 4), np.nan), np.empty(0)
    sim3_position_m, sim3_rotation_deg = _similarity_residuals(segment, map_T_cam)
    if len(compared) < _LEAST_FRAMES or not is_metric:
        return SessionFit(
            segment,
            map_T_cam,
            used,
            compared[:0],
            nowhere,
            nothing,
            nothing,
            nowhere,
            nothing,
            nothing,
            sim3_position_m,
            sim3_rotation_deg,
        )
    gt, vio = map_T_cam[compared], segment.vio_T_cam[compared]
    map_T_vio, metres, radians = fit_rigid(gt, vio, sd)
    map_T_vio_yaw, yaw_metres, yaw_radians = fit_rigid(gt, vio, sd, yaw_only=True)
    return SessionFit(
        segment,
        map_T_cam,
        used,
        compared,
        map_T_vio,
        metres,
        np.degrees(radians),
        map_T_vio_yaw,
        yaw_metres,
        np.degrees(yaw_radians),
        sim3_position_m,
        sim3_rotation_deg,
    )


def _similarity_residuals(segment: Segment, map_T_cam: Array) -> tuple[Array, Array]:
    known = segment.both
    vio, gt = segment.vio_T_cam[known], map_T_cam[known]
    try:
        vio_S_map = fit_sim3(vio[:, :3, 3], gt[:, :3, 3], line_ok=True)
    except GeometryError:
        return np.empty(0), np.empty(0)
    metres, _ = pose_residuals(vio, vio_S_map.poses(gt), np.eye(4))
    _, radians = pose_residuals(vio, gt, fit_poses(vio, gt, position_sd_m=np.inf, rotation_sd=1.0))
    return metres, np.degrees(radians)


def sessions_table(fits: list[SessionFit], placed: list[Placed], max_scale_sd: float) -> pd.DataFrame:
    """The align.sessions table; `placed` is the model that each fit's frames are from, `max_scale_sd` the setting."""
    rows = []
    for fit, of in zip(fits, placed, strict=True):
        s, scale, vertical = fit.segment, of.component.scale, of.component.vertical
        own_scale = scale.recordings.get(s.recording)
        own_up = vertical.recordings.get(s.recording)
        ratio = None if own_scale is None else float(np.exp(own_scale.log - scale.log))
        rows.append(
            {
                "session_id": s.session_id,
                "segment": s.index,
                "component": s.component,
                "bridge_m": None if of.bridge is None else of.bridge.gap_m,
                "t_start_ns": int(s.t_ns[0]),
                "t_end_ns": int(s.t_ns[-1]),
                "frames": len(s.rows),
                "registered": int(s.registered.sum()),
                "used": int(fit.used.sum()),
                "path_m": float(s.travelled_m[-1]),
                "scale_source": scale.source(max_scale_sd),
                "scale": ratio,
                "scale_sd": None if own_scale is None or ratio is None else ratio * own_scale.sd,
                "up_error_deg": None
                if own_up is None
                else float(np.degrees(direction_angles(own_up.up_sfm[None], vertical.up_sfm)[0])),
                **_statistics("position", "m", fit.position_m),
                **_statistics("rotation", "deg", fit.rotation_deg),
                "yaw_position_rms_m": _rms(fit.yaw_position_m),
                "yaw_rotation_rms_deg": _rms(fit.yaw_rotation_deg),
                "sim3_position_rms_m": _rms(fit.sim3_position_m),
                "sim3_rotation_median_deg": _median(fit.sim3_rotation_deg),
            }
        )
    table = pd.DataFrame(rows)
    poses = [
        pose_frame("map_vio", np.stack([f.map_T_vio for f in fits])),
        pose_frame("map_vio_yaw", np.stack([f.map_T_vio_yaw for f in fits])),
    ]
    return pd.concat([table, *poses], axis=1)


def residuals_table(
    fits: list[SessionFit], frame_id: np.ndarray, window_position_m: Array, window_rotation_deg: Array
) -> pd.DataFrame:
    """The align.residuals table; frame_id and the windows' residuals are over all rows of the frames table."""
    parts = []
    for fit in fits:
        s, rows = fit.segment, fit.segment.rows[fit.compared]
        parts.append(
            pd.DataFrame(
                {
                    "frame_id": frame_id[rows],
                    "session_id": s.session_id,
                    "segment": s.index,
                    "component": s.component,
                    "t_ns": s.t_ns[fit.compared],
                    "travelled_m": s.travelled_m[fit.compared],
                    "position_m": fit.position_m,
                    "rotation_deg": fit.rotation_deg,
                    "window_position_m": window_position_m[rows],
                    "window_rotation_deg": window_rotation_deg[rows],
                }
            )
        )
    columns = schema("align", "residuals").column_names
    return pd.concat(parts, ignore_index=True)[columns]


def _statistics(of: str, unit: str, values: Array) -> dict[str, float | None]:
    return {
        f"{of}_rms_{unit}": _rms(values),
        f"{of}_median_{unit}": _median(values),
        f"{of}_max_{unit}": float(values.max()) if len(values) else None,
    }


def _rms(values: Array) -> float | None:
    return float(np.sqrt(np.mean(values**2))) if len(values) else None


def _median(values: Array) -> float | None:
    return float(np.median(values)) if len(values) else None
