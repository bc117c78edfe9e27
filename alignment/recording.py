"""recording.rrd: the model in the map, ground truth by quality, VIO beside it, and their distance over time."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from groundwalk.alignment.components import PlacedComponent
from groundwalk.alignment.sessions import SessionFit
from groundwalk.geometry.poses import Array, quaternion_from_matrix, transform
from groundwalk.store.choices import QualityClass
from groundwalk.store.colours import GROUND_TRUTH, NEUTRAL, REJECTED, VIO
from groundwalk.store.recording import TIMELINE, UP_AXIS, log_camera, log_images, log_path, set_time

_QUALITY_COLOURS = {QualityClass.A: GROUND_TRUTH, QualityClass.B: (110, 200, 170), QualityClass.C: NEUTRAL}
# Sessions in the residuals' two plots; grey, green and orange mean something else.
_SESSION_COLOURS = [(0, 114, 178), (204, 121, 167), (86, 180, 233), (240, 228, 66), (170, 110, 40), (150, 110, 220)]
# Ellipsoids are drawn so many times too large: a centimetre on a walk of 50 m can't be seen.
_ELLIPSOID_TIMES = 10
# 95 % of three normal axes lie within so many standard deviations.
_BOUND_95 = 2.7955
# Cameras are drawn this long, as a fraction of the ground truth's extent, within these metres.
_CAMERA_FRACTION, _CAMERA_RANGE_M = 0.04, (0.03, 0.3)


def blueprint(sessions: Sequence[str]) -> rrb.Blueprint:
    """The map beside each session's images, and how far VIO is from ground truth over time."""
    images = [rrb.Spatial2DView(origin=f"images/{session}", name=session) for session in sessions]
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="map", name="Map: ground truth and VIO"),
            rrb.Vertical(
                rrb.Tabs(*images, name="images"),
                rrb.TimeSeriesView(origin="residuals/position_m", name="VIO from ground truth, metres"),
                rrb.TimeSeriesView(origin="residuals/rotation_deg", name="VIO from ground truth, degrees"),
                row_shares=[2, 1, 1],
            ),
            column_shares=[3, 2],
        ),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed"),
        collapse_panels=True,
    )


def log_models(rec: rr.RecordingStream, placed: Sequence[PlacedComponent], points: pd.DataFrame) -> None:
    """SfM's points of each model."""
    rec.log("map", UP_AXIS, static=True)
    for each in placed:
        of_model = points[points["model_id"] == each.component.model_id]
        xyz = each.map_S_sfm.points(of_model[["x", "y", "z"]].to_numpy(float))
        colours = of_model[["r", "g", "b"]].to_numpy(np.uint8)
        cloud = rr.Points3D(xyz, colors=colours, radii=rr.Radius.ui_points(1.5))
        rec.log(f"map/points/model_{each.component.index}", cloud, static=True)


def log_frames(rec: rr.RecordingStream, truth: pd.DataFrame, map_T_cam: Array, frames: pd.DataFrame) -> None:
    """All cameras map_T_cam (N, 4, 4) as wire pyramids, one entity a quality, so that each can be switched off, and
    where each position lies with 95 %, enlarged so that it can be seen: the entity's name says how much.

    Frames that a check excluded are shown where SfM had them, apart from the ground truth.
    """
    quality, camera_m = truth["quality"].to_numpy(str), camera_length_m(truth)
    excluded = (quality == QualityClass.NONE) & np.isfinite(map_T_cam[:, 0, 0])
    classes = {f"ground_truth/cameras/quality_{name}": (quality == name, c) for name, c in _QUALITY_COLOURS.items()}
    for path, (mask, colour) in (classes | {"excluded/cameras": (excluded, REJECTED)}).items():
        strips = [strip for i in np.flatnonzero(mask) for strip in _pyramid(map_T_cam[i], frames.iloc[i], camera_m)]
        rec.log(f"map/{path}", rr.LineStrips3D(strips, colors=colour, radii=rr.Radius.ui_points(0.8)), static=True)
    certain = truth[truth["covariance"].notna()]
    if not len(certain):
        return
    variance, axes = np.linalg.eigh(np.stack(list(certain["covariance"])).reshape(-1, 6, 6)[:, 3:, 3:])
    # An ellipsoid's axes may be a mirrored triple; a quaternion needs a turned one.
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]
    ellipsoids = rr.Ellipsoids3D(
        centers=certain[["map_cam_tx", "map_cam_ty", "map_cam_tz"]].to_numpy(float),
        half_sizes=_ELLIPSOID_TIMES * _BOUND_95 * np.sqrt(np.maximum(variance, 0.0)),
        quaternions=quaternion_from_matrix(axes),
        colors=[_QUALITY_COLOURS[name] for name in certain["quality"]],
        fill_mode=rr.components.FillMode.MajorWireframe,
        line_radii=rr.Radius.ui_points(0.8),
    )
    rec.log(f"map/ground_truth/bounds_95_times_{_ELLIPSOID_TIMES}", ellipsoids, static=True)


def log_sessions(rec: rr.RecordingStream, fits: Sequence[SessionFit], frames: pd.DataFrame, camera_m: float) -> None:
    """Each session's path in ground truth and VIO, cameras of `camera_m` moving along them, and how far they are
    apart."""
    sessions = sorted({fit.segment.session_id for fit in fits})
    for fit in fits:
        s = fit.segment
        colour = _SESSION_COLOURS[sessions.index(s.session_id) % len(_SESSION_COLOURS)]
        # Below the session's path, as its name with something behind it may be another session's.
        name = f"{s.session_id}/after_jump_{s.index}" if s.index else s.session_id
        if s.component:
            name += f"/model_{s.component}"
        map_T_cam = fit.map_T_cam.copy()
        map_T_cam[~fit.has_ground_truth] = np.nan
        log_path(rec, f"map/ground_truth/{name}/path", map_T_cam[:, :3, 3], GROUND_TRUTH)
        if not len(fit.compared):
            continue
        vio_in_map = fit.map_T_vio @ s.vio_T_cam
        log_path(rec, f"map/vio/{name}/path", vio_in_map[:, :3, 3], VIO)
        for residual in ("position_m", "rotation_deg"):
            rec.log(f"residuals/{residual}/{name}", rr.SeriesLines(colors=colour, names=name), static=True)
        # Sessions have different clocks; from each one's start their curves lie over each other.
        start_ns = frames.loc[frames["session_id"] == s.session_id, "t_ns"].min()
        for number, index in enumerate(fit.compared):
            set_time(rec, s.t_ns[index] - start_ns)
            frame = frames.iloc[s.rows[index]]
            log_camera(rec, f"map/ground_truth/{name}/camera", map_T_cam[index], frame, GROUND_TRUTH, 2 * camera_m)
            log_camera(rec, f"map/vio/{name}/camera", vio_in_map[index], frame, VIO, 2 * camera_m)
            rec.log(f"residuals/position_m/{name}", rr.Scalars(fit.rigid.position_m[number]))
            rec.log(f"residuals/rotation_deg/{name}", rr.Scalars(fit.rigid.rotation_deg[number]))


def log_session_images(rec: rr.RecordingStream, frames: pd.DataFrame, image_path: Callable[[str], Path]) -> None:
    """What each session saw."""
    for session, rows in frames.groupby("session_id"):
        since = (rows["t_ns"] - rows["t_ns"].min()).to_numpy()
        rows = rows.assign(file=rows["image"].map(image_path))
        log_images(rec, f"images/{session}", rows, [(TIMELINE, since)])


def camera_length_m(truth: pd.DataFrame) -> float:
    """How long cameras are drawn."""
    xyz = truth[["map_cam_tx", "map_cam_ty", "map_cam_tz"]]
    extent_m = float(np.linalg.norm(xyz.max() - xyz.min()))
    return float(np.clip(_CAMERA_FRACTION * extent_m, *_CAMERA_RANGE_M))


def _pyramid(map_T_cam: Array, frame: pd.Series, depth_m: float) -> list[Array]:
    """A camera's view as two line strips: the image's border with two edges, and the other two edges."""
    border = np.array([(0, 0), (frame.width, 0), (frame.width, frame.height), (0, frame.height)], float)
    corners = depth_m * np.column_stack([(border - [frame.cx, frame.cy]) / [frame.fx, frame.fy], np.ones(4)])
    a, b, c, d, eye = transform(map_T_cam, np.vstack([corners, np.zeros(3)]))
    return [np.stack([eye, a, b, c, d, a]), np.stack([b, eye, c]), np.stack([d, eye])]
