"""rulers.png: where each ruler is detected and reprojected in an image."""

import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from groundwalk.alignment.rulers.measurement import RulerMeasurement
from groundwalk.alignment.rulers.scale_check import RulerCheck, describe
from groundwalk.geometry.poses import Array, inverse, transform
from groundwalk.geometry.rulers import RulerFit
from groundwalk.store.choices import RulerKind, RulerPart
from groundwalk.store.images import read_grey_image
from groundwalk.store.tables import camera_of, poses_of

_MAX_RULERS = 6
_INCHES = 4.5
_TITLE_WIDTH = 110
_MARGIN = 0.25
_DETECTED, _REPROJECTED = "tab:blue", "tab:red"


def draw_rulers(
    path: Path,
    checks: Sequence[RulerCheck],
    frames: pd.DataFrame,
    images: pd.DataFrame,
    image_path: Callable[[str], Path],
) -> None:
    """One row a ruler: the image that sees most of its corners."""
    rows = min(len(checks), _MAX_RULERS)
    figure = Figure(figsize=(2 * _INCHES, _INCHES * rows + 0.4), layout="constrained")
    axes = figure.subplots(rows, 1, squeeze=False)
    poses = poses_of(images, "sfm_cam")
    for picture, check in zip(axes[:, 0], checks[:rows], strict=True):
        if check.measurement.fits:
            _draw_image(picture, check.measurement, check.measurement.fits[RulerPart.ALL], frames, poses, image_path)
        else:
            picture.axis("off")
        picture.set_title(textwrap.fill(describe(check), _TITLE_WIDTH), fontsize=7, loc="left", wrap=True)
    more = f"; {len(checks) - rows} more without a plot" if len(checks) > rows else ""
    figure.suptitle(f"Rulers{more}", fontsize=10)
    figure.savefig(path, dpi=100)


def _draw_image(
    axes: Axes,
    measurement: RulerMeasurement,
    fit: RulerFit,
    frames: pd.DataFrame,
    sfm_T_cam: Array,
    image_path: Callable[[str], Path],
) -> None:
    """The image with most of the corners that took part: as detected, and the nominal ruler as reprojected."""
    detections = measurement.detections
    observed = (detections.row, detections.corner, detections.xy_px, measurement.cam_T_row)
    rows, corner, xy_px, cam_T_row = (a[measurement.in_model] for a in observed)
    row = int(np.bincount(rows[fit.inlier]).argmax())
    in_image = rows == row
    inlier = in_image & fit.inlier
    in_cam = transform(inverse(sfm_T_cam[row] @ cam_T_row[inlier]), fit.fitted[corner[inlier]])
    reprojected = camera_of(frames.iloc[row]).project(in_cam[:, :2] / in_cam[:, 2:])
    axes.imshow(
        read_grey_image(image_path(str(frames["image"].iloc[row]))),
        cmap="gray",
        extent=(0, float(frames["width"].iloc[row]), float(frames["height"].iloc[row]), 0),
    )
    axes.plot(
        *xy_px[in_image].T,
        "o",
        mfc="none",
        ms=5,
        color=_DETECTED,
        label="stated" if measurement.ruler.kind == RulerKind.DISTANCE else "detected",
    )
    axes.plot(*reprojected.T, "x", ms=4, color=_REPROJECTED, label="reprojected")
    low, high = xy_px[in_image].min(axis=0), xy_px[in_image].max(axis=0)
    margin = _MARGIN * max(float((high - low).max()), 40.0)
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(high[1] + margin, low[1] - margin)
    axes.set_xlabel(f"{frames['frame_id'].iloc[row]}", fontsize=7)
    axes.legend(fontsize=7)
    axes.tick_params(labelsize=7)
