"""Rulers in the images, and their size in each SfM model, in the model's units."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.alignment.quality import sfm_covariances
from groundwalk.alignment.rulers.detection import (
    BoardRuler,
    Detection,
    detect_all,
    explain_absence,
    held_out_corners,
    nominal_corners,
)
from groundwalk.alignment.rulers.settings import AprilTagRuler, CharucoRuler, DistanceRuler, Ruler
from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array
from groundwalk.geometry.rulers import Corners, Observations, RulerFit, measure
from groundwalk.geometry.shutter import readout_fraction, readout_lines, rows_in_camera
from groundwalk.store import UserError
from groundwalk.store.choices import RulerPart
from groundwalk.store.tables import camera_of, poses_of

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Smallest standard error of an observation, pixels in an image axis: detected, and read off by a person.
_DETECTION_SD_PX, _READ_OFF_SD_PX = 0.1, 1.0


@dataclass(frozen=True)
class RulerDetections:
    """A ruler in the images: M observations by row of the frames table, corner, and pixel (M, 2). `held_out` (K,) are
    corners that never set the scale. `absence`: why there is no observation."""

    ruler: Ruler
    corners: Corners
    held_out: Mask
    row: Indices
    corner: Indices
    xy_px: Array
    absence: str = ""


@dataclass(frozen=True)
class RulerMeasurement:
    """A ruler in a model. `in_model` (M,) are the observations in frames of the model, `cam_T_row` (M, 4, 4) where the
    camera was when each one's row was exposed, in the axes of its frame's pose, and `fits` the measurements by part of
    the ruler. `problem`: why they decide nothing; `notes`: remarks for the user."""

    detections: RulerDetections
    model_id: str
    in_model: Mask
    cam_T_row: Array
    fits: dict[RulerPart, RulerFit] = field(default_factory=dict)
    problem: str = ""
    notes: tuple[str, ...] = ()

    @property
    def ruler(self) -> Ruler:
        return self.detections.ruler

    @property
    def frames(self) -> int:
        """Frames of the model that see the ruler."""
        return len(np.unique(self.detections.row[self.in_model]))

    def log_metres(self, part: RulerPart = RulerPart.ALL) -> float:
        """Logarithm of metres per unit of the model, by this part of the ruler."""
        return -self.fits[part].log_scale

    def sd(self, part: RulerPart = RulerPart.ALL) -> float:
        """Its standard error: of the measurement and of the stated size."""
        return float(np.hypot(self.fits[part].sd, 0.01 * self.ruler.length_sd_percent))

    def size_mm(self, metres_per_unit: float, part: RulerPart = RulerPart.ALL) -> float:
        """The stated size as it measures in a map of this scale."""
        return self.ruler.size_mm * metres_per_unit * float(np.exp(self.fits[part].log_scale))


def find_rulers(
    rulers: Sequence[Ruler], frames: pd.DataFrame, image_path: Callable[[str], Path]
) -> list[RulerDetections]:
    """Look for rulers in all images of import's table `frames`; distances are where the settings say.

    Raises UserError for an image that can't be read, a distance's frame that doesn't exist, or a pixel outside of it.
    """
    boards = [ruler for ruler in rulers if not isinstance(ruler, DistanceRuler)]
    paths = [image_path(image) for image in frames["image"]] if boards else []
    by_image = detect_all(boards, paths)
    return [
        _read_off(ruler, frames)
        if isinstance(ruler, DistanceRuler)
        else _detections(ruler, [of_image[boards.index(ruler)] for of_image in by_image], paths)
        for ruler in rulers
    ]


def _detections(ruler: BoardRuler, by_image: Sequence[Detection], paths: Sequence[Path]) -> RulerDetections:
    """A board's detections, one an image of these paths, together."""
    seen = [(row, d) for row, d in enumerate(by_image) if len(d.corner)]
    corners = nominal_corners(ruler)
    corner = np.concatenate([np.empty(0, dtype=np.int64), *(d.corner for _, d in seen)])
    return RulerDetections(
        ruler,
        corners,
        held_out_corners(ruler, corners, corner),
        np.repeat([row for row, _ in seen], [len(d.corner) for _, d in seen]).astype(np.int64),
        corner,
        np.concatenate([np.empty((0, 2)), *(d.xy for _, d in seen)]),
        "" if seen else explain_absence(ruler, paths),
    )


def measure_rulers(
    detections: Sequence[RulerDetections],
    frames: pd.DataFrame,
    images: pd.DataFrame,
    *,
    min_angle: float,
    max_sd: float,
) -> list[RulerMeasurement]:
    """Each ruler in each model that has frames of it; one without a model where none has.

    `frames` is import's table with SfM's cameras, `images` SfM's in its order. As in SfM, lens and rolling shutter are
    undone: a corner is seen by the adjusted lens from where the camera was when its row was exposed. Views less than
    `min_angle` (radians) apart, or a standard error above `max_sd`, decide nothing.
    """
    measurements = []
    poses, covariance = poses_of(images, "sfm_cam"), sfm_covariances(images["covariance"])
    registered, model_id = images["registered"].to_numpy(bool), images["model_id"].to_numpy(object)
    for ruler in detections:
        models = pd.unique(model_id[ruler.row[registered[ruler.row]]])
        if not len(models):
            problem = ruler.absence or "seen only in frames that SfM didn't register"
            unseen = np.zeros(len(ruler.row), dtype=bool)
            measurements.append(RulerMeasurement(ruler, "", unseen, np.empty((0, 4, 4)), problem=problem))
            continue
        xy, focal_px = undistorted(frames, ruler.row, ruler.xy_px)
        cam_T_row = _rows_in_camera(frames, images, ruler)
        observations = Observations(ruler.corner, ruler.row, xy, focal_px, cam_T_row)
        for model in models:
            in_model = registered[ruler.row] & (model_id[ruler.row] == model) & np.isfinite(xy).all(axis=1)
            measurement = RulerMeasurement(ruler, str(model), in_model, cam_T_row)
            fits = _fit_parts(measurement, observations, poses, covariance)
            measurements.append(_judged(replace(measurement, fits=fits), frames, min_angle, max_sd))
    return measurements


def _rows_in_camera(frames: pd.DataFrame, images: pd.DataFrame, ruler: RulerDetections) -> Array:
    """cam_T_row (M, 4, 4) of a ruler's observations."""
    line = readout_lines(frames["first_row"], frames["width"], frames["height"])[ruler.row]
    tau = images["readout_s"].to_numpy(float)[ruler.row] * readout_fraction(line, ruler.xy_px)
    angular, velocity = (
        images[[f"{name}_{axis}" for axis in "xyz"]].to_numpy(float)[ruler.row] for name in ("angular", "velocity")
    )
    return rows_in_camera(angular, velocity, tau)


def undistorted(frames: pd.DataFrame, rows: Indices, xy_px: Array) -> tuple[Array, Array]:
    """Normalised image coordinates (M, 2) without distortion, of pixels (M, 2) in these rows of `frames`, and the focal
    length (M,) there. NaN where a frame's lens model can't be inverted."""
    xy, focal_px = np.full((len(rows), 2), np.nan), np.empty(len(rows))
    for row in np.unique(rows):
        same = rows == row
        camera = camera_of(frames.iloc[int(row)])
        focal_px[same] = np.sqrt(camera.fx * camera.fy)
        xy[same] = camera.unproject(xy_px[same])
    return xy, focal_px


def _read_off(ruler: DistanceRuler, frames: pd.DataFrame) -> RulerDetections:
    row_of = {frame_id: row for row, frame_id in enumerate(frames["frame_id"])}
    rows, corner, xy = [], [], []
    for index, point in enumerate(ruler.points):
        for observation in point.observations:
            if observation.frame not in row_of:
                raise UserError(
                    f"ruler {ruler.name!r}: point {point.name!r} is seen in a frame that doesn't exist",
                    where="[[ruler]] of the scene's file",
                    found=observation.frame,
                    expected=f"a frame_id of import.frames, such as {frames['frame_id'].iloc[0]}",
                    do="name a frame of import.frames; sampling drops images",
                )
            row = row_of[observation.frame]
            width, height = (int(frames[side].iloc[row]) for side in ("width", "height"))
            x, y = observation.xy
            if not (0 <= x <= width and 0 <= y <= height):
                raise UserError(
                    f"ruler {ruler.name!r}: point {point.name!r} is outside of its image",
                    where=f"[[ruler]] of the scene's file, frame {observation.frame}",
                    found=f"xy = [{x:g}, {y:g}]",
                    expected=f"pixels of the image as stored, [0, 0] to [{width}, {height}]",
                    do="read the pixel off the image at its full size, as import.frames has it",
                )
            rows.append(row)
            corner.append(index)
            xy.append(observation.xy)
    corners = Corners(np.array([[0.0, 0.0, 0.0], [ruler.length_m, 0.0, 0.0]]), np.zeros(2, dtype=np.int64))
    return RulerDetections(
        ruler, corners, np.zeros(2, dtype=bool), np.array(rows), np.array(corner), np.array(xy, dtype=float)
    )


def _fit_parts(
    measurement: RulerMeasurement, observations: Observations, poses: Array, covariance: Array
) -> dict[RulerPart, RulerFit]:
    """The parts of a ruler that its observations determine."""
    detections, in_model = measurement.detections, measurement.in_model
    parts = {RulerPart.ALL: in_model}
    if measurement.ruler.use_for_scale:
        is_held_out = detections.held_out[detections.corner]
        parts |= {RulerPart.FOR_SCALE: in_model & ~is_held_out, RulerPart.HELD_OUT: in_model & is_held_out}
    sd_px = _READ_OFF_SD_PX if isinstance(measurement.ruler, DistanceRuler) else _DETECTION_SD_PX
    fits: dict[RulerPart, RulerFit] = {}
    for part, rows in parts.items():
        with suppress(GeometryError):
            fits[part] = measure(detections.corners, observations.where(rows), poses, covariance, min_pixel_sd=sd_px)
    return fits


def _judged(measurement: RulerMeasurement, frames: pd.DataFrame, min_angle: float, max_sd: float) -> RulerMeasurement:
    """With its problem and notes; without fits where they are too few."""
    fits = measurement.fits
    if RulerPart.ALL not in fits or (measurement.ruler.use_for_scale and RulerPart.FOR_SCALE not in fits):
        return replace(measurement, fits={}, problem=_too_few(measurement, frames))
    notes = _notes(measurement, fits[RulerPart.ALL], frames)
    return replace(measurement, problem=_weakness(measurement, min_angle, max_sd), notes=notes)


def _too_few(measurement: RulerMeasurement, frames: pd.DataFrame) -> str:
    """Why no two points of a ruler could be triangulated."""
    detections, in_model = measurement.detections, measurement.in_model
    if RulerPart.ALL in measurement.fits:
        in_model = in_model & ~detections.held_out[detections.corner]
    seen = np.unique(np.column_stack([detections.corner, detections.row])[in_model], axis=0)
    frames_of = np.bincount(seen[:, 0], minlength=len(detections.corners.xyz_m))
    ids = frames["frame_id"].to_numpy(str)[np.unique(seen[:, 1])]
    names = ", ".join(ids[:3]) + (", ..." if len(ids) > 3 else "")
    where = f"in {len(ids)} frame{'s' * (len(ids) != 1)} ({names})"
    is_distance = isinstance(detections.ruler, DistanceRuler)
    points = "points" if is_distance else "corners"
    if np.count_nonzero(frames_of >= 2) >= 2:
        do = "check the pixels" if is_distance else "was it moved between them?"
        return (
            f"its {points} {where} don't fit the frames' poses: without outliers, no two of them are seen in 2 or more "
            f"frames; {do}"
        )
    if isinstance(detections.ruler, DistanceRuler):
        each = " and ".join(
            f"{point.name!r} in {count}" for point, count in zip(detections.ruler.points, frames_of, strict=True)
        )
        return f"{each} of the model's frames ({names}); each of its points must be seen in 2 or more"
    return f"seen {where}; two of its corners must be seen in 2 or more frames"


def _weakness(measurement: RulerMeasurement, min_angle: float, max_sd: float) -> str:
    """Why a measurement decides nothing; empty where it does."""
    fit = measurement.fits.get(RulerPart.FOR_SCALE, measurement.fits[RulerPart.ALL])
    if fit.angle < min_angle:
        return (
            f"its views are only {np.degrees(fit.angle):.1f} degrees apart, at least {np.degrees(min_angle):.1f} are "
            "needed; walk around it"
        )
    if fit.sd > max_sd:
        return f"its scale has a standard error of {fit.sd:.2%}, at most {max_sd:.2%} is needed; take more views of it"
    return ""


def _notes(measurement: RulerMeasurement, fit: RulerFit, frames: pd.DataFrame) -> tuple[str, ...]:
    """Sessions whose frames see the ruler elsewhere than the others do."""
    rows = measurement.detections.row[measurement.in_model]
    table = pd.DataFrame(
        {"session": frames["session_id"].to_numpy(str)[rows], "row": rows, "inlier": fit.inlier}
    ).groupby("session")
    sessions = table.agg(frames=("row", "nunique"), inliers=("inlier", "mean"))
    elsewhere = sessions[(sessions["frames"] >= 2) & (sessions["inliers"] < 0.5)]
    return tuple(
        f"{1 - inliers:.0%} of its observations in {count} frames of {session} are outliers: was it moved there?"
        for session, count, inliers in zip(elsewhere.index, elsewhere["frames"], elsewhere["inliers"], strict=True)
    )


def kind_of(ruler: Ruler) -> str:
    """What the ruler is, in a few words."""
    if isinstance(ruler, CharucoRuler):
        return f"ChArUco board, {ruler.squares_x} x {ruler.squares_y} squares of {ruler.square_mm:g} mm"
    if isinstance(ruler, AprilTagRuler):
        return f"AprilTags of {ruler.tag_mm:g} mm"
    return f"distance of {ruler.length_m:g} m"
