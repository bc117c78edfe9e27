"""The report's figures, each from tables alone: the paper's two, and what a reader needs to trust them."""

from dataclasses import dataclass
from itertools import chain, cycle, product
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from groundwalk.geometry.poses import Array
from groundwalk.reports import style
from groundwalk.reports.inputs import SceneInputs
from groundwalk.reports.published import PAPER_METHOD
from groundwalk.reports.statistics import by_walk
from groundwalk.scoring.scores import SUBSETS, median_error
from groundwalk.store.choices import MapUnit
from groundwalk.store.tables import poses_of

_NS = 1e-9


@dataclass(frozen=True)
class NamedFigure:
    """A figure with the name of its files and its caption."""

    name: str
    caption: str
    figure: Figure


def scene_figures(scene: SceneInputs) -> dict[str, list[NamedFigure]]:
    """All figures of a scene, by the section of the page that they belong to."""
    with style.applied():
        figures = {
            "summary": [
                *(trajectories(scene, model) for model in scene.models),
                error_distributions(scene),
                costs(scene),
            ],
            "ground_truth": [sfm_overview(scene), *([drift(scene)] if scene.vio_sessions else [])],
            "training": [learning_curves(scene)] if len(scene.history) else [],
            "fusion": [
                *(timeline(scene, model) for model in scene.models if scene.fuses),
                walks(scene),
                *([sensitivity(scene, scene.sweep)] if scene.sweep is not None else []),
                confidence(scene),
            ],
        }
        for figure in chain.from_iterable(figures.values()):
            # A picture is passed on without its caption.
            style.mark(figure.figure, f"{scene.name}: {scene.marker()}")
    return figures


# --- the paper's two --------------------------------------------------------------------------------------------


def test_session(scene: SceneInputs) -> str:
    """The test session with the most frames with ground truth, of those where something was fused if any: the one that
    is drawn."""
    test = scene.errors[scene.errors["split"] == "test"]
    if scene.fuses:
        test = test[~test["session_id"].isin(scene.unfused_sessions)]
    return str(test.groupby("session_id")["frame_id"].nunique().idxmax())


def trajectories(scene: SceneInputs, model: str) -> NamedFigure:
    """The raw regressor, the fused method, and that which is ahead on held-out frames where it's another one, over one
    test session seen from above."""
    session = test_session(scene)
    truth = scene.ground_truth[scene.ground_truth["session_id"] == session].sort_values("t_ns")
    truth_xy = from_above(poses_of(truth, "map_cam")[:, :3, 3])
    level = _long_side_level(truth_xy)
    truth_xy = truth_xy @ level
    label, ahead = scene.label(model), scene.ahead(model)

    def panel(title: str, poses: pd.DataFrame, column: str, method: str | None = None) -> tuple[str, Array, Array]:
        errors = scene.frame_errors(model, method)
        errors = errors[(errors["session_id"] == session) & (errors["split"] == "test")]
        return title, _positions(errors, poses) @ level, errors[column].to_numpy(float)

    panels = [panel(label, scene.predictions[scene.predictions["model"] == model], "apr_position_m")]
    parts = [f"{label} alone"]
    for method in dict.fromkeys([scene.fused_method, ahead]):
        if method is None or method in scene.raw_methods:
            continue
        title = label + scene.method_labels[method]
        panels.append(panel(title, scene.fused_poses(model, method), "position_m", method))
        rule = "with VIO by the paper's rule" if method == PAPER_METHOD else title
        parts.append(rule + (", ahead on held-out frames" if method == ahead else ""))
    order = ", from left to right" if len(panels) > 1 else ""
    caption = f"{scene.name}, test session {session}, from above{order}: {'; '.join(parts)}. Coloured by "
    caption += "position error; the thin line joins poses in order of time."
    known = np.concatenate([e[np.isfinite(e)] for _, _, e in panels])
    worst = float(np.percentile(known, 95)) if len(known) else 1.0
    low, high = _limits(truth_xy)

    # The figure's height follows the place's shape, within what fits a page.
    shape = (high[1] - low[1]) / (high[0] - low[0])
    figure, axes = style.new_figure(1, len(panels), float(np.clip(6.2 / len(panels) * shape + 0.8, 2.1, 4.6)))
    for ax, (title, xy, error) in zip(axes, panels, strict=True):
        ax.plot(truth_xy[:, 0], truth_xy[:, 1], color=style.GROUND_TRUTH, lw=2.2, label="ground truth")
        ax.plot(xy[:, 0], xy[:, 1], color=style.NEUTRAL, lw=0.7)
        colours: Any = {"c": error, "cmap": style.ERROR_MAP, "vmin": 0, "vmax": worst}
        points = ax.scatter(xy[:, 0], xy[:, 1], s=15, lw=0.4, ec=style.INK, zorder=3, **colours)
        known_xy = xy[np.isfinite(xy).all(axis=1)]
        outside = int(((known_xy < low) | (known_xy > high)).any(axis=1).sum())
        missing = len(xy) - len(known_xy)
        counts = [f"{n} {what}" for n, what in ((outside, "outside the picture"), (missing, "without a pose")) if n]
        ax.set_title(title if not counts else f"{title}\n{', '.join(counts)}", fontsize=8.5)
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), aspect="equal", xticks=[], yticks=[])
        ax.spines[:].set_visible(False)
        _scale_bar(ax, scene.unit)
    axes[0].legend(loc="lower left", borderaxespad=0, fontsize=7.5)
    bar = figure.colorbar(points, ax=axes, aspect=30, extend="max", label=f"position error ({scene.unit.symbol})")
    bar.ax.grid(False)
    return NamedFigure(f"trajectory-{_file(model)}", caption, figure)


def _fused_label(scene: SceneInputs) -> str:
    """What stands behind a model's label for the fused method that is shown; empty where there is none."""
    return scene.method_labels[scene.fused_method] if scene.fused_method else ""


def from_above(xyz_N3: Array) -> Array:
    """Map positions (N, 3), +y up, as picture coordinates (N, 2) seen from above."""
    return np.stack([xyz_N3[:, 0], -xyz_N3[:, 2]], axis=1)


def _positions(errors: pd.DataFrame, poses: pd.DataFrame) -> Array:
    """Picture positions (N, 2) of `poses` in the order of `errors`; NaN where there is none."""
    matched = errors[["frame_id"]].merge(poses.drop_duplicates("frame_id"), on="frame_id", how="left")
    return from_above(poses_of(matched, "map_cam")[:, :3, 3])


def _long_side_level(xy_N2: Array) -> Array:
    """The rotation (2, 2), for rows from the right, that lays the long side of a walk level: a map's heading is
    arbitrary, and a page is wide."""
    known = xy_N2[np.isfinite(xy_N2).all(axis=1)]
    long_side = np.linalg.svd(known - known.mean(axis=0))[2][0]
    x, y = long_side if long_side[0] >= 0 else -long_side
    return np.array([[x, -y], [y, x]])


def _limits(xy_N2: Array) -> tuple[Array, Array]:
    """The picture's lower left and upper right: half again as wide as the walk, which shows how errors spread without
    letting the worst outlier set the scale."""
    low, high = np.nanmin(xy_N2, axis=0), np.nanmax(xy_N2, axis=0)
    margin = 0.25 * max(float((high - low).max()), 0.1)
    return low - margin, high + margin


def _scale_bar(ax: Axes, unit: MapUnit) -> None:
    low, high = ax.get_xlim()
    length = _round_length((high - low) / 5)
    y = ax.get_ylim()[0] + 0.03 * np.ptp(ax.get_ylim())
    ax.plot([high - length, high], [y, y], color=ax.xaxis.label.get_color(), lw=1.5)
    ax.text(high - length / 2, y, f"{length:g} {unit.symbol}", ha="center", va="bottom", fontsize=7.5)


def _round_length(length: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten that isn't longer."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(max(m * power for m in (1, 2, 5) if m * power <= length))


def error_distributions(scene: SceneInputs) -> NamedFigure:
    """How many test frames lie within an error: raw and fused, position and rotation, a row a model."""
    figure, axes = style.new_figure(len(scene.models), 2, 2.1 * len(scene.models) + 0.4)
    quantities = (("position", "m", (0.25, 0.5, 5.0)), ("rotation", "deg", (2.0, 5.0, 10.0)))
    for row, model in enumerate(scene.models):
        errors, alone = (e[e["split"] == "test"] for e in (scene.frame_errors(model), scene.raw_errors(model)))
        answered = errors["position_m"].notna()
        # The paper scores none of the poses of an alignment that its rule doesn't trust any longer.
        paper = scene.fused_method == PAPER_METHOD
        scored = (errors["status"].isin(SUBSETS["rp+opt"]) if paper else answered).to_numpy()
        for ax, (quantity, unit, levels) in zip(axes[2 * row : 2 * row + 2], quantities, strict=True):
            raw = errors[f"apr_{quantity}_{unit}"].to_numpy(float)
            fused = errors[f"{quantity}_{unit}"].to_numpy(float)
            in_time = errors[f"live_{quantity}_{unit}"].to_numpy(float)
            for level in levels if scene.unit is MapUnit.METRE else ():
                ax.axvline(level, color=style.NEUTRAL, lw=0.8, ls=(0, (1, 2)))
            every_raw = alone[f"apr_{quantity}_{unit}"].to_numpy(float)
            _cumulative(ax, every_raw, len(every_raw), style.APR, "-", "alone, all frames")
            if fused_label := _fused_label(scene):
                count, every = int(scored.sum()), f"{fused_label} in time, {scene.all_frames}, missing = failed"
                _cumulative(ax, raw[scored], count, style.APR, "--", f"alone, the frames that {fused_label} answers")
                _cumulative(ax, fused[scored], count, style.FUSED, "--", f"{fused_label}, the frames that it answers")
                _cumulative(ax, in_time, len(in_time), style.FUSED, "-", every)
            ax.set(xscale="log", ylim=(0, 102), title=f"{scene.label(model)}: {quantity}")
            ax.set_xlabel(f"{quantity} error ({scene.unit.symbol if unit == 'm' else '°'})")
            style.log_axis(ax.xaxis)
        axes[2 * row].set_ylabel("frames within (%)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=2, fontsize=7.5)
    caption = f"{scene.name}: share of test frames within an error. Dotted: the high, medium and low accuracy levels."
    return NamedFigure("error-distribution", caption, figure)


def _cumulative(ax: Axes, errors: Array, frames: int, colour: str, dashes: str, label: str) -> None:
    known = np.sort(errors[np.isfinite(errors)])
    if frames and len(known):
        share = 100 * np.arange(1, len(known) + 1) / frames
        # A zero has no place on the logarithmic axis.
        ax.step(np.maximum(known, 1e-3), share, where="post", color=colour, ls=dashes, label=label)


def _small(unit: MapUnit) -> tuple[float, str]:
    """How many of what small errors are drawn in there are to the map's unit: centimetres of metres."""
    return (100.0, "cm") if unit is MapUnit.METRE else (1.0, unit.symbol)


def costs(scene: SceneInputs) -> NamedFigure:
    """What accuracy costs: median position error of every model alone against its bytes and a query's time."""
    figure, axes = style.new_figure(1, 2, 2.4, sharey=True)
    per_unit, small = _small(scene.unit)
    kept = pd.concat([table[["model", "bytes"]] for table in (scene.cards, scene.localisers)])
    size = kept.dropna().drop_duplicates("model").set_index("model")["bytes"]
    for model in scene.models:
        errors = scene.raw_errors(model)
        raw = errors.loc[errors["split"] == "test", "apr_position_m"].to_numpy(float)
        median = median_error(raw)
        mib = float(size.get(model, np.nan)) / 2**20
        for ax, cost in zip(axes, (mib, scene.runtime_ms(model)), strict=True):
            if cost > 0 and np.isfinite([cost, median]).all():
                ax.plot(cost, per_unit * max(median, 1e-5), "o", color=style.APR, ms=5)
                place: Any = {"xytext": (5, 3), "textcoords": "offset points", "fontsize": 7.5}
                ax.annotate(scene.label(model), (cost, per_unit * max(median, 1e-5)), **place)
    for ax, label in zip(axes, ("what a query needs (MiB)", "a query (ms)"), strict=True):
        ax.set(xscale="log", yscale="log", xlabel=label)
        ax.margins(0.25)
        style.log_axis(ax.xaxis)
    style.log_axis(axes[0].yaxis)
    axes[0].set_ylabel(f"median position error ({small})")
    caption = (
        f"{scene.name}: accuracy against bytes and against time, of every model alone over all test frames; a frame "
        "without a pose counts as failed. Times are the clock's, on the machine that made the predictions."
    )
    return NamedFigure("costs", caption, figure)


def walks(scene: SceneInputs) -> NamedFigure:
    """Median position error and share of the finest level, a model alone, by test walk or appearance."""
    by, scores = by_walk(scene)
    groups = list(dict.fromkeys(walk for _, walk in scores))
    figure, axes = style.new_figure(1, 2, 2.4)
    per_unit, small = _small(scene.unit)
    for model, marker in zip(scene.models, cycle("osD^vP"), strict=False):
        of_model = [scores[model, walk] for walk in groups]
        drawn: Any = {"marker": marker, "ms": 4.5, "lw": 1, "color": style.APR, "label": scene.label(model)}
        drawn |= {"ls": "-" if model in set(scene.localisers["model"]) else "--"}
        axes[0].plot(groups, [per_unit * s.median_m for s in of_model], **drawn)
        axes[1].plot(groups, [s.high for s in of_model], **drawn)
    axes[0].set(yscale="log", ylabel=f"median position error ({small})")
    style.log_axis(axes[0].yaxis)
    axes[1].set(ylim=(-3, 103), ylabel="within 0.25 m and 2° (%)")
    for ax in axes:
        ax.margins(x=0.1)
        ax.set_xticks(range(len(groups)), [_short(walk) for walk in groups])
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=4, fontsize=7.5)
    caption = f"{scene.name}: every model alone by {by}, over all test frames; a frame without a pose counts as failed."
    if scene.uncertain_frames:
        caption += f" The right picture leaves out {scene.uncertain_frames} frames of quality class C."
    return NamedFigure("walks", caption, figure)


# --- fusion -----------------------------------------------------------------------------------------------------


def timeline(scene: SceneInputs, model: str) -> NamedFigure:
    """Position error over the drawn test session, raw and in time, with the status below."""
    session = test_session(scene)
    errors = scene.frame_errors(model)
    errors = errors[(errors["session_id"] == session) & (errors["split"] == "test")].sort_values("t_ns")
    label, with_fused = scene.label(model), _fused_label(scene)
    seconds = (errors["t_ns"] - errors["t_ns"].min()).to_numpy() * _NS
    statuses = {
        "reliable": style.APR,
        "optimised": style.FUSED,
        "fused": style.FUSED,
        "aligning": style.VIO,
        "predicted": style.NEUTRAL,
        "none": style.REJECTED,
    }
    figure, (ax, band) = style.new_figure(2, 1, 2.6, sharex=True, height_ratios=[5, 1])
    ax.plot(seconds, errors["apr_position_m"], color=style.APR, marker="o", ms=2.5, lw=0.8, label=label)
    if with_fused:
        fused: Any = {"color": style.FUSED, "marker": "o", "ms": 2.5, "lw": 1.2, "label": label + with_fused}
        ax.plot(seconds, errors["live_position_m"], **fused)
    ax.set(ylabel=f"position error ({scene.unit.symbol})", yscale="log")
    style.log_axis(ax.yaxis)
    ax.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=2, fontsize=7.5)
    for status, colour in statuses.items():
        at = seconds[(errors["live_status"] == status).to_numpy()]
        if len(at):
            band.scatter(at, np.zeros(len(at)), marker="|", s=90, lw=2.2, color=colour, label=status)
    band.set(xlabel="time (s)", yticks=[], ylim=(-1, 1))
    band.grid(False)
    band.spines["left"].set_visible(False)
    band.legend(loc="lower left", bbox_to_anchor=(0, 0.75), ncols=5, fontsize=7.5, handlelength=0.6)
    both = f"{label} and {label}{with_fused}" if with_fused else label
    caption = f"{scene.name}, test session {session}: {both} in time, and what stood behind each pose."
    return NamedFigure(f"timeline-{_file(model)}", caption, figure)


_THRESHOLDS = {"n": "N", "d_th_m": "$d_{th}$ (m)", "o_th_deg": "$o_{th}$ (°)", "gamma": "$\\gamma$"}


def sensitivity(scene: SceneInputs, table: pd.DataFrame) -> NamedFigure:
    """How errors and coverage of the paper's rule move with each of its thresholds, a line style a model."""
    quantities = (
        ("position_mean_m", f"position ({scene.unit.symbol})"),
        ("rotation_mean_deg", "rotation (°)"),
        ("answered_pct", "answered (%)"),
    )
    sweep = table[(table["subset"] == "all") & (table["varied"] != "")]
    sweep = sweep.assign(answered_pct=sweep["frames_pct"] * sweep["coverage_pct"] / 100)
    figure, axes = style.new_figure(len(quantities), len(_THRESHOLDS), 4.2, sharex="col", sharey="row")
    for ax, ((quantity, label), threshold) in zip(axes, product(quantities, _THRESHOLDS), strict=True):
        for model, dashes in zip(scene.models, cycle(("-", "--", ":", "-."))):
            rows = sweep[(sweep["varied"] == threshold) & (sweep["model"] == model)].sort_values(threshold)
            ax.plot(rows[threshold], rows[quantity], color=style.FUSED, ls=dashes, marker="o", ms=2.5, label=model)
        ax.set_ylim(bottom=0)
        if threshold == next(iter(_THRESHOLDS)):
            ax.set_ylabel(label)
        if quantity == quantities[-1][0]:
            ax.set_xlabel(_THRESHOLDS[threshold])
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper left", ncols=4, fontsize=7.5)
    caption = (
        f"{scene.name}: the paper's rule with one threshold changed at a time: mean errors and share of "
        f"{scene.evaluated_splits} frames."
    )
    return NamedFigure("sensitivity", caption, figure)


def confidence(scene: SceneInputs) -> NamedFigure:
    """Mean errors of every method over all evaluated frames in time, with their 95 % intervals over sessions."""
    rows = scene.intervals[scene.intervals["subset"] == "all"]
    rows = rows.assign(offline=rows["method"].isin(scene.offline)).sort_values("offline", kind="stable")
    names = list(dict.fromkeys(zip(rows["model"], rows["method"], strict=True)))
    figure, axes = style.new_figure(1, 2, 0.17 * len(names) + 0.7, sharey=True)
    for ax, (quantity, label) in zip(
        axes, (("position_mean_m", scene.unit.symbol), ("rotation_mean_deg", "°")), strict=True
    ):
        of_quantity = rows[rows["figure"] == quantity].set_index(["model", "method"])
        for y, name in enumerate(names):
            interval: Any = of_quantity.loc[name]
            colour = (
                style.APR
                if name[1] in scene.raw_methods
                else style.NEUTRAL
                if name[1] in scene.offline
                else style.FUSED
            )
            ax.plot([interval["low"], interval["high"]], [y, y], color=colour, lw=1.2)
            ax.plot(interval["value"], y, "o", color=colour, ms=4)
        ax.set(title=f"Mean {quantity.split('_')[0]} error ({label})", xlim=(0, None))
        ax.grid(axis="y", visible=False)
    labels = [f"{model} {method}{' (offline)' if method in scene.offline else ''}" for model, method in names]
    axes[0].set(yticks=range(len(names)), yticklabels=labels)
    axes[0].invert_yaxis()
    sessions, draws = (int(rows[column].max()) for column in ("sessions", "draws"))
    caption = (
        f"{scene.name}: every method over all {scene.evaluated_splits} frames, and 95 % intervals by drawing their "
        f"{sessions} sessions again, which can be done in {draws} ways: with few sessions an interval says little."
    )
    if scene.unfused_sessions and scene.fuses:
        caption += " Methods that fuse are over the sessions with VIO, models alone over all."
    return NamedFigure("intervals", caption, figure)


# --- ground truth -----------------------------------------------------------------------------------------------


def sfm_overview(scene: SceneInputs) -> NamedFigure:
    """Registered frames by session, reprojection errors, and features that see a point."""
    figure, (bars, pixels, features) = style.new_figure(1, 3, 2.2)
    images = scene.images.merge(scene.frames[["frame_id", "session_id", "split"]], on="frame_id")
    sessions = images.groupby("session_id", sort=True)["registered"].agg(["sum", "size"])
    y = np.arange(len(sessions))[::-1]
    bars.barh(y, sessions["size"], color="none", ec=style.REJECTED, lw=0.8, label="frames")
    bars.barh(y, sessions["sum"], color=style.GROUND_TRUTH, label="registered")
    bars.set(title="Registered", xlabel="frames", yticks=y, yticklabels=[_short(s) for s in sessions.index])
    bars.grid(axis="y", visible=False)
    # The bar of a lone session would fill the picture.
    bars.set_ylim(-0.6, max(len(y), 3) - 0.4)
    registered = images[images["registered"]]
    for ax, column, title, label in (
        (pixels, "reprojection_px", "Reprojection error", "mean of a frame (px)"),
        (features, "observations", "Features with a point", "in a frame"),
    ):
        ax.hist(registered[column].dropna(), bins=int(np.clip(len(registered) / 6, 6, 24)), color=style.GROUND_TRUTH)
        ax.set(title=title, xlabel=label)
        ax.yaxis.set_major_locator(MaxNLocator(5, integer=True))
    pixels.set_ylabel("frames")
    share = f"{int(images['registered'].sum())} of {len(images)} frames registered"
    return NamedFigure("sfm", f"{scene.name}: structure from motion, {share}.", figure)


def drift(scene: SceneInputs) -> NamedFigure:
    """VIO against ground truth: relative error over travelled distances, and per second, by session."""
    figure, (ax, seconds) = style.new_figure(1, 2, 2.3)
    rows = scene.drift[scene.drift["definition"] == "distance_position"].sort_values("interval")
    for session_id, of_session in rows.groupby("session_id"):
        if session_id != "all":
            ax.plot(of_session["interval"], of_session["median"], color=style.VIO, lw=0.7, alpha=0.7)
    pooled = rows[rows["session_id"] == "all"]
    ax.plot(pooled["interval"], pooled["median"], color=style.VIO, lw=2, marker="o", ms=4, label="median, all sessions")
    ax.plot(
        pooled["interval"], pooled["p95"], color=style.VIO, lw=1, ls="--", marker="o", ms=3, label="95th percentile"
    )
    ax.set(title="VIO drift over distance", xlabel="travelled (m)", ylabel="position error (%)")
    ax.set_ylim(bottom=0)
    if len(pooled):
        ax.legend(fontsize=7.5)
    else:
        ax.text(0.5, 0.5, "no walk is long enough", transform=ax.transAxes, ha="center")
        ax.set(xticks=[], yticks=[])
    steps = scene.drift[(scene.drift["interval_unit"] == "s") & (scene.drift["definition"] == "relative_position")]
    steps = steps[steps["session_id"] != "all"].sort_values("session_id")
    y = np.arange(len(steps))[::-1]
    seconds.hlines(y, 0, 100 * steps["p95"], color=style.VIO, lw=1)
    seconds.plot(100 * steps["median"], y, "o", color=style.VIO, ms=5)
    seconds.set(title="VIO drift over a second", xlabel="median, and 95th percentile (cm)")
    seconds.margins(y=0.15)
    seconds.set(yticks=y, yticklabels=[_short(s) for s in steps["session_id"]])
    seconds.grid(axis="y", visible=False)
    return NamedFigure("vio-drift", f"{scene.name}: how far VIO moves away from ground truth.", figure)


# --- training ---------------------------------------------------------------------------------------------------


def learning_curves(scene: SceneInputs) -> NamedFigure:
    """Loss on training frames and median errors on held-out ones, an epoch at a time; the selected epoch is marked."""
    figure, axes = style.new_figure(1, 3, 2.3)
    panels = (
        ("train_loss", "Training loss", ""),
        ("val_position_m", "Held-out position", f"median error ({scene.unit.symbol})"),
        ("val_rotation_deg", "Held-out rotation", "median error (°)"),
    )
    dashes = ("-", "--", ":", "-.")
    for index, (model, history) in enumerate(scene.history.groupby("model", sort=False)):
        history = history.sort_values("epoch")
        selected = history[history["selected"]]
        for ax, (column, _, _) in zip(axes, panels, strict=True):
            ax.plot(history["epoch"], history[column], color=style.APR, ls=dashes[index % 4], label=str(model))
            ax.plot(selected["epoch"], selected[column], "o", color=style.APR, ms=5, zorder=3)
    for ax, (_, title, unit) in zip(axes, panels, strict=True):
        ax.set(title=title, xlabel="epoch", ylabel=unit)
        ax.set_xlim(left=0)
        ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    for ax in axes[1:]:
        ax.set_ylim(bottom=0)
    axes[0].legend(fontsize=7.5)
    caption = f"{scene.name}: learning curves on frames of the training walks; dots mark the selected epoch."
    return NamedFigure("learning-curves", caption, figure)


def _short(session_id: str) -> str:
    return session_id if len(session_id) <= 18 else session_id[:8] + "…" + session_id[-8:]


def _file(model: str) -> str:
    return model.lower().replace(" ", "-")
