"""The batch evaluation of every method on every scene and model, for the stage and for tables from anywhere."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from groundwalk.fusion.definition import FuseSettings
from groundwalk.fusion.evaluation.fuse import Fused, Run, error_rows, fuse_all, pose_rows, signal_rows, stacked
from groundwalk.fusion.evaluation.sessions import session_figures
from groundwalk.fusion.evaluation.summary import figures, intervals, summarise
from groundwalk.fusion.evaluation.sweep import around, sweep
from groundwalk.fusion.files.conventions import refuse_other_conventions, refuse_scalar_first, refuse_unrelated
from groundwalk.fusion.files.walks import Evaluated, Inputs, check, evaluated, true_poses
from groundwalk.fusion.methods import METHODS, method, resolve_options
from groundwalk.fusion.methods.localiser import MethodOptions
from groundwalk.fusion.methods.paper_rule import PaperRuleOptions
from groundwalk.fusion.walk import Walk, known, with_odometry
from groundwalk.store.choices import MapUnit, Split
from groundwalk.store.progress import track
from groundwalk.store.registry import PluginError
from groundwalk.store.tables import gap_warning, map_unit, scale_warning

# By which it is told which method is ahead.
ERRORS = ["position_mean_m", "rotation_mean_deg"]


@dataclass(frozen=True)
class Results:
    """What an evaluation found: its tables by name, the walks behind them, and the counted input rows."""

    fused: list[Fused]
    tables: dict[str, pd.DataFrame]
    counts: Counter[str]
    gates: dict[str, dict[str, float]]
    left_out: list[PluginError]  # methods of other packages that can't be used or failed


def resolved(settings: FuseSettings) -> dict[str, MethodOptions]:
    """The options of each method that is to run and can. UserError where no method can be used."""
    usable = [name for name in dict.fromkeys(settings.methods) if name in METHODS]
    chosen = {name: resolve_options(name, settings.options.get(name)) for name in usable}
    if not chosen:
        method(settings.methods[0])
    return chosen


def evaluate(inputs: list[Inputs], settings: FuseSettings) -> Results:
    """Run each method on each scene's and model's walks. UserError for inputs that can't be evaluated.

    Methods that fuse run on walks with odometry; on the others the predictions stand alone, whatever methods were
    asked for. A method of another package that fails is left out of all results, and the others go on.
    """
    options = resolved(settings)
    fused: list[Fused] = []
    counts: Counter[str] = Counter()
    walks: dict[tuple[str, str], list[Walk]] = {}
    left_out = {name: METHODS.problems[name][0] for name in settings.methods if name not in METHODS}
    cases = [
        (scene, model, joined, number == 0)
        for scene in inputs
        for number, (model, joined) in enumerate(joined_walks(scene, settings.splits))
    ]
    if not all(walk.has_odometry for _, _, joined, _ in cases for walk in joined.walks):
        options = _with_raw(options, settings)
    for scene, model, joined, first in track(cases, "fusing predictions"):
        walks[scene.scene, model] = joined.walks
        counts.update(joined.prediction_counts)
        if first:
            counts.update(joined.frame_counts)
        for name, chosen in options.items():
            if name in left_out:
                continue
            run = Run(name, chosen.json_text, model)
            make = partial(method(name).make, chosen)
            try:
                with METHODS.guard(name):
                    fused += fuse_all(run, with_odometry(joined.walks) if method(name).fuses else joined.walks, make)
            except PluginError as fault:
                left_out[name] = fault
    ran = {f.run.method: options[f.run.method] for f in fused if f.run.method not in left_out}
    validation = validation_rows(held_out_walks(inputs, settings), ran, left_out)
    fused = [f for f in fused if f.run.method not in left_out]
    options = {name: chosen for name, chosen in options.items() if name in {f.run.method for f in fused}}
    if not options:
        raise next(iter(left_out.values()))
    errors = stacked(error_rows(f) for f in fused)
    units = {scene.scene: map_unit(scene.truth) for scene in inputs}
    tables = {
        "poses": stacked(pose_rows(f) for f in fused),
        "errors": errors,
        "signals": stacked(signal_rows(f) for f in fused),
        "summary": summarise(errors).assign(map_unit=lambda rows: rows["scene"].map(units)),
        "intervals": intervals(errors),
        "sessions": pd.DataFrame([session_figures(f) for f in fused]),
        "methods": _method_rows(options),
    }
    rule = next((chosen for chosen in options.values() if isinstance(chosen, PaperRuleOptions)), None)
    if rule is not None:
        tables["sweep"] = sweep({case: on for case, part in walks.items() if (on := with_odometry(part))}, around(rule))
    if len(validation):
        tables["validation"] = validation
    gates = {name: chosen.gates for name, chosen in options.items()}
    return Results(fused, tables, counts, gates, list(left_out.values()))


def _with_raw(options: dict[str, MethodOptions], settings: FuseSettings) -> dict[str, MethodOptions]:
    """The methods with one that doesn't fuse."""
    if not all(METHODS[name].fuses for name in options):
        return options
    raw = next(name for name, entry in METHODS.items() if not entry.fuses)
    return {raw: resolve_options(raw, settings.options.get(raw)), **options}


def _method_rows(options: dict[str, MethodOptions]) -> pd.DataFrame:
    """Table fuse.methods."""
    rows = []
    for name, chosen in options.items():
        told = {field: getattr(METHODS[name], field) for field in ("label", "fuses", "causal", "meaning")}
        rows.append({"method": name, "options": chosen.json_text, **told})
    return pd.DataFrame(rows)


def held_out_walks(inputs: Iterable[Inputs], settings: FuseSettings) -> Iterator[tuple[str, list[Walk]]]:
    """Each model's name and walks with odometry of held-out frames of each scene, where half of them or more have
    ground truth and a prediction and they aren't evaluated anyhow."""
    if Split.VAL in settings.splits:
        return
    for scene in inputs:
        held = scene.frames[scene.frames["split"] == Split.VAL]
        true = known(true_poses(scene.truth.set_index("frame_id").reindex(held["frame_id"])))
        for model, predictions in scene.predictions.groupby("model", sort=False):
            both = true & held["frame_id"].isin(predictions["frame_id"])
            if len(held) and both.mean() >= 0.5:
                walks = evaluated(scene.scene, held, scene.truth, predictions, [Split.VAL]).walks
                if fusible := [walk for walk in with_odometry(walks) if known(walk.map_T_cam).any()]:
                    yield str(model), fusible


def validation_rows(
    held_out: Iterable[tuple[str, list[Walk]]], options: Mapping[str, MethodOptions], left_out: dict[str, PluginError]
) -> pd.DataFrame:
    """Table fuse.validation: the causal methods on each model's walks of held-out frames, a scene each. Those of other
    packages that fail join what is left out."""
    rows: list[dict[str, Any]] = []
    for model, walks in held_out:
        for name, chosen in options.items():
            if not method(name).causal or name in left_out:
                continue
            try:
                with METHODS.guard(name):
                    fused = fuse_all(Run(name, "", model), walks, partial(method(name).make, chosen))
            except PluginError as fault:
                left_out[name] = fault
                continue
            errors = stacked(error_rows(f) for f in fused)
            of_all = figures(errors, "live_", len(errors))
            row = {"method": name, "model": model, "scene": walks[0].scene}
            rows.append(row | {figure: of_all[figure] for figure in ("frames", "coverage_pct", *ERRORS)})
    rows = [row for row in rows if row["method"] not in left_out]
    if not rows:
        return pd.DataFrame()
    table = pd.DataFrame(rows)
    best = {key: ahead_of(of_case) for key, of_case in table.groupby(["scene", "model"])}
    return table.assign(ahead=[best[row["scene"], row["model"]] == row["method"] for row in rows])


def ahead_of(rows: pd.DataFrame) -> str:
    """The method whose mean errors are least: their geometric mean, over the share of frames answered, as a missing
    pose is a failure. rows: methods that have `method`, the mean errors and `coverage_pct`."""
    size = np.sqrt(rows[ERRORS].astype(float).prod(axis=1, skipna=False)) / (rows["coverage_pct"] / 100)
    return str(rows.loc[size.sort_values(kind="stable").index[0], "method"])


def joined_walks(inputs: Inputs, splits: Sequence[str]) -> Iterator[tuple[str, Evaluated]]:
    """Each model's name and walks. UserError for inputs that can't be evaluated."""
    check(inputs)
    for model, predictions in inputs.predictions.groupby("model", sort=False):
        of_model = evaluated(inputs.scene, inputs.frames, inputs.truth, predictions, splits)
        if model not in inputs.made_here:
            fusible = with_odometry(of_model.walks)
            refuse_other_conventions(fusible, inputs.scene)
            refuse_scalar_first(of_model.walks, inputs.scene)
            refuse_unrelated(fusible, inputs.scene)
        yield str(model), of_model


_MEANINGS = {
    "frames_too_uncertain_for_levels": "ground truth of class C, in means and medians alone",
    "predictions_refused": "the localiser's evidence was too thin; they count as failed",
    "predictions_of_another_scene": "the regressor took these frames for another scene's; they count as failed",
    "prediction_covariances_not_positive_definite": "or not 6x6 numbers; these predictions are taken without one",
    "frames_of_unstated_quality": "the accuracy levels leave none of them out",
    "frames_of_walks_without_odometry": "nothing is fused there; predictions stand alone",
}


# What puts every figure in doubt comes before the figures.
_WARNINGS = {
    "frames_without_common_vertical": "frames' odometry or map may not have +y up: methods that need it "
    "(needs_vertical) leave odometry out there",
    "prediction_quaternions_not_of_unit_length": "predictions have quaternions that aren't of unit length; their "
    "direction is taken",
    "predictions_not_finite": "predictions are not finite and count as missing",
    "predictions_outside_the_place": "predictions lie farther from the ground truth's bounding box than the box is "
    "large: of another scene, or in another unit or frame?",
}


def report_lines(results: Results) -> list[str]:
    """The means over all frames, and the input rows that weren't as they should be, a line each."""
    summary = results.tables["summary"]
    lines = [f"warning: {error}" for error in results.left_out]
    units = {scene: MapUnit(unit) for scene, unit in zip(summary["scene"], summary["map_unit"], strict=True)}
    for scene, unit in units.items():
        if warning := scale_warning(unit):
            lines.append(f"warning: {scene}: {warning}; odometry, in metres, takes no part")
    lines += [f"warning: {n} {meaning}" for name, meaning in _WARNINGS.items() if (n := results.counts[name])]
    for name, reasons in results.tables["poses"].groupby("method", sort=False)["reasons"]:
        if warning := gap_warning(reasons):
            lines.append(f"warning: {name}: {warning}")
    for row in summary[(summary["subset"] == "all") & (summary["scored"] == "method")].to_dict("records"):
        position = f"{row['position_mean_m']:.3g} {units[row['scene']].symbol}"
        error = f"{position}, {row['rotation_mean_deg']:.3g} deg" if row["answered"] else "no pose"
        coverage = f"{row['coverage_pct']:.0f} % of {row['total']} frames"
        lines.append(f"{row['scene']} · {row['model']} · {row['method']}: mean error {error} over {coverage}")
    all_frames = summary[summary["subset"] == "all"]
    for scene in all_frames.loc[all_frames["too_uncertain"] == all_frames["frames"], "scene"].unique():
        lines.append(f"{scene}: no accuracy level can be scored, as no frame's ground truth is sure enough (class C)")
    for name, n in results.counts.items():
        if n and name != "frames" and name not in _WARNINGS:
            meaning = f" ({_MEANINGS[name]})" if name in _MEANINGS else ""
            lines.append(f"{name.replace('_', ' ')}: {n}{meaning}")
    return lines
