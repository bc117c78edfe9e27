"""rulers.png: each ruler's corner residuals in its plane, and where it is detected and reprojected in an image."""

import textwrap
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from groundwalk.alignment.rulers.detection import read_grey
from groundwalk.alignment.rulers.measurement import Reading, camera_of, kind_of
from groundwalk.alignment.rulers.verdict import Judged, describe
from groundwalk.artefacts.tables import poses_of
from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.poses import Array, inverse, transform
from groundwalk.geometry.rulers import RulerFit

_MOST_RULERS = 6
_INCHES = 4.5
_TITLE_WIDTH = 110
# The largest residual is drawn this long, as a share of the ruler's extent.
_LONGEST = 0.08
_MARGIN = 0.25
_DETECTED, _REPROJECTED = "tab:blue", "tab:red"


def draw_rulers(
    path: Path, judged: Sequence[Judged], frames: pd.DataFrame, images: pd.DataFrame, image_path: Callable[[str], Path]
) -> None:
    """One row a ruler: residuals of triangulated corners in its plane, enlarged; the image that sees most corners."""
    shown = judged[:_MOST_RULERS]
    figure = Figure(figsize=(3 * _INCHES, _INCHES * len(shown) + 0.4), layout="constrained")
    axes = figure.subplots(len(shown), 2, squeeze=False, width_ratios=[1.2, 1])
    poses = poses_of(images, "sfm_cam")
    for (plane, picture), one in zip(axes, shown, strict=True):
        plane.set_title(textwrap.fill(describe(one), _TITLE_WIDTH), fontsize=7, loc="left", wrap=True)
        if not one.reading.fits:
            plane.axis("off")
            picture.axis("off")
            continue
        fit = one.reading.fits["all"]
        _draw_residuals(plane, one.reading, fit)
        _draw_image(picture, one.reading, fit, frames, poses, image_path)
    left_out = f"; {len(judged) - len(shown)} more not shown" if len(judged) > len(shown) else ""
    figure.suptitle(f"Rulers{left_out}", fontsize=10)
    figure.savefig(path, dpi=100)


def _draw_residuals(axes: Axes, reading: Reading, fit: RulerFit) -> None:
    """Corners of all parts, each part in its own plane, side by side; arrows show the residual within it."""
    corners = reading.sighting.corners
    known = np.isfinite(fit.xyz).all(axis=1)
    at, arrows, out_mm = [], [], []
    offset = 0.0
    for part in np.unique(corners.part[known]):
        rows = known & (corners.part == part)
        nominal_mm = 1000 * corners.xyz_m[rows]
        turned = fit_sim3(nominal_mm, fit.fitted[rows], line_ok=True)
        residual_mm = turned.points(fit.xyz[rows]) - nominal_mm
        at.append(nominal_mm[:, :2] + [offset, 0.0])
        arrows.append(residual_mm[:, :2])
        out_mm.append(residual_mm[:, 2])
        offset += 1.5 * float(np.ptp(nominal_mm[:, 0]))
    xy, uv, out = np.concatenate(at), np.concatenate(arrows), np.concatenate(out_mm)
    largest = max(float(np.linalg.norm(uv, axis=1).max()), 1e-6)
    gain = _LONGEST * float(np.ptp(xy, axis=0).max()) / largest
    bound = max(float(np.abs(out).max()), 1e-6)
    dots = axes.scatter(xy[:, 0], xy[:, 1], c=out, cmap="coolwarm", vmin=-bound, vmax=bound, s=14)
    axes.quiver(*xy.T, *(gain * uv).T, angles="xy", scale_units="xy", scale=1, width=0.003)
    axes.set_aspect("equal", adjustable="datalim")
    axes.invert_yaxis()
    axes.set_xlabel(f"mm on {kind_of(reading.ruler)}; longest arrow {largest:.2f} mm", fontsize=7)
    axes.tick_params(labelsize=7)
    bar = axes.figure.colorbar(dots, ax=axes, shrink=0.7)
    bar.set_label("out of plane, mm", fontsize=7)
    bar.ax.tick_params(labelsize=7)


def _draw_image(
    axes: Axes,
    reading: Reading,
    fit: RulerFit,
    frames: pd.DataFrame,
    sfm_T_cam: Array,
    image_path: Callable[[str], Path],
) -> None:
    """The image with most of the corners that took part: as detected, and the nominal ruler as reprojected."""
    sighting = reading.sighting
    rows, corner, xy_px = (a[reading.seen] for a in (sighting.row, sighting.corner, sighting.xy_px))
    row = int(np.bincount(rows[fit.inlier]).argmax())
    own = rows == row
    matrix, distortion = camera_of(frames, row)
    in_cam = transform(inverse(sfm_T_cam[row]), fit.fitted[np.unique(corner[own & fit.inlier])])
    reprojected, _ = cv2.projectPoints(in_cam, np.zeros(3), np.zeros(3), matrix, distortion)
    axes.imshow(
        read_grey(image_path(str(frames["image"].iloc[row]))),
        cmap="gray",
        extent=(0, float(frames["width"].iloc[row]), float(frames["height"].iloc[row]), 0),
    )
    axes.plot(
        *xy_px[own].T,
        "o",
        mfc="none",
        ms=5,
        color=_DETECTED,
        label="detected" if sighting.ruler.kind != "distance" else "stated",
    )
    axes.plot(*reprojected.reshape(-1, 2).T, "x", ms=4, color=_REPROJECTED, label="reprojected")
    low, high = xy_px[own].min(axis=0), xy_px[own].max(axis=0)
    margin = _MARGIN * max(float((high - low).max()), 40.0)
    axes.set_xlim(low[0] - margin, high[0] + margin)
    axes.set_ylim(high[1] + margin, low[1] - margin)
    axes.set_title(f"{frames['frame_id'].iloc[row]}", fontsize=7)
    axes.legend(fontsize=7)
    axes.tick_params(labelsize=7)
