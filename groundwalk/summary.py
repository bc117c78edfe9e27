"""A run in a few lines for people."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pandas as pd

from groundwalk.store.choices import MapUnit, PoseSource
from groundwalk.store.settings import STAGES
from groundwalk.store.tables import dataset_frames, have_times
from groundwalk.store.text import in_words, printable

Table = Callable[[str, str], pd.DataFrame]


def summary(manifests: dict[str, dict[str, Any]], outdated: dict[str, str], table: Table) -> str:
    """The lines of `Run.summary`, each with its subject in front; `table(stage, name)` gives a run's tables."""
    manifest = next(iter(manifests.values()))
    captures = "SIMULATED captures" if manifest["simulated"] else "real captures"
    rows = [
        ("scene", f"{manifest['scene']['name']}, profile {manifest['profile']}, {captures}"),
        ("stages", ", ".join(_states(manifests, outdated))),
    ]
    usable = {stage for stage in manifests if stage not in outdated}
    if "import" in usable:
        rows += _frames(table("import", "sessions"), dataset_frames(table("import", "frames"))["split"].value_counts())
    if "align" in usable:
        rows += _ground_truth(table("align", "ground_truth"))
    if "fuse" in usable:
        rows += _errors(table("fuse", "summary"), in_words(dict.fromkeys(table("fuse", "errors")["split"])))
    width = max(len(subject) for subject, _ in rows) + 2
    return "\n".join(printable(f"{subject:<{width}}{text}") for subject, text in rows)


def _states(manifests: dict[str, dict[str, Any]], outdated: dict[str, str]) -> Iterator[str]:
    for stage in manifests:
        yield f"{stage} (outdated: {outdated[stage]} was run again since)" if stage in outdated else stage
    expected = manifests[next(iter(manifests))]["scene"].get("stages") or STAGES
    missing = [stage for stage in expected if stage not in manifests]
    if missing:
        yield f"not finished: {', '.join(missing)}"


def _frames(sessions: pd.DataFrame, splits: "pd.Series[int]") -> Iterator[tuple[str, str]]:
    with_vio = sessions[sessions["pose_source"] == PoseSource.VIO]
    text = f"{len(sessions)}"
    if (timed := have_times(sessions)).any():
        text += f", {sessions.loc[timed, 'duration_s'].sum():.0f} s"
    text += f", {with_vio['path_m'].sum():.0f} m of VIO path" if len(with_vio) else ""
    if alone := len(sessions) - len(with_vio):
        text += "; no VIO" + (f" in {alone} of them" if len(with_vio) else ": nothing is fused")
    yield "sessions", text
    counts = ", ".join(f"{splits[split]} {split}" for split in ("train", "val", "test") if split in splits)
    yield "frames", f"{splits.sum()}: {counts}"


def _ground_truth(truth: pd.DataFrame) -> Iterator[tuple[str, str]]:
    classes = truth["quality"].value_counts()
    figures = ", ".join(f"{name} {classes[name]}" for name in ("A", "B", "C") if name in classes)
    with_pose = truth[truth["map_cam_tx"].notna()]
    text = f"{len(with_pose)} of {len(truth)} frames{f' ({figures})' if figures else ''}"
    for what, column in (("scale", "scale_source"), ("vertical", "vertical_source")):
        if names := ", ".join(with_pose[column].dropna().unique()):
            text += f"; {what} {'unknown' if names == 'none' else f'by {names}'}"
    yield "ground truth", text


def _errors(table: pd.DataFrame, splits: str) -> Iterator[tuple[str, str]]:
    """One line a method, model and scene: medians over all frames of the evaluated splits, where a frame without a pose
    is infinitely wrong."""
    several = len(table["scene"].unique()) > 1
    rows: Any = table[(table["subset"] == "all") & (table["scored"] == "method")].itertuples(index=False)
    for row in rows:
        # Tables of older runs say nothing of it.
        unit = MapUnit(row.map_unit).symbol if isinstance(row.map_unit, str) else "m"
        medians = [(float(row.position_median_m), 2, unit), (float(row.rotation_median_deg), 1, "deg")]
        # Below 0.1 as the page has it: a structure localiser is off by millimetres.
        figures = ", ".join(
            "infinite" if np.isnan(value) else f"{value:.{3 if value < 0.1 else digits}f} {of}"
            for value, digits, of in medians
        )
        subject = f"{row.method}, {row.model}" + (f", {row.scene}" if several else "")
        yield subject, f"median {figures}; {row.answered} of {row.frames} {splits} frames have a pose"
