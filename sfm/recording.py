"""The stage's Rerun recording: points, cameras, verified pairs and each session's path."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb

from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.fits import rotation_to_up
from groundwalk.geometry.poses import Array
from groundwalk.geometry.rows import evenly
from groundwalk.sfm.model import Model
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import StageRun
from groundwalk.store.choices import PairStatus
from groundwalk.store.colours import GROUND_TRUTH, NEUTRAL, REJECTED
from groundwalk.store.parallel import in_parallel
from groundwalk.store.recording import FRAME_TIMELINE, TIMELINE, UP_AXIS, log_camera, log_path
from groundwalk.store.tables import camera_of, poses_of
from groundwalk.store.undistortion import undistorted_image

_MAX_FRUSTA, _MAX_IMAGES = 200, 250
_IMAGE_SIDE = 480
_FRUSTUM = 0.5  # in median steps


def write_recording(r: StageRun[SfmSettings], frames: pd.DataFrame, model: Model, pairs_table: pd.DataFrame) -> None:
    """Write recording.rrd: the models upright and side by side, and frame by frame what each image sees of them."""
    registered = np.flatnonzero(model.registered)
    model = side_by_side(model, poses_of(frames, "vio_cam"))
    centres = model.sfm_T_cam[:, :3, 3]
    with r.recording(_blueprint()) as stream:
        stream.log("/", UP_AXIS, static=True)
        stream.log("sfm/points", rr.Points3D(model.xyz, colors=model.rgb, radii=rr.Radius.ui_points(1.5)), static=True)
        for session, rows in frames.groupby("session_id", sort=True).indices.items():
            log_path(stream, f"sfm/paths/{session}", centres[np.sort(rows)], GROUND_TRUTH)
        for row in registered[evenly(len(registered), _MAX_FRUSTA)]:
            frame = frames.iloc[row]
            path = f"sfm/cameras/{frame.frame_id}"
            log_camera(stream, path, model.sfm_T_cam[row], frame, NEUTRAL, _FRUSTUM, static=True)
        verified = pairs_table[pairs_table["status"] == PairStatus.VERIFIED]
        row_of = pd.Series(range(len(frames)), frames["frame_id"])
        pairs = np.column_stack([row_of[verified[f"frame_id_{end}"]] for end in "ab"])
        pairs = pairs[model.registered[pairs].all(axis=1)]
        lines = rr.LineStrips3D(list(centres[pairs]), colors=NEUTRAL, radii=rr.Radius.ui_points(0.5))
        stream.log("sfm/pairs", lines, static=True)

        since_start = (frames["t_ns"] - frames.groupby("session_id")["t_ns"].transform("min")).to_numpy(
            "timedelta64[ns]"
        )
        times = [
            rr.TimeColumn(FRAME_TIMELINE, sequence=registered),
            rr.TimeColumn(TIMELINE, duration=since_start[registered]),
        ]
        for name, values in model.of_frames()[["observations", "reprojection_px"]].items():
            stream.log(f"quality/{name}", rr.SeriesLines(colors=GROUND_TRUTH), static=True)
            scalars = rr.Scalars.columns(scalars=values.to_numpy(float)[registered])
            stream.send_columns(f"quality/{name}", times, scalars)

        rows = registered[evenly(len(registered), _MAX_IMAGES)]
        cameras = [camera_of(frames.iloc[row]) for row in rows]
        paths = [r.image_path(image) for image in frames["image"].iloc[rows]]
        images = in_parallel(lambda item: _undistorted(*item), zip(paths, cameras, strict=True))
        for row, camera, image in zip(rows.tolist(), cameras, images, strict=True):
            stream.set_time(FRAME_TIMELINE, sequence=row)
            stream.set_time(TIMELINE, duration=since_start[row])
            # Where in the image a camera without rolling shutter sees the points.
            _, pinhole = _small(camera)
            log_camera(stream, "sfm/camera", model.sfm_T_cam[row], pinhole, REJECTED, 2 * _FRUSTUM)
            stream.log("sfm/camera/image", image)
            observed_px = pinhole.project(camera.unproject(model.observed_px[model.frame == row]))
            seen = rr.Points2D(observed_px, colors=GROUND_TRUTH, radii=rr.Radius.ui_points(1.5))
            stream.log("sfm/camera/image/seen", seen)


def _blueprint() -> rrb.Blueprint:
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Spatial3DView(origin="/", name="model", overrides={"sfm/pairs": rrb.EntityBehavior(visible=False)}),
            rrb.Vertical(
                rrb.Spatial2DView(origin="sfm/camera/image", name="frame and the points it sees"),
                rrb.TimeSeriesView(origin="quality/observations", name="points seen"),
                rrb.TimeSeriesView(origin="quality/reprojection_px", name="reprojection error, px"),
                row_shares=[2, 1, 1],
            ),
            column_shares=[2, 1],
        ),
        rrb.TimePanel(timeline=FRAME_TIMELINE, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
    )


def side_by_side(model: Model, vio_T_cam: Array) -> Model:
    """The models upright, one beside the other along x, in units of the median step of each.

    They share no gauge, so the place and size of one against another mean nothing.
    """
    sfm_T_cam, xyz = model.sfm_T_cam.copy(), model.xyz.copy()
    beside = 0.0
    for number in range(int(model.model.max()) + 1):
        members, points = model.model == number, model.point_model == number
        if not members.any():  # all its frames were taken out
            continue
        centres = sfm_T_cam[members, :3, 3]
        steps = np.linalg.norm(np.diff(centres, axis=0), axis=1)
        step = (float(np.median(steps)) if len(steps) else 0.0) or 1.0
        upright, known = np.eye(3), members & np.isfinite(vio_T_cam).all(axis=(1, 2))
        if known.any():
            # vio's +y in camera axes is the second row of vio_R_cam.
            up = np.einsum("nij,nj->ni", model.sfm_T_cam[known, :3, :3], vio_T_cam[known, 1, :3]).mean(axis=0)
            upright = rotation_to_up(up)
        drawn = centres @ upright.T / step
        width = float(np.ptp(drawn[:, 0]))
        shift = np.array([beside - drawn[:, 0].min(), 0.0, 0.0])
        sfm_T_cam[members, :3, :3] = upright @ sfm_T_cam[members, :3, :3]
        sfm_T_cam[members, :3, 3] = drawn + shift
        xyz[points] = xyz[points] @ upright.T / step + shift
        beside += 1.5 * width
    return replace(model, sfm_T_cam=sfm_T_cam, xyz=xyz)


def _small(camera: Camera) -> tuple[Camera, Camera]:
    """The camera of an image at the recording's size, and without its lens: the viewer draws by pinholes alone."""
    shrink = min(1.0, _IMAGE_SIDE / max(camera.width, camera.height))
    small = camera.resized(round(shrink * camera.width), round(shrink * camera.height))
    return small, replace(small, distortion=())


def _undistorted(path: Path, camera: Camera) -> rr.Image | rr.EncodedImage:
    image = cv2.imread(str(path), cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION)
    assert image is not None, path
    small, pinhole = _small(camera)
    shrunk = np.asarray(cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA), np.uint8)
    return rr.Image(undistorted_image(shrunk, small, pinhole)).compress(75)
