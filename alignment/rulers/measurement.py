"""Where rulers are seen, and what each SfM model says of their size, in the model's own units."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.alignment.quality import sfm_covariances
from groundwalk.alignment.rulers.detection import detect_all, explain_absence, held_out_corners, nominal_corners
from groundwalk.alignment.rulers.settings import AprilTagRuler, CharucoRuler, DistanceRuler, Ruler
from groundwalk.artefacts import UserError
from groundwalk.artefacts.tables import poses_of
from groundwalk.geometry import GeometryError
from groundwalk.geometry.lens import distort, undistort
from groundwalk.geometry.poses import Array
from groundwalk.geometry.rulers import Corners, Observations, RulerFit, measure

Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

# What an observation may be off by at least, pixels in an image axis: detected, and read off by a person.
_DETECTED_SD_PX, _READ_OFF_SD_PX = 0.1, 1.0
# OpenCV takes so many distortion coefficients.
_LENGTHS = (0, 4, 5, 8, 12, 14)
# Where a lens model has no inverse, iterations end elsewhere: such corners are left out.
_UNDISTORTED_PX = 0.05


@dataclass(frozen=True)
class Sighting:
    """A ruler in the images: M observations by row of the frames table, corner, and pixel (M, 2). `held_out` (K,) are
    corners that never set the scale. `absence` says why there is no observation."""

    ruler: Ruler
    corners: Corners
    held_out: Mask
    row: Indices
    corner: Indices
    xy_px: Array
    absence: str = ""


@dataclass(frozen=True)
class Reading:
    """What a model says of a ruler. `seen` (M,) are the sighting's observations in frames of the model, and `fits`, by
    part ("all", and "used" and "held out" of a ruler that is to set the scale), what they measure. `problem` says why
    that decides nothing; `notes` what else is to be known."""

    sighting: Sighting
    model_id: str
    seen: Mask
    fits: dict[str, RulerFit] = field(default_factory=dict)
    problem: str = ""
    notes: tuple[str, ...] = ()

    @property
    def ruler(self) -> Ruler:
        return self.sighting.ruler

    @property
    def frames(self) -> int:
        """Frames of the model that see the ruler."""
        return len(np.unique(self.sighting.row[self.seen]))

    def log_metres(self, part: str = "all") -> float:
        """Logarithm of metres per unit of the model, by this part of the ruler."""
        return -self.fits[part].log_scale

    def sd(self, part: str = "all") -> float:
        """Standard error of that: of the measurement and of the stated size."""
        return float(np.hypot(self.fits[part].sd, 0.01 * self.ruler.length_sd_percent))

    def size_mm(self, metres_per_unit: float, part: str = "all") -> float:
        """The stated size as it measures in a map of this scale."""
        return self.ruler.size_mm * metres_per_unit * float(np.exp(self.fits[part].log_scale))


def find_rulers(rulers: Sequence[Ruler], frames: pd.DataFrame, image_path: Callable[[str], Path]) -> list[Sighting]:
    """Look for rulers in all images of import's table `frames`; distances are where the settings say.

    Raises UserError for an image that can't be read, or a distance's frame that there isn't.
    """
    boards = [ruler for ruler in rulers if not isinstance(ruler, DistanceRuler)]
    paths = [image_path(image) for image in frames["image"]] if boards else []
    detected = detect_all(boards, paths)
    sightings = []
    for ruler in rulers:
        if isinstance(ruler, DistanceRuler):
            sightings.append(_read_off(ruler, frames))
            continue
        index = boards.index(ruler)
        own = [(row, of_all[index]) for row, of_all in enumerate(detected) if len(of_all[index].corner)]
        corners = nominal_corners(ruler)
        sightings.append(
            Sighting(
                ruler,
                corners,
                held_out_corners(ruler, corners),
                np.repeat([row for row, _ in own], [len(d.corner) for _, d in own]).astype(np.int64),
                np.concatenate([np.empty(0, dtype=np.int64), *(d.corner for _, d in own)]),
                np.concatenate([np.empty((0, 2)), *(d.xy for _, d in own)]),
                "" if own else explain_absence(ruler, paths),
            )
        )
    return sightings


def read_rulers(
    sightings: Sequence[Sighting], frames: pd.DataFrame, images: pd.DataFrame, *, least_angle: float, largest_sd: float
) -> list[Reading]:
    """Each ruler in each model that has frames of it; one without a model where none has.

    `frames` is import's table with SfM's focal lengths, `images` SfM's in its order. Views less than `least_angle`
    (radians) apart, or a standard error above `largest_sd`, decide nothing.
    """
    readings = []
    poses, covariance = poses_of(images, "sfm_cam"), sfm_covariances(images["covariance"])
    registered, model_id = images["registered"].to_numpy(bool), images["model_id"].to_numpy(object)
    for sighting in sightings:
        models = pd.unique(model_id[sighting.row[registered[sighting.row]]])
        if not len(models):
            problem = sighting.absence or "seen in frames only that SfM didn't register"
            readings.append(Reading(sighting, "", np.zeros(len(sighting.row), dtype=bool), problem=problem))
            continue
        xy, focal_px = undistorted(frames, sighting.row, sighting.xy_px)
        for model in models:
            seen = registered[sighting.row] & (model_id[sighting.row] == model) & np.isfinite(xy).all(axis=1)
            observations = Observations(sighting.corner, sighting.row, xy, focal_px)
            readings.append(
                _read(
                    Reading(sighting, str(model), seen),
                    observations,
                    poses,
                    covariance,
                    frames,
                    least_angle,
                    largest_sd,
                )
            )
    return readings


def undistorted(frames: pd.DataFrame, rows: Indices, xy_px: Array) -> tuple[Array, Array]:
    """Normalised image coordinates (M, 2) without distortion, of pixels (M, 2) in these rows of `frames`, and the focal
    length (M,) there. NaN where a frame's lens model can't be inverted."""
    xy, focal_px = np.full((len(rows), 2), np.nan), np.empty(len(rows))
    for row in np.unique(rows):
        own = rows == row
        matrix, distortion = camera_of(frames, int(row))
        focal_px[own] = np.sqrt(matrix[0, 0] * matrix[1, 1])
        distorted = (xy_px[own] - matrix[:2, 2]) / matrix.diagonal()[:2]
        ideal = undistort(distorted, distortion)
        good = np.linalg.norm(distort(ideal, distortion) - distorted, axis=1) * focal_px[own] < _UNDISTORTED_PX
        xy[own] = np.where(good[:, None], ideal, np.nan)
    return xy, focal_px


def camera_of(frames: pd.DataFrame, row: int) -> tuple[Array, Array]:
    """OpenCV's camera matrix (3, 3) and distortion of a frame, for pixels whose first centre is (0.5, 0.5)."""
    fx, fy, cx, cy = frames[["fx", "fy", "cx", "cy"]].iloc[row].to_numpy(float)
    coefficients = [float(k) for k in frames["distortion"].iloc[row]]
    length = next(n for n in _LENGTHS if n >= len(coefficients))
    padded = np.array(coefficients + [0.0] * (length - len(coefficients)))
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), padded


def _read_off(ruler: DistanceRuler, frames: pd.DataFrame) -> Sighting:
    row_of = {frame_id: row for row, frame_id in enumerate(frames["frame_id"])}
    rows, corner, xy = [], [], []
    for index, point in enumerate(ruler.points):
        for seen in point.observations:
            if seen.frame not in row_of:
                raise UserError(
                    f"ruler {ruler.name!r}: point {point.name!r} is seen in a frame that there isn't",
                    where="[[ruler]] of the scene's file",
                    found=seen.frame,
                    expected=f"a frame_id of import.frames, such as {frames['frame_id'].iloc[0]}",
                    do="name a frame that import kept; sampling leaves images out",
                )
            rows.append(row_of[seen.frame])
            corner.append(index)
            xy.append(seen.xy)
    corners = Corners(np.array([[0.0, 0.0, 0.0], [ruler.length_m, 0.0, 0.0]]), np.zeros(2, dtype=np.int64))
    return Sighting(
        ruler, corners, np.zeros(2, dtype=bool), np.array(rows), np.array(corner), np.array(xy, dtype=float)
    )


def _read(
    reading: Reading,
    observations: Observations,
    poses: Array,
    covariance: Array,
    frames: pd.DataFrame,
    least_angle: float,
    largest_sd: float,
) -> Reading:
    sighting, seen = reading.sighting, reading.seen
    parts = {"all": seen}
    if sighting.ruler.use_for_scale:
        held_out = sighting.held_out[sighting.corner]
        parts |= {"used": seen & ~held_out, "held out": seen & held_out}
    read_off = isinstance(sighting.ruler, DistanceRuler)
    fits: dict[str, RulerFit] = {}
    for part, chosen in parts.items():
        try:
            fits[part] = measure(
                sighting.corners,
                observations.where(chosen),
                poses,
                covariance,
                min_pixel_sd=_READ_OFF_SD_PX if read_off else _DETECTED_SD_PX,
            )
        except GeometryError:
            continue
    if "all" not in fits or (sighting.ruler.use_for_scale and "used" not in fits):
        return Reading(sighting, reading.model_id, seen, {}, _too_few(reading, frames))
    result = Reading(sighting, reading.model_id, seen, fits, "", _notes(reading, fits["all"], frames))
    return Reading(sighting, result.model_id, seen, fits, _weakness(result, least_angle, largest_sd), result.notes)


def _too_few(reading: Reading, frames: pd.DataFrame) -> str:
    ids = frames["frame_id"].to_numpy(str)[np.unique(reading.sighting.row[reading.seen])]
    shown = ", ".join(ids[:3]) + (", ..." if len(ids) > 3 else "")
    what = "its points" if isinstance(reading.ruler, DistanceRuler) else "its corners"
    return f"seen in {len(ids)} frame{'s' * (len(ids) != 1)} ({shown}); two of {what} must be seen in 2 or more frames"


def _weakness(reading: Reading, least_angle: float, largest_sd: float) -> str:
    """Why a measurement decides nothing; empty where it does."""
    fit = reading.fits["used" if "used" in reading.fits else "all"]
    if fit.angle < least_angle:
        return (
            f"seen from {np.degrees(fit.angle):.1f} degrees apart only, at least {np.degrees(least_angle):.1f} are "
            "needed; walk around it"
        )
    if fit.sd > largest_sd:
        return (
            f"its scale has a standard error of {fit.sd:.2%}, at most {largest_sd:.2%} decides; take more views of it"
        )
    return ""


def _notes(reading: Reading, fit: RulerFit, frames: pd.DataFrame) -> tuple[str, ...]:
    """Sessions whose frames see the ruler elsewhere than the others do."""
    rows = reading.sighting.row[reading.seen]
    table = pd.DataFrame(
        {"session": frames["session_id"].to_numpy(str)[rows], "row": rows, "inlier": fit.inlier}
    ).groupby("session")
    found = table.agg(frames=("row", "nunique"), share=("inlier", "mean"))
    found = found[(found["frames"] >= 2) & (found["share"] < 0.5)]
    return tuple(
        f"{1 - share:.0%} of its observations in {count} frames of {session} are outliers: was it moved there?"
        for session, count, share in zip(found.index, found["frames"], found["share"], strict=True)
    )


def kind_of(ruler: Ruler) -> str:
    """What the ruler is, in a few words."""
    if isinstance(ruler, CharucoRuler):
        return f"ChArUco board, {ruler.squares_x} x {ruler.squares_y} squares of {ruler.square_mm:g} mm"
    if isinstance(ruler, AprilTagRuler):
        return f"AprilTags of {ruler.tag_mm:g} mm"
    return f"distance of {ruler.length_m:g} m"
