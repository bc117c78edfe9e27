"""The stage's figures, and its lines for the user."""

from collections.abc import Hashable, Iterator
from typing import Any

import numpy as np
import pandas as pd

from groundwalk.sfm.cameras.motion import MAX_GAP_S, UNKNOWN_ANGULAR_SD, Motion
from groundwalk.sfm.mapping.attempts import MIN_CONSISTENT, Attempt
from groundwalk.sfm.model import BuiltModel
from groundwalk.sfm.pairs.matched import are_verified, rows_of, status_of
from groundwalk.sfm.pairs.odometry import Odometry
from groundwalk.sfm.quality.covariance import Covariances
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import StageRun, UserError
from groundwalk.store.choices import AttemptOutcome, PairStatus
from groundwalk.store.hints import setting_of

_MAX_COHERENCE = 4.0
# Focal lengths that are off by a larger fraction are named. Whether they fail is align's to say.
_MAX_FOCAL_ERROR = 0.03
# No phone's sensor takes as long to read its rows, and so many sigmas are clear.
_SENSORS_READOUT_S, _READOUT_SIGMAS = 0.045, 3.0
_MAX_LENSES = 6
_FRAMES_AT_ENDS = 2  # of a session
_CLEAR_SIGMAS = 2.0


def report_attempts(r: StageRun[SfmSettings], attempts: list[Attempt], best: Attempt, frames: int) -> None:
    """What is wrong with the best of the attempts at so many frames; UserError where none has a model."""
    do = (
        "look at the images: neighbours need to overlap by half and to be sharp; a larger "
        f"{setting_of('sfm', 'max_features')} gives more features in hard images, and so may max_image_size"
    )
    if best.model is None:
        found = "".join(f"\n{attempt}" for attempt in attempts)
        raise UserError("no model of the frames", expected=f"some of {frames} frames in one", found=found, do=do)
    if best.outcome is AttemptOutcome.TOO_FEW_REGISTERED:
        limit = setting_of("align", "min_registered_fraction")
        r.say(
            f"only {best.registered} of {frames} frames registered, which align refuses unless {limit} is lower: {do}"
        )
    if best.outcome is AttemptOutcome.INCONSISTENT_WITH_VIO:
        why = f"further attempts wouldn't help: {best.input_fault}; " if best.input_fault else ""
        r.say(
            f"the motion of {best.consistent.sum() / best.registered:.0%} of registered frames is consistent with VIO, "
            f"{MIN_CONSISTENT:.0%} expected; {why}selected: {best}"
        )
    r.figure("attempts", len(attempts))


def report_models(r: StageRun[SfmSettings], best: Attempt, held_out: pd.DataFrame, not_registered: pd.Series) -> None:
    """Figures of the selected attempt, and its lines; `not_registered` (N,) says why frames have no pose."""
    model, selected = best.model, best.selected
    assert model is not None
    figures: dict[str, float | None] = {
        "frames": len(model.registered),
        "registered": best.registered,
        "models": len(selected),
        "pairs": len(best.matched),
        "verified_pairs": int(are_verified(best.matched).sum()),
        "pairs_inconsistent_with_vio": int((status_of(best.matched) == PairStatus.INCONSISTENT_WITH_VIO).sum()),
        "points": len(model.xyz),
        "mean_reprojection_px": model.mean_error_px,
        "held_out_px": _median(held_out.loc[held_out["held_out"], "error_px"]),
        "fitted_px": _median(held_out.loc[~held_out["held_out"], "error_px"]),
    }
    for name, value in figures.items():
        r.figure(name, value)
    where = "one model" if len(selected) == 1 else f"{len(selected)} models without common points"
    r.say(
        f"{best.registered} of {len(model.registered)} frames in {where}, {len(model.xyz)} points, "
        f"{model.mean_error_px:.2f} px mean reprojection error"
    )
    for why, count in not_registered.value_counts().items():
        r.say(f"{count} of {len(not_registered)} frames not registered: {why} (images.parquet, not_registered)")


def report_excluded_pairs(r: StageRun[SfmSettings], matched: pd.DataFrame, vio: Odometry) -> None:
    """A line on the pairs that VIO excludes; and one on those of frames without VIO, whose reference poses say where
    gravity is."""
    status = status_of(matched)
    if count := np.count_nonzero(status == PairStatus.INCONSISTENT_WITH_NEIGHBOURS):
        r.say(
            f"{count} verified pairs excluded, as of look-alike places: in the map that neighbouring images make their "
            f"points are apart (pairs.parquet, status {PairStatus.INCONSISTENT_WITH_NEIGHBOURS})"
        )
    excluded = status == PairStatus.INCONSISTENT_WITH_VIO
    by_vio = vio.posed[rows_of(matched)].any(axis=1)
    for what, rows in (("VIO", excluded & by_vio), ("gravity by the reference poses", excluded & ~by_vio)):
        if rows.any():
            r.say(
                f"{np.count_nonzero(rows)} verified pairs excluded: relative pose inconsistent with {what} "
                f"(pairs.parquet, status {PairStatus.INCONSISTENT_WITH_VIO})"
            )


def report_coherence(r: StageRun[SfmSettings], model: BuiltModel, estimate: Covariances) -> None:
    """Figures of a model's coherence, and a line where it is large."""
    r.figure(f"coherence_rows_{model.folder}", estimate.by_rows)
    r.figure(f"coherence_regions_{model.folder}", estimate.by_region)
    if estimate.by_rows > _MAX_COHERENCE:
        r.say(
            f"model {model.model_id}: residuals are correlated in rows of frames (variance of their sums "
            f"{estimate.by_rows:.0f} times that of independent ones): a rolling shutter, focus or stabilised video "
            "isn't modelled; standard deviations are larger by the root of that"
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


def report_cameras(
    r: StageRun[SfmSettings], lenses: pd.DataFrame, intrinsics: pd.DataFrame, frames: pd.DataFrame
) -> None:
    """A line for each lens, and for each session whose logged focal lengths are likely wrong, or that has none."""
    for number, lens in enumerate(lenses.to_dict("records")):
        if number < _MAX_LENSES:
            readout = _with_sd(1000 * lens["readout_s"], 1000 * lens["readout_sd_s"], ".1f")
            x, y = (_with_sd(lens[f"centre_{axis}"], lens[f"centre_{axis}_sd"], ".1f", "+") for axis in "xy")
            r.say(
                f"lens of {lens['lens_id']}: "
                + "".join(f"{name} {_with_sd(lens[name], lens[f'{name}_sd'], '.4f')}, " for name in ("k1", "k2", "k3"))
                + f"readout {readout} ms ({lens['origin']}), principal point {x}, {y} px from where import has it"
            )
        elif number == _MAX_LENSES:
            r.say(f"{len(lenses) - number} more lenses: lenses.parquet")
        if abs(lens["readout_s"]) - _READOUT_SIGMAS * lens["readout_sd_s"] > _SENSORS_READOUT_S:
            r.say(
                f"lens of {lens['lens_id']}: no sensor takes {1000 * abs(lens['readout_s']):.0f} ms to read its rows "
                "(phones' take up to 35 ms): images of STABILISED VIDEO, which are shifted and turned one by one, look "
                "like this. Capture with stabilisation off"
            )
        for line in _stated_lines(lens, is_held=r.settings.lens == "stated"):
            r.say(f"lens of {lens['lens_id']}: {line}")
    for session in intrinsics.to_dict("records"):
        of_session = frames[frames["session_id"] == session["session_id"]]
        if (of_session["focal_sd"] > 0).any():
            focal_px = session["focal_scale"] * of_session["fx"].median()
            text = _with_sd(focal_px, session["focal_scale_sd"] * focal_px, ".0f")
            r.say(f"session {session['session_id']}: focal length {text} px by the images")
            continue
        error = session["focal_scale"] - 1
        if abs(error) >= _MAX_FOCAL_ERROR:
            # An unknown standard error, NaN, makes nothing likely.
            is_clear = abs(error) - _CLEAR_SIGMAS * session["focal_scale_sd"] >= _MAX_FOCAL_ERROR
            doubt = "are likely" if is_clear else "may be"
            r.say(
                f"session {session['session_id']}: logged focal lengths {doubt} wrong: "
                f"{_with_sd(100 * error, 100 * session['focal_scale_sd'], '.2f', '+')} % by the images, whose focal "
                "length is used. Correct the logged one; or, where it was only a guess, let "
                f"{setting_of('align', 'max_focal_error')} be larger than that: else align refuses the session"
            )


def _stated_lines(lens: dict[Hashable, Any], *, is_held: bool) -> Iterator[str]:
    """What images say against a stated lens and readout time."""
    take, keep = (setting_of("sfm", f'lens = "{source}"') for source in ("auto", "stated"))
    if lens["stated_is_wrong"]:
        do = f"; it's kept, {take} uses theirs" if is_held else f", which is used; {keep} keeps the stated one"
        yield (
            f"the STATED DISTORTION IS LIKELY WRONG (k1 {lens['stated_k1']:.4f}, k2 {lens['stated_k2']:.4f}): median "
            f"error of held-out matches {lens['held_out_stated_px']:.2f} px, {lens['held_out_free_px']:.2f} px with "
            f"the estimated lens{do}"
        )
    elif lens["stated_is_undecided"]:
        yield (
            "the stated distortion is kept: the model shows another one, but held-out matches (median error "
            f"{lens['held_out_stated_px']:.3f} px) don't confirm it. Images from places farther apart would decide; "
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


def _median(values: pd.Series) -> float | None:
    return float(values.median()) if len(values) else None
