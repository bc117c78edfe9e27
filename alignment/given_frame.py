"""Scale and vertical of a map where neither phones, rulers nor a data set give them: by a survey, by positions on
earth, or, for the vertical, by the straight lines that its images show."""

from collections.abc import Sequence

import cv2
import numpy as np
import pandas as pd

from groundwalk.alignment.components import NOT_GIVEN, GivenFrame, MapScale, PlacedComponent, Vertical
from groundwalk.alignment.control.check import UP, ControlCheck, scale_source
from groundwalk.consistency.decisions import Status
from groundwalk.consistency.scale import UNKNOWN_SCALE_SD
from groundwalk.features.lines import LONG_SIDE, MIN_LINES, planes_of_lines
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array
from groundwalk.geometry.rows import evenly
from groundwalk.geometry.vanishing import up_by_lines
from groundwalk.store import StageRun
from groundwalk.store.choices import ScaleSource, VerticalSource
from groundwalk.store.georeference import Georeference
from groundwalk.store.images import read_grey_image
from groundwalk.store.tables import camera_of, poses_of

_MIN_IMAGES, _MAX_IMAGES = 8, 48
# What the vertical by a building's lines is off by, radians an axis: 0.1 and 0.2 degrees from ARKit's gravity in two
# models of a real corridor.
_LINES_SD = float(np.radians(0.3))


def by_surveys(checks: Sequence[ControlCheck], placed: PlacedComponent) -> GivenFrame:
    """By the first survey that passes its check."""
    for check in checks:
        if check.fit is not None and check.result.status is Status.PASSED:
            up, source = UP.get(check.points.settings.up), scale_source(check.points)
            return _of(check.fit.survey_S_map, check.fit.covariance, placed, up, source, VerticalSource.CONTROL)
    return NOT_GIVEN


def by_gps(found: Georeference, placed: PlacedComponent) -> GivenFrame:
    """By positions that phones state, which a georeference is fitted to."""
    up = np.array([0.0, 0.0, 1.0])
    return _of(found.enu_S_map, found.covariance, placed, up, ScaleSource.GPS, VerticalSource.GPS)


def by_lines(r: StageRun, frames: pd.DataFrame, images: pd.DataFrame, placed: PlacedComponent) -> GivenFrame:
    """The vertical by lines in a model's images, which, of photos and videos without poses, are upright."""
    sfm_T_cam, rows = poses_of(images, "sfm_cam"), placed.component.registered_rows
    if len(rows) < _MIN_IMAGES or any(segment.has_vio.any() for segment in placed.component.segments):
        return NOT_GIVEN
    rows = rows[evenly(len(rows), _MAX_IMAGES)]
    found = []
    for row in rows:
        gray = read_grey_image(r.image_path(frames["image"].iloc[row]))
        scale = LONG_SIDE / max(gray.shape)
        small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        found.append(planes_of_lines(np.asarray(small), camera_of(frames.iloc[row]), sfm_T_cam[row, :3, :3]))
    normals, lengths = (np.concatenate(part) for part in zip(*found, strict=True))
    up = up_by_lines(normals, lengths, sfm_T_cam[rows, :3, :3]) if len(lengths) >= MIN_LINES else None
    return NOT_GIVEN if up is None else GivenFrame(None, Vertical(up, _LINES_SD, {}, VerticalSource.LINES))


def _of(
    world_S_map: Sim3, covariance: Array, placed: PlacedComponent, up: Array | None, scale_by: str, by: VerticalSource
) -> GivenFrame:
    """By a similarity to a world with `up` (3,), and its covariance (7, 7): rotation, translation, log scale. A rigid
    fit of points, whose scale has no variance, gives no scale, nor does one known to less than a third."""
    world_S_sfm = world_S_map @ placed.map_S_sfm
    scale = vertical = None
    scale_sd = float(np.sqrt(covariance[6, 6]))
    if 0 < scale_sd <= UNKNOWN_SCALE_SD:
        scale = MapScale(float(np.log(world_S_sfm.scale)), scale_sd, {}, given_by=scale_by)
    if up is not None:
        across = np.eye(3) - np.outer(up, up)
        sd = float(np.sqrt(np.trace(across @ covariance[:3, :3] @ across) / 2))
        vertical = Vertical(world_S_sfm.rotation.T @ up, sd, {}, by)
    return GivenFrame(scale, vertical)
