"""The page's smaller tables: capture, ground truth, models, checks, and how the artefacts came about. Each is None
where there is nothing to show."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from groundwalk.reports.cells import LEVELS, LocaliserErrors, digits_of, number
from groundwalk.reports.grids import EMPTY, Grid, plain_grid
from groundwalk.reports.inputs import SceneInputs
from groundwalk.reports.run_checks import AGREES
from groundwalk.reports.statistics import by_walk
from groundwalk.reports.verdict import Problem, Verdict, usual_drift
from groundwalk.scoring.errors import SURE_CLASSES
from groundwalk.store.choices import MapUnit, Rejected
from groundwalk.store.progress import format_seconds
from groundwalk.store.text import grouped_reasons


def _records(frame: pd.DataFrame) -> list[Any]:
    """The rows as named tuples; pandas' stubs don't know their types."""
    return list(frame.itertuples(index=False))


def _range(values: pd.Series) -> str:
    """The least and the largest of some figures."""
    known = values.dropna()
    return " to ".join(dict.fromkeys(f"{v:.3g}" for v in (known.min(), known.max()))) if len(known) else EMPTY


def overview(scene: SceneInputs, verdict: Verdict, found: list[LocaliserErrors]) -> list[str]:
    """The scene's row of the table that a page of several scenes begins with; `OVERVIEW` names its cells."""
    unit, per = small_unit(scene.unit)
    trusted = verdict.trusted
    share = f"{100 * len(trusted) / max(len(verdict.frames), 1):.0f}" if "align" in scene.stages else EMPTY
    sigma = per * trusted["position_sd"].median()
    d = usual_drift(scene)
    drift = f"{d['median_percent']:.2g} over {d['distance_m']:g} m" if d else EMPTY
    # The one that is nearest to the truth by itself, so that both cells are about the same model.
    alone = [row for row in found if not row.is_structure and not row.is_fused and row.position != EMPTY]
    best = min(alone, key=lambda row: float(row.position), default=None)
    fused = next((row for row in found if best and row.model == best.model and row.is_fused), None)
    errors = [
        f"{row.name.removesuffix(', alone')}: {row.position} {scene.unit.symbol}, {row.rotation}°"
        + f", {row.frames} of {scene.scored_frames} frames" * (row.frames < scene.scored_frames)
        if row
        else EMPTY
        for row in (best, fused)
    ]
    kind, half = "simulated" if scene.simulated else "real", f"{_figure(sigma)} {unit}" if sigma == sigma else EMPTY
    return [kind, str(verdict.state), share, half, drift, *errors]


OVERVIEW = (
    *("captures", "ground truth", "trusted frames (%)", "sigma, median", "VIO drift (%)"),
    *("best regressor, alone", "the same, fused"),
)


def headline(scene: SceneInputs, found: list[LocaliserErrors]) -> Grid | None:
    """What each localiser reaches. Its caption says what stands by each number."""
    heads = (
        f"localiser | median position ({scene.unit.symbol}) | median rotation (°) | high/medium/low (%) | coverage (%)"
    )
    rows = [[r.name, r.position, r.rotation, r.levels, r.coverage, r.interval] for r in found]
    truth = scene.ground_truth[scene.ground_truth["frame_id"].isin(scene.compared["frame_id"])]
    registered = scene.images.loc[scene.images["registered"], "frame_id"]
    sd, joint = truth["position_sd_m"].median(), truth["frame_id"].isin(registered).sum()
    chosen = scene.validation[scene.validation["model"].isin([model for model in scene.models if scene.ahead(model)])]
    how = f" Methods were chosen by {chosen['frames'].max():.0f} frames held out of training." if len(chosen) else ""
    if alone := [scene.label(model) for model in scene.models if scene.ahead(model) in scene.raw_methods]:
        how += f" On these no fusion is ahead of {' and '.join(alone)} alone."
    fused = f"{len(truth)} test frames of sessions in which something is fused, of "
    over = fused * (len(truth) < scene.scored_frames) + f"{scene.scored_frames} test frames with ground truth"
    caption = (
        f"{'Simulated' if scene.simulated else 'Measured'}, over {over} of {scene.test_frames}; coverage is "
        "the share of them that got a pose in time, and one without a pose counts as failed. "
        f"The ground truth's own sigma there is {number(sd, 4)} {scene.unit.symbol} (median): an error of "
        f"that size says nothing. {joint} of these queries took part in the structure from motion that their ground "
        "truth is from, which flatters localisers by structure. 95 %: the median with other walks, by drawing the "
        f"sessions again; with few it says little.{how}"
    )
    key = f"headline-{scene.name}"
    return plain_grid(key, "Localisers", caption, f"{heads} | 95 % of the median position", rows)


def classes(scene: SceneInputs, verdict: Verdict) -> Grid | None:
    """How far the frames of each quality class can be trusted."""
    unit, per = small_unit(scene.unit)
    heads = f"class | frames | share (%) | of these test | position ± ({unit}) | rotation ± (°) | accuracy levels"
    rows = []
    for name, of_class in verdict.frames.groupby("quality"):
        sigmas = [
            f"{_figure(sd.median())} to {_figure(sd.max())}" if sd.notna().any() else EMPTY
            for sd in (per * of_class["position_sd"], of_class["rotation_sd_deg"])
        ]
        counted = "counted" if name in SURE_CLASSES else "left out" if name != "none" else "not scored"
        tested, share = int((of_class["split"] == "test").sum()), 100 * len(of_class) / len(verdict.frames)
        rows.append([name, len(of_class), f"{share:.0f}", tested, *sigmas, counted])
    caption = (
        "Frames by quality class (docs/explanation/ground-truth.md): one sigma of each frame's own pose along its "
        "least certain axis, from the median of the class to its largest. Scale and vertical, which all frames share, "
        "come on top."
    )
    return plain_grid(f"quality-{scene.name}", "Which frames to trust", caption, heads, rows)


def problems(name: str, found: list[Problem]) -> Grid | None:
    """What was refused, left out or is undecided, and what to do."""
    rows = [[p.what, EMPTY if p.count is None else p.count, p.why, p.do or EMPTY] for p in found]
    caption = "What the checks refused, and what would decide or mend it (docs/how-to/failed-check.md)."
    heads = "what | frames | why | what to do"
    return plain_grid(f"problems-{name}", "Refused or undecided", caption, heads, rows, 4)


def true_errors(scene: SceneInputs, verdict: Verdict) -> Grid | None:
    """What the ground truth states of itself beside how wrong it is; None of a real capture."""
    e, figures = verdict.true_errors, scene.manifests.get("align", {}).get("figures", {})
    if e is None:
        return None
    rows = [
        ["position, median (cm)", f"± {_figure(100 * e.position_stated)}", _figure(100 * e.position)],
        ["rotation, median (°)", f"± {_figure(e.rotation_stated_deg)}", _figure(e.rotation_deg)],
        ["positions inside their 95 % bounds (%)", "95", f"{e.position_within:.0f}"],
        ["rotations inside their 95 % bounds (%)", "95", f"{e.rotation_within:.0f}"],
        ["scale (%)", f"± {_figure(100 * figures['scale_sd'])}", _figure(e.scale)],
        ["vertical (°)", f"± {_figure(figures['vertical_sd_deg'])}", _figure(e.vertical_deg)],
    ]
    caption = (
        "Simulated: the ground truth against the poses that the simulator had, which no stage reads, after heading and "
        "origin, which are free, were fitted. Stated: one sigma along a frame's least certain axis, scale and vertical "
        "included. What all frames share is one draw, so all frames may be inside their bounds, or few."
    )
    return plain_grid(f"truth-{scene.name}", "Stated against true", caption, " | stated | true", rows)


def small_unit(unit: MapUnit) -> tuple[str, float]:
    """What small errors are said in, and how many of these the map's unit has."""
    return ("cm", 100.0) if unit is MapUnit.METRE else (unit.symbol, 1.0)


def _figure(value: float) -> str:
    return f"{value:.2g}" if math.isfinite(value) else EMPTY


def sessions(scene: SceneInputs) -> Grid | None:
    """What was captured, and what import made of it."""
    heads = "session | format | device | split | time (s) | path (m) | poses | images | frames | images left out"
    left_out = scene.rejects.loc[scene.rejects["rejected"] == Rejected.IMAGE, "session_id"].value_counts()
    rows = []
    for s in _records(scene.sessions.sort_values("session_id")):
        walked = [f"{v:.{n}f}" if pd.notna(v) else EMPTY for v, n in ((s.duration_s, 0), (s.path_m, 1))]
        numbers = [*walked, s.poses, s.images, s.frames, left_out.get(s.session_id, 0)]
        rows.append([s.session_id, s.format, s.device, s.split, *numbers])
    caption = "As recorded by the phone." if scene.vio_sessions else "As the data set has them."
    return plain_grid(f"sessions-{scene.name}", "Sessions", caption, heads, rows, 4)


def rejects(scene: SceneInputs) -> Grid | None:
    """How many images were left out, by reason; and depth images and other rows."""
    reason = pd.Series(grouped_reasons(list(scene.rejects["reason"])), index=scene.rejects.index, dtype=object)
    kinds = {"recordings": Rejected.RECORDING, "images": Rejected.IMAGE, "depth images": Rejected.DEPTH}
    counts = pd.DataFrame({name: scene.rejects["rejected"] == kind for name, kind in kinds.items()})
    counts["other rows"] = ~counts.any(axis=1)
    rows = [[why, *numbers] for why, *numbers in counts.groupby(reason).sum().itertuples()]
    caption = (
        "What import left out of the captures. A frame whose depth image is left out stays; other rows are poses "
        "without an image, and rows that can't be read. Images that sampling doesn't select aren't counted."
    )
    return plain_grid(f"rejects-{scene.name}", "Left out", caption, " | ".join(["reason", *counts.columns]), rows)


def alignment(scene: SceneInputs) -> Grid | None:
    """How well each session's VIO fits the map."""
    heads = "session | part | ground truth | VIO scale | up (°) | position rms (m) | max (m) | rotation rms (°)"
    fitted = scene.align_sessions[scene.align_sessions["session_id"].isin(scene.vio_sessions)]
    rows = []
    for s in _records(fitted.sort_values(["session_id", "segment"])):
        known = f"{s.with_ground_truth} of {s.frames}"
        fit = ((s.scale, 4), (s.up_error_deg, 2), (s.position_rms_m, 3), (s.position_max_m, 3), (s.rotation_rms_deg, 2))
        rows.append([s.session_id, s.segment, known, *(number(value, digits) for value, digits in fit)])
    caption = "Each session's VIO fitted rigidly to the map: metres of VIO per metre of the map, and what is left."
    return plain_grid(f"alignment-{scene.name}", "VIO against the map", caption, heads, rows, 2)


def control(scene: SceneInputs) -> Grid | None:
    """How far surveyed points are off in the map."""
    heads = "survey | points used | held out | RMS (mm) | expected (mm) | worst (mm) | within 95 % bounds (%)"
    rows = []
    for s in _records(scene.control):
        of_fit = ((1000 * s.rms_m, 1), (1000 * s.expected_rms_m, 1), (1000 * s.worst_m, 1), (100 * s.within_bounds, 0))
        # Without a scale of its own, the map's isn't off by anything.
        scale = f"{100 * s.scale:+.2f} ± {100 * s.scale_sd:.2f}" if s.fit == "se3" else EMPTY
        tilt = f"{s.tilt_deg:.2f} ± {s.tilt_sd_deg:.2f}" if s.tilt_deg == s.tilt_deg else EMPTY
        used = f"{s.used} of {s.points}"
        row = [s.control, used, s.held_out, *(number(value, digits) for value, digits in of_fit)]
        rows.append([*row, scale, tilt, f"{s.status}: {s.reason}" if s.reason else s.status])
    caption = (
        "Surveyed points triangulated by the map's poses; each half is compared by a fit of the other. Expected: by "
        "the standard errors of survey, images, poses, scale and fit. Scale: how much longer the map is than the "
        "survey; tilt: between their verticals. No pose is changed by them."
    )
    return plain_grid(
        f"control-{scene.name}", "Control points", caption, f"{heads} | scale (%) | tilt (°) | status", rows, 1
    )


def users(scene: SceneInputs) -> Grid | None:
    """What a user of each method sees on the test walks; None where nothing is fused."""
    if not scene.fuses:
        return None
    heads = "model | method | first pose (s) | longest outage (s)"
    heads += f" | jitter ({scene.unit.symbol}) | jitter (°) | recovery (s)"
    test = scene.fused_sessions[scene.fused_sessions["split"] == "test"]
    test = test[~test["session_id"].isin(scene.unfused_sessions)]
    rows = []
    for offline in (False, True):
        part = test[test["method"].isin(scene.offline) == offline]
        for key, of_method in part.groupby(["model", "method"], sort=False):
            jitter = [number(float(of_method[c].mean()), 3) for c in ("jitter_m", "jitter_deg")]
            first, outage = (f"{of_method[c].max():.1f}" for c in ("first_fix_s", "longest_outage_s"))
            if of_method["answered"].eq(0).any():
                first, outage = "never", "a whole walk"
            recovery = of_method["recovery_s"].dropna()
            back = EMPTY if recovery.empty else "never" if np.isinf(recovery.max()) else f"{recovery.max():.1f}"
            rows.append([key[0], f"{key[1]} (offline)" if offline else key[1], first, outage, *jitter, back])
    walks = test["session_id"].nunique()
    caption = (
        f"In time, over {walks} test session{'s' if walks > 1 else ''}: the longest time to the first pose and the "
        "longest outage after it; jitter, the motion between consecutive answers that odometry didn't see, a frame, "
        "mean over sessions; and the longest time until answers are as good as usual again after 10 s or more without "
        f"a frame ({EMPTY}: there was no such time)."
    )
    return plain_grid(f"users-{scene.name}", "What a user sees", caption, heads, rows, 2)


def walks(scene: SceneInputs) -> Grid | None:
    """What each model alone is worth on each test walk."""
    heads = f"model | test walk | frames | answered | median ({scene.unit.symbol}) | median (°) | "
    rows = []
    for (model, walk), s in by_walk(scene).items():
        errors = [number(error, digits_of(error)) for error in (s.median_m, s.median_deg)]
        levels = [number(value, 1) for value in (s.high, s.medium, s.low)]
        rows.append([scene.label(model), walk, s.frames, s.answered, *errors, s.certain, *levels])
    caption = (
        "Every model alone, without VIO, over the test frames with ground truth; a frame without a pose counts as "
        "failed. Levels: within 0.25 m and 2°, 0.5 m and 5°, 5 m and 10°, of the frames whose ground truth is of "
        "quality class A or B."
    )
    heads += "frames of class A, B | " + " | ".join(f"{level} (%)" for level in LEVELS)
    return plain_grid(f"walks-{scene.name}", "Errors by test walk", caption, heads, rows, 2)


def drift(scene: SceneInputs) -> Grid | None:
    """All measures of VIO drift, all sessions together."""
    rows = []
    for d in _records(scene.drift[scene.drift["session_id"] == "all"]):
        over = d.interval_unit if math.isnan(d.interval) else f"{d.interval:g} {d.interval_unit}"
        figures = [f"{v:.3g}" for v in (d.mean, d.median, d.rms, d.p95, d.max)]
        rows.append([d.definition, over, d.unit, d.samples, *figures])
    caption = (
        "All sessions together; docs/explanation/ground-truth.md defines each measure. paper_rpe and paper_roe are the "
        "paper's equations 4 and 5."
    )
    heads = "measure | over | unit | samples | mean | median | rms | 95 % | max"
    return plain_grid(f"drift-{scene.name}", "VIO drift", caption, heads, rows, 3)


def consistency(scene: SceneInputs) -> Grid | None:
    """Consistency checks of the ground truth, one line a check."""
    rows = []
    for check, of_check in scene.align_checks.groupby("check", sort=False):
        open_ones = of_check[of_check["status"] != "passed"]
        status = "; ".join(dict.fromkeys(open_ones["status"] + ": " + open_ones["reason"])) or "passed"
        counts = [int((of_check["status"] == name).sum()) for name in ("failed", "undecided")]
        unit = of_check["unit"].iloc[0]
        rows.append([check, status, unit, len(of_check), *counts, _range(of_check["value"]), _range(of_check["limit"])])
    heads = "check | status | unit | checks | failed | undecided | value | limit"
    caption = "What had to hold before ground truth was given out."
    return plain_grid(f"consistency-{scene.name}", "Consistency checks", caption, heads, rows, 3)


def localisers(scene: SceneInputs) -> Grid | None:
    """What each structure localiser keeps, costs and refused."""
    test = scene.predictions[scene.predictions["split"] == "test"]
    rows = []
    for card in _records(scene.localisers):
        said = test[test["model"] == card.model]
        refused = ", ".join(f"{count} {code}" for code, count in said["refusal"].value_counts().items()) or "none"
        answered = said[said["refusal"].isna()]
        figures = [number(float(values.median()), 0) for values in (answered["inliers"], said["cpu_ms"])]
        row = [card.label, card.meaning, f"{card.bytes / 2**20:.2f}", card.points, card.train_frames]
        rows.append([*row, *figures, number(card.build_cpu_seconds, 0), f"{refused} of {len(said)}"])
    heads = "localiser | what it is | MiB | points | training frames | inliers | a query (CPU ms) | built in (CPU s)"
    caption = (
        "Built from the training frames alone; a refused frame counts as failed in all tables. Inliers: the median."
    )
    key = f"localisers-{scene.name}"
    return plain_grid(key, "Structure localisers", caption, f"{heads} | test frames refused", rows, 2)


def checks(findings: pd.DataFrame) -> Grid | None:
    """The findings that don't agree."""
    rows = [
        [f.check, f.table, f.scene, f.subset, f.column, f.expected, f.printed, f.status, f.because]
        for f in _records(findings[findings["status"] != AGREES])
    ]
    heads = "rule | table | scene | subset | column | by the rule | printed | status | why"
    return plain_grid("checks-ours", "What doesn't agree", "Rules: docs/explanation/reports.md.", heads, rows, 9)


def provenance(scene: SceneInputs) -> Grid | None:
    """When, where and how long each stage ran, and with which versions."""
    rows = []
    of_package: dict[str, list[str]] = {}
    for name, m in scene.manifests.items():
        steps = ", ".join(f"{step} {seconds:.0f}" for step, seconds in m["seconds"].items())
        finished = m["finished"].replace("T", " ").removesuffix("+00:00")
        figures = [format_seconds(m["total_seconds"]), f"{m['peak_memory_mib']:.0f}", m["seed"]]
        rows.append([name, finished, m["git_revision"], m["machine"], steps, *figures])
        for package, version in m["versions"].items():
            of_package.setdefault(package, []).append(version)
    versions = ", ".join(f"{package} {' and '.join(dict.fromkeys(v))}" for package, v in of_package.items())
    heads = "stage | finished (UTC) | revision | machine | seconds a step | time | memory (MiB) | seed"
    grid = plain_grid(f"provenance-{scene.name}", "Stages", "As each stage's manifest has it.", heads, rows, 5)
    return grid and replace(grid, notes=(versions,))
