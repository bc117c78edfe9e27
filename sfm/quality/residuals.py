"""Patterns in the residuals of an adjusted model, by image radius and by row, and their causes.

A lens that isn't modelled leaves residuals that point away from the principal point or to it, alike in all frames; a
rolling shutter leaves rows of a frame that are shifted together, otherwise in each frame. (A focal length that breathes
is hardly seen so: cameras move to and fro, and what is left depends on the points' depth.)
"""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from groundwalk.geometry.poses import Array
from groundwalk.geometry.rows import summed
from groundwalk.geometry.shutter import readout_fraction
from groundwalk.sfm.cameras.adjustment import Adjusted, Ints, project
from groundwalk.store.choices import ResidualPattern

LENS, SHUTTER = "lens", "rolling shutter or stabilised video"
_CAUSE = {ResidualPattern.RADIUS: LENS, ResidualPattern.ROW: SHUTTER}
_BANDS = 10
_MIN_OBSERVATIONS = 30
# What counts as a pattern: at least so many pixels and so many standard errors.
_PATTERN_PX, _PATTERN_SIGMAS = 0.1, 4.0


def residual_patterns(model_id: str, lens_ids: list[str], adjusted: Adjusted) -> pd.DataFrame:
    """Table sfm.residuals of a model, whose lenses have these names."""
    bundle, cameras = adjusted.bundle, adjusted.cameras
    residual = project(bundle, cameras) - bundle.observed_px
    loss_px = adjusted.loss_px * adjusted.noise_M[:, None]
    residual /= np.sqrt(1 + np.sum(residual**2, axis=1, keepdims=True) / loss_px**2)
    frame = bundle.frame
    offset = (bundle.observed_px - cameras.intrinsics[frame, 2:]) / cameras.focal[frame]
    radius = np.linalg.norm(offset, axis=1)
    outward = np.sum(residual * offset, axis=1) / np.maximum(radius, 1e-9)
    row = np.clip(readout_fraction(cameras.readout_line[frame], bundle.observed_px) + 0.5, 0, 1 - 1e-9)
    rows = []
    for lens, lens_id in enumerate(lens_ids):
        observations = np.flatnonzero(cameras.lens[frame] == lens)
        reach = float(radius[observations].max(initial=1e-9)) * (1 + 1e-9)
        by_radius = _banded(radius[observations] / reach)
        by_row = _banded(row[observations])
        for pattern, extent, band, (value, sd) in (
            (ResidualPattern.RADIUS, reach, by_radius, _means(outward[observations], by_radius)),
            (ResidualPattern.ROW, 1.0, by_row, _of_frames(residual[observations], frame[observations], by_row)),
        ):
            count, span = np.bincount(band, minlength=_BANDS), extent / _BANDS
            for k in np.flatnonzero(count >= _MIN_OBSERVATIONS):
                limits = {"band_from": k * span, "band_to": (k + 1) * span}
                values = {"observations": int(count[k]), "residual_px": value[k], "residual_sd_px": sd[k]}
                rows.append({"model_id": model_id, "lens_id": lens_id, "pattern": pattern} | limits | values)
    return pd.DataFrame(rows)


def pattern_of(residuals: pd.DataFrame) -> tuple[str, float] | None:
    """The cause of a pattern in the residuals of one lens (LENS or SHUTTER), and its size in pixels; None where there
    is no pattern."""
    sizes = residuals["residual_px"].abs()
    clear = residuals[(sizes > _PATTERN_PX) & (sizes > _PATTERN_SIGMAS * residuals["residual_sd_px"])]
    if not len(clear):
        return None
    worst = int(np.argmax(clear["residual_px"].abs().to_numpy()))
    return _CAUSE[clear["pattern"].iloc[worst]], float(clear["residual_px"].abs().iloc[worst])


def draw_residuals(path: Path, residuals: pd.DataFrame) -> None:
    """Plot residuals by radius and by row, a line for each lens of each model."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    panels = {ResidualPattern.RADIUS: "outward, mean (px)", ResidualPattern.ROW: "shared by a frame's rows (px)"}
    for axes, (pattern, label) in zip(figure.subplots(1, 2), panels.items(), strict=True):
        of_pattern = residuals[residuals["pattern"] == pattern]
        for (model, lens), of_lens in of_pattern.groupby(["model_id", "lens_id"], sort=True):
            middle = (of_lens["band_from"] + of_lens["band_to"]) / 2
            axes.errorbar(
                middle, of_lens["residual_px"], of_lens["residual_sd_px"], capsize=2, label=f"{model}: {lens}"
            )
        axes.axhline(0, color="grey", linewidth=0.5)
        axes.set_ylabel(label)
        axes.set_xlabel("radius, focal lengths" if pattern == ResidualPattern.RADIUS else "row, of the image's height")
        low, high = axes.get_ylim()
        axes.set_ylim(min(low, -_PATTERN_PX), max(high, _PATTERN_PX))
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", fontsize=6)
    figure.suptitle("Residuals of the adjusted models", fontsize=10)
    figure.savefig(path, dpi=110)


def _banded(share_M: Array) -> Ints:
    return np.minimum((share_M * _BANDS).astype(np.int64), _BANDS - 1)


def _means(value_M: Array, band_M: Ints) -> tuple[Array, Array]:
    """Mean of each band and its standard error."""
    count = np.maximum(np.bincount(band_M, minlength=_BANDS), 1)
    mean = np.bincount(band_M, value_M, minlength=_BANDS) / count
    square = np.bincount(band_M, (value_M - mean[band_M]) ** 2, minlength=_BANDS) / count
    return mean, np.sqrt(square / count)


def _of_frames(value_M2: Array, frame_M: Ints, band_M: Ints) -> tuple[Array, Array]:
    """How far the observations of a frame in each band are shifted together, beyond what chance shifts them by: root
    mean square over frames and its standard error."""
    frames = int(frame_M.max(initial=0)) + 1
    group, groups = frame_M * _BANDS + band_M, frames * _BANDS
    count = np.bincount(group, minlength=groups)
    total = summed(value_M2, group, groups)
    square = np.bincount(group, np.sum(value_M2**2, axis=1), minlength=groups)
    several = count > 1
    # The products of all pairs of a frame's observations: 0 on average where they have nothing to do with each other.
    pairs = np.where(several, count * (count - 1), 1)
    product = ((np.sum(total**2, axis=1) - square) / pairs).reshape(frames, _BANDS)
    weight = np.where(several, count, 0).reshape(frames, _BANDS).astype(float)
    sums = np.maximum(weight.sum(axis=0), 1)
    mean = (weight * product).sum(axis=0) / sums
    spread = np.sqrt(((weight * (product - mean)) ** 2).sum(axis=0)) / sums
    size = np.sign(mean) * np.sqrt(np.abs(mean))
    return size, spread / (2 * np.maximum(np.abs(size), np.sqrt(np.maximum(spread, 1e-12)) / 2))
