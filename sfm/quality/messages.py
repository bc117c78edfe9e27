"""The stage's figures, and its lines for the user."""

from collections.abc import Hashable, Iterator
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.sfm.cameras.motion import MAX_GAP_S, UNKNOWN_ANGULAR_SD, Motion
from groundwalk.sfm.mapping.attempt_models import AttemptModels
from groundwalk.sfm.mapping.attempts import Attempt
from groundwalk.sfm.mapping.source import HeldOutCheck
from groundwalk.sfm.model import Model
from groundwalk.sfm.pairs.matching import MatchedPairs
from groundwalk.sfm.quality.focal_steps import MAX_FOCAL_ERROR
from groundwalk.sfm.quality.residuals import pattern_of
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import StageRun
from groundwalk.store.choices import PairStatus
from groundwalk.store.hints import setting_of

# No phone's sensor takes as long to read its rows, and so many sigmas are clear.
_SENSORS_READOUT_S, _READOUT_SIGMAS = 0.045, 3.0
_FRAMES_AT_ENDS = 2  # of a session
_CLEAR_SIGMAS = 2.0
# A time offset is worth a line where it is so large and so clear.
_MIN_OFFSET_S, _OFFSET_SIGMAS = 0.002, 3.0


def report_models(
    r: StageRun[SfmSettings],
    made: AttemptModels,
    model: Model,
    not_registered: pd.Series,
    check: HeldOutCheck,
    attempts: list[Attempt],
    best: int,
) -> None:
    """Figures of the selected attempt, and its lines; `not_registered` (N,) says why frames have no pose."""
    selected = made.selected
    registered = int(model.registered.sum())
    inconsistent = int((made.matched.status == PairStatus.INCONSISTENT_WITH_VIO).sum())
    error_px = float(np.linalg.norm(model.residual_px, axis=1).mean())
    figures: dict[str, float | str | None] = {
        "frames": len(model.registered),
        "registered": registered,
        "models": len(selected),
        "largest_model": selected[0].images,
        "attempts": len(attempts),
        "consistent_fraction": attempts[best].consistent / registered,
        "mapper": made.settings.mapper,
        "pairs": len(made.matched.pairs),
        "verified_pairs": int(made.matched.verified.sum()),
        "pairs_inconsistent_with_vio": inconsistent,
        "points": len(model.xyz),
        "mean_track_length": float(model.track_lengths().mean()),
        "mean_reprojection_px": error_px,
        "held_out_px": check.median_px(held_out=True),
        "fitted_px": check.median_px(held_out=False),
    }
    for name, value in figures.items():
        r.figure(name, value)
    where = "one model" if len(selected) == 1 else f"{len(selected)} models without common points"
    r.say(
        f"{registered} of {len(model.registered)} frames in {where}, {len(model.xyz)} points, "
        f"{error_px:.2f} px mean reprojection error"
    )
    for why, count in not_registered.value_counts().items():
        r.say(f"{count} of {len(not_registered)} frames not registered: {why} (images.parquet, not_registered)")


def excluded_pairs(matched: MatchedPairs, has_vio: NDArray[np.bool_]) -> list[str]:
    """A line on the pairs that VIO excludes; and one on those of frames without VIO (N,), whose reference poses say
    where gravity is."""
    excluded = matched.status == PairStatus.INCONSISTENT_WITH_VIO
    by_vio = has_vio[matched.pairs].any(axis=1)
    counts = {"VIO": excluded & by_vio, "gravity by the reference poses": excluded & ~by_vio}
    return [
        f"{np.count_nonzero(rows)} verified pairs excluded: relative pose inconsistent with {what} (pairs.parquet, "
        f"status {PairStatus.INCONSISTENT_WITH_VIO})"
        for what, rows in counts.items()
        if rows.any()
    ]


def report_patterns(r: StageRun[SfmSettings], residuals: pd.DataFrame, plot: str) -> None:
    """A line for each lens of each model whose residuals show a pattern."""
    for (model_id, lens_id), of_lens in residuals.groupby(["model_id", "lens_id"], sort=False):
        if pattern := pattern_of(of_lens):
            r.say(
                f"model {model_id}, lens of {lens_id}: residuals show a {pattern[0]} that isn't modelled "
                f"({pattern[1]:.2f} px, {plot})"
            )


def report_motion(r: StageRun[SfmSettings], frames: pd.DataFrame, motion: Motion) -> None:
    """A line where a session's VIO doesn't say how cameras turned while rows were read out, but for its first and last
    image, before and after which there needn't be any pose."""
    has_vio = frames["vio_cam_tx"].notna().groupby(frames["session_id"]).transform("any")
    count = frames["session_id"][~motion.known & has_vio].value_counts(sort=False)
    r.figure("frames_without_angular_velocity", int(count.sum()))
    count = count[count > _FRAMES_AT_ENDS]
    if len(count):
        r.say(
            f"no VIO poses within {MAX_GAP_S:g} s before and after {count.sum()} of {len(frames)} images ("
            + ", ".join(f"{images} of {session}" for session, images in count.items())
            + f"): their angular velocity, which rolling shutter needs, is taken as 0 ± {UNKNOWN_ANGULAR_SD:g} rad/s, "
            "and their poses are less certain. Log the poses between images, too"
        )


def report_cameras(r: StageRun[SfmSettings], lenses: pd.DataFrame, intrinsics: pd.DataFrame) -> None:
    """A line for each lens, and for each session whose logged focal lengths are likely wrong."""
    for lens in lenses.to_dict("records"):
        r.say(
            f"lens of {lens['lens_id']}: "
            + "".join(f"{name} {_with_sd(lens[name], lens[f'{name}_sd'], '.4f')}, " for name in ("k1", "k2", "k3"))
            + f"readout {_with_sd(1000 * lens['readout_s'], 1000 * lens['readout_sd_s'], '.1f')} ms ({lens['origin']})"
        )
        if abs(lens["readout_s"]) - _READOUT_SIGMAS * lens["readout_sd_s"] > _SENSORS_READOUT_S:
            r.say(
                f"lens of {lens['lens_id']}: no sensor takes {1000 * abs(lens['readout_s']):.0f} ms to read its rows "
                "(phones' take up to 35 ms): images of STABILISED VIDEO, which are shifted and turned one by one, look "
                "like this. Capture with stabilisation off"
            )
        offset_s, sd_s = lens["time_offset_s"], lens["time_offset_sd_s"]
        if lens["time_offset_used"] and abs(offset_s) > max(_MIN_OFFSET_S, _OFFSET_SIGMAS * sd_s):
            r.say(
                f"lens of {lens['lens_id']}: images were taken {1000 * abs(offset_s):.1f} ± {1000 * sd_s:.1f} ms "
                f"{'before' if offset_s > 0 else 'after'} their time stamps, by VIO's rotations"
            )
        for line in _stated_lines(lens, is_held=r.settings.lens == "stated"):
            r.say(f"lens of {lens['lens_id']}: {line}")
    for session in intrinsics.to_dict("records"):
        if session["focal_step_frame_id"] is not None:
            r.say(
                f"session {session['session_id']}: the focal length of the images changes by a factor of "
                f"{session['focal_step']:.3f} at frame {session['focal_step_frame_id']}, the logged one doesn't: "
                "digital zoom or another lens. Log the focal length of each image, or capture again without a change"
            )
        error = session["focal_scale"] - 1
        if abs(error) >= MAX_FOCAL_ERROR:
            doubt = (
                "may be" if abs(error) - _CLEAR_SIGMAS * session["focal_scale_sd"] < MAX_FOCAL_ERROR else "are likely"
            )
            r.say(
                f"session {session['session_id']}: logged focal lengths {doubt} wrong: "
                f"{_with_sd(100 * error, 100 * session['focal_scale_sd'], '.2f', '+')} % by the images, whose focal "
                "length is used. Correct the logged one; or, where it was only a guess, raise "
                f"{setting_of('align', 'max_focal_error')}, by which align refuses the session"
            )


def _stated_lines(lens: dict[Hashable, Any], *, is_held: bool) -> Iterator[str]:
    """What images say against a stated lens and readout time."""
    take, keep = (setting_of("sfm", f'lens = "{source}"') for source in ("auto", "stated"))
    if lens["stated_is_wrong"]:
        do = f"; it's kept, {take} uses theirs" if is_held else f", which is used; {keep} keeps the stated one"
        yield (
            f"the STATED DISTORTION IS LIKELY WRONG (k1 {lens['stated_k1']:.4f}, k2 {lens['stated_k2']:.4f}): median "
            f"error of held-out pairs {lens['held_out_prior_px']:.2f} px, {lens['held_out_px']:.2f} px with the "
            f"estimated lens{do}"
        )
    elif lens["stated_is_undecided"]:
        yield (
            "the stated distortion is kept: pairs of images show another one, but held-out pairs (median error "
            f"{lens['held_out_prior_px']:.3f} px) don't confirm it. Images from places farther apart would decide; "
            f"{keep} takes it as it is"
        )
    if lens["stated_readout_is_wrong"]:
        yield (
            f"the STATED READOUT TIME IS LIKELY WRONG: {1000 * lens['stated_readout_s']:.1f} ms, "
            f"{_with_sd(1000 * lens['readout_s'], 1000 * lens['readout_sd_s'], '.1f')} ms by the images, which is used"
        )


def _with_sd(value: float, sd: float, pattern: str, sign: str = "") -> str:
    """A number and its standard deviation, where that is known."""
    return f"{value:{sign}{pattern}}" + ("" if np.isnan(sd) else f" ± {sd:{pattern}}")
