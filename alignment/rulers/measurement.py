"""The size of rulers in each SfM model, in the model's units, by where images show them."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.alignment.settings import DistanceRuler, Ruler
from groundwalk.alignment.sfm_tables import covariances
from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import Array
from groundwalk.geometry.rulers import Corners, Observations, RulerFit, measure
from groundwalk.geometry.shutter import readout_fraction, readout_lines, rows_in_camera
from groundwalk.store.choices import RulerPart
from groundwalk.store.tables import camera_of, poses_of

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

# Smallest standard error of an observation, pixels in an image axis: detected, and read off by a person.
_DETECTION_SD_PX, _READ_OFF_SD_PX = 0.1, 1.0
# A ruler whose views are less far apart, radians, or whose scale has a larger standard error, as a fraction, decides
# nothing: 1 % is what VIO's scale of a short walk is off by.
_MIN_ANGLE, _MAX_SD = float(np.radians(5.0)), 0.01


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
    """A ruler in a model. `in_model` (M,) are the observations in frames of the model, and `fits` the measurements by
    part of the ruler. `problem`: why they decide nothing; `notes`: remarks for the user."""

    detections: RulerDetections
    model_id: str
    in_model: Mask
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


def measure_rulers(
    detections: Sequence[RulerDetections], frames: pd.DataFrame, images: pd.DataFrame
) -> list[RulerMeasurement]:
    """Each ruler in each model that has frames of it; one without a model where none has.

    `frames` is import's table with SfM's cameras, `images` SfM's in its order. As in SfM, lens and rolling shutter are
    undone: a corner is seen by the adjusted lens from where the camera was when its row was exposed.
    """
    measurements = []
    poses, covariance = poses_of(images, "sfm_cam"), covariances(images["covariance"])
    registered, model_id = images["registered"].to_numpy(bool), images["model_id"].to_numpy(object)
    for ruler in detections:
        models = pd.unique(model_id[ruler.row[registered[ruler.row]]])
        if not len(models):
            problem = ruler.absence or "seen only in frames that SfM didn't register"
            unseen = np.zeros(len(ruler.row), dtype=bool)
            measurements.append(RulerMeasurement(ruler, "", unseen, problem=problem))
            continue
        observations = observations_of(frames, images, ruler.row, ruler.corner, ruler.xy_px)
        for model in models:
            in_model = registered[ruler.row] & (model_id[ruler.row] == model) & np.isfinite(observations.xy).all(axis=1)
            measurement = RulerMeasurement(ruler, str(model), in_model)
            fits = _fit_parts(measurement, observations, poses, covariance)
            measurement = replace(measurement, fits=fits)
            if RulerPart.ALL in fits and (not ruler.ruler.use_for_scale or RulerPart.FOR_SCALE in fits):
                notes = _notes(measurement, fits[RulerPart.ALL], frames)
                measurement = replace(measurement, problem=_weakness(measurement), notes=notes)
            else:
                measurement = replace(measurement, fits={}, problem=_too_few(measurement, frames))
            measurements.append(measurement)
    return measurements


def observations_of(
    frames: pd.DataFrame, images: pd.DataFrame, row: Indices, corner: Indices, xy_px: Array
) -> Observations:
    """Pixels (M, 2) of corners (M,) in these rows (M,) of the frames table without lens and rolling shutter."""
    # NaN where a frame's lens model can't be inverted.
    xy, focal_px = np.full((len(row), 2), np.nan), np.empty(len(row))
    for number in np.unique(row).tolist():
        camera = camera_of(frames.iloc[number])
        focal_px[row == number] = np.sqrt(camera.fx * camera.fy)
        xy[row == number] = camera.unproject(xy_px[row == number])
    line = readout_lines(frames["first_row"], frames["width"], frames["height"])[row]
    tau = images["readout_s"].to_numpy(float)[row] * readout_fraction(line, xy_px)
    angular, velocity = (
        images[[f"{name}_{axis}" for axis in "xyz"]].to_numpy(float)[row] for name in ("angular", "velocity")
    )
    return Observations(corner, row, xy, focal_px, rows_in_camera(angular, velocity, tau))


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
        counted = zip(detections.ruler.points, frames_of, strict=True)
        each = " and ".join(f"{point.name!r} in {count}" for point, count in counted)
        return f"{each} of the model's frames ({names}); each of its points must be seen in 2 or more"
    return f"seen {where}; two of its corners must be seen in 2 or more frames"


def _weakness(measurement: RulerMeasurement) -> str:
    """Why a measurement decides nothing; empty where it does."""
    fit = measurement.fits.get(RulerPart.FOR_SCALE, measurement.fits[RulerPart.ALL])
    if fit.angle < _MIN_ANGLE:
        return (
            f"its views are only {np.degrees(fit.angle):.1f} degrees apart, at least {np.degrees(_MIN_ANGLE):.1f} are "
            "needed; walk around it"
        )
    if fit.sd > _MAX_SD:
        return f"its scale has a standard error of {fit.sd:.2%}, at most {_MAX_SD:.2%} is needed; take more views of it"
    return ""


def _notes(measurement: RulerMeasurement, fit: RulerFit, frames: pd.DataFrame) -> tuple[str, ...]:
    """Sessions whose frames see the ruler elsewhere than the others do."""
    rows = measurement.detections.row[measurement.in_model]
    session = frames["session_id"].to_numpy(str)[rows]
    table = pd.DataFrame({"session": session, "row": rows, "inlier": fit.inlier}).groupby("session")
    sessions = table.agg(frames=("row", "nunique"), inliers=("inlier", "mean"))
    elsewhere = sessions[(sessions["frames"] >= 2) & (sessions["inliers"] < 0.5)]
    return tuple(
        f"{1 - inliers:.0%} of its observations in {count} frames of {session} are outliers: was it moved there?"
        for session, count, inliers in zip(elsewhere.index, elsewhere["frames"], elsewhere["inliers"], strict=True)
    )
