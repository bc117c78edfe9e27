"""rulers.png: each ruler's corner residuals in its plane, and where it is detected and reprojected in an image."""

import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from groundwalk.alignment.rulers.measurement import RulerMeasurement, kind_of
from groundwalk.alignment.rulers.scale_check import RulerCheck, describe
from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.poses import Array, inverse, transform
from groundwalk.geometry.rulers import RulerFit
from groundwalk.store.choices import RulerKind, RulerPart
from groundwalk.store.images import read_grey_image
from groundwalk.store.tables import camera_of, poses_of

_MAX_RULERS = 6
_INCHES = 4.5
_TITLE_WIDTH = 110
# The largest residual is drawn this long, as a fraction of the ruler's extent.
_MAX_ARROW = 0.08
_MARGIN = 0.25
_DETECTED, _REPROJECTED = "tab:blue", "tab:red"


def draw_rulers(
    path: Path,
    checks: Sequence[RulerCheck],
    frames: pd.DataFrame,
    images: pd.DataFrame,
    image_path: Callable[[str], Path],
) -> None:
    """One row a ruler: residuals of triangulated corners in its plane, enlarged; the image that sees most corners."""
    rows = min(len(checks), _MAX_RULERS)
    figure = Figure(figsize=(3 * _INCHES, _INCHES * rows + 0.4), layout="constrained")
    axes = figure.subplots(rows, 2, squeeze=False, width_ratios=[1.2, 1])
    poses = poses_of(images, "sfm_cam")
    for (plane, picture), check in zip(axes, checks[:rows], strict=True):
        plane.set_title(textwrap.fill(describe(check), _TITLE_WIDTH), fontsize=7, loc="left", wrap=True)
        if not check.measurement.fits:
            plane.axis("off")
            picture.axis("off")
            continue
        fit = check.measurement.fits[RulerPart.ALL]
        _draw_residuals(plane, check.measurement, fit)
        _draw_image(picture, check.measurement, fit, frames, poses, image_path)
    more = f"; {len(checks) - rows} more without a plot" if len(checks) > rows else ""
    figure.suptitle(f"Rulers{more}", fontsize=10)
    figure.savefig(path, dpi=100)


def _draw_residuals(axes: Axes, measurement: RulerMeasurement, fit: RulerFit) -> None:
    """Corners of all parts, each part in its own plane, side by side; arrows show the residual within it."""
    corners = measurement.detections.corners
    has_fit = np.isfinite(fit.xyz).all(axis=1)
    at, arrows, out_mm = [], [], []
    offset = 0.0
    for part in np.unique(corners.part[has_fit]):
        rows = has_fit & (corners.part == part)
        nominal_mm = 1000 * corners.xyz_m[rows]
        turned = fit_sim3(nominal_mm, fit.fitted[rows], line_ok=True)
        residual_mm = turned.points(fit.xyz[rows]) - nominal_mm
        at.append(nominal_mm[:, :2] + [offset, 0.0])
        arrows.append(residual_mm[:, :2])
        out_mm.append(residual_mm[:, 2])
        offset += 1.5 * float(np.ptp(nominal_mm[:, 0]))
    xy, uv, out = np.concatenate(at), np.concatenate(arrows), np.concatenate(out_mm)
    largest = max(float(np.linalg.norm(uv, axis=1).max()), 1e-6)
    gain = _MAX_ARROW * float(np.ptp(xy, axis=0).max()) / largest
    bound = max(float(np.abs(out).max()), 1e-6)
    dots = axes.scatter(xy[:, 0], xy[:, 1], c=out, cmap="coolwarm", vmin=-bound, vmax=bound, s=14)
    axes.quiver(*xy.T, *(gain * uv).T, angles="xy", scale_units="xy", scale=1, width=0.003)
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_yaxis()
    axes.set_xlabel(f"mm on {kind_of(measurement.ruler)}; longest arrow {largest:.2f} mm", fontsize=7)
    axes.tick_params(labelsize=7)
    bar = axes.figure.colorbar(dots, ax=axes, shrink=0.7)
    bar.set_label("out of plane, mm", fontsize=7)
    bar.ax.tick_params(labelsize=7)


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
    axes.set_title(f"{frames['frame_id'].iloc[row]}", fontsize=7)
    axes.legend(fontsize=7)
    axes.tick_params(labelsize=7)
