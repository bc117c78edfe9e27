"""The command `plan`: what runs would take, by what finished runs of this data folder took.

Nothing is guessed: what no finished run has measured is said not to be measured.
"""

from collections import Counter
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import pandas as pd
import pyarrow.parquet as pq
import typer
from rich.table import Table

from groundwalk.campaign import captures_folder, read_scenes
from groundwalk.cli import stage_of
from groundwalk.pipeline import Step, steps
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.store import progress
from groundwalk.store.cli import DataOption, ProfileOption, new_app
from groundwalk.store.cores import machine
from groundwalk.store.errors import UserError
from groundwalk.store.inputs import has_capture_files
from groundwalk.store.runs import Finished, finished_stages
from groundwalk.store.settings import STAGES, DataRoot, resolve_settings
from groundwalk.store.simulated import marker_of
from groundwalk.training.regressors import REGRESSORS

app = new_app("What runs would take.")
_PAPER = "paper"  # the group of the paper's scenes


@dataclass(frozen=True)
class Estimate:
    """What a stage of all scenes would take; None where that isn't measured. `by`: the runs that say it, or what is
    missing."""

    profile: str
    stage: str
    runs: int
    frames: int | None
    by: str
    minutes: float | None = None
    gpu_hours: float | None = None
    disk_gib: float | None = None
    peak_mib: float | None = None


@app.command("plan")
def plan_command(
    table: Annotated[
        Path | None, typer.Argument(help="CSV of scenes, as for `campaign`; the paper's six unless named.")
    ] = None,
    profile: ProfileOption = "paper",
    data: DataOption = Path("data"),
) -> None:
    """Say what runs would take in time, training, disk and memory, by finished runs of the data folder.

    Times and disk grow with frames, training's with epochs, frames and pixels. They are those of one profile and one
    machine: where there are such runs, of the profile that is planned, trained on a GPU, on this machine. What wasn't
    measured is said, and never guessed.
    """
    root = DataRoot(data)
    unlinked: set[str] = set()
    if table is None:
        planned = [(profile, step) for step in steps(root, profile, _PAPER)]
    else:
        planned = []
        for row in read_scenes(table):
            of, scene, linked = row.get("profile", profile), row["scene"], root.captures(row["scene"]).resolve()
            if "captures" in row and captures_folder(table, row, root).resolve() != linked:
                unlinked.add(scene)
            planned += [(of, step) for step in steps(root, of, scene, row.get("until", STAGES[-1]))]
    if not any(finished_stages(root, stage) for stage in STAGES):
        raise UserError(
            "no finished run says what anything takes",
            where=root.root / "runs",
            do="groundwalk run --scene Church --profile demo, for example; then plan again",
        )
    _print(estimates(planned, root, unlinked))


def estimates(planned: Iterable[tuple[str, Step]], data: DataRoot, unlinked: Collection[str] = ()) -> list[Estimate]:
    """What profiles' steps take, a row a profile and stage, in the stages' order. Simulating keeps no times. The scenes
    `unlinked` are to have other captures than the data folder's, of which nothing is known."""
    scenes: dict[tuple[str, str], dict[str, None]] = {}  # in order, each once
    for profile, step in planned:
        if step.command != "simulate" or step.scene not in unlinked:
            scenes.setdefault((profile, step.command), {})[step.scene] = None
    order = ("simulate", *STAGES)
    kinds = sorted(scenes, key=lambda kind: (kind[0], order.index(kind[1])))
    return [_estimate(profile, stage, list(scenes[profile, stage]), data, unlinked) for profile, stage in kinds]


def _estimate(profile: str, stage: str, scenes: list[str], data: DataRoot, unlinked: Collection[str]) -> Estimate:
    counts = {scene: _planned_frames(profile, scene, data, unlinked) for scene in scenes}
    known = [count for count in counts.values() if count is not None]
    total = sum(known) if len(known) == len(counts) else None
    estimate = Estimate(profile, stage, len(scenes), total, "not measured")
    runs = _comparable(profile, [] if stage == "simulate" else finished_stages(data, stage), data)
    if not runs:
        return estimate
    if total is None:
        unknown = ", ".join(scene for scene, count in counts.items() if count is None)
        return replace(estimate, by=f"import first, to count: {unknown}")
    frames, gpu, of = sum(_frames(run, data) for run in runs), _gpu(runs[0]), runs[0].folder.parents[1].name
    seconds: float | None = sum(run.seconds for run in runs) / frames * total
    if stage == "train":
        seconds = _training_seconds(profile, {s: c for s, c in counts.items() if c is not None}, runs, frames, data)
    disk = sum(path.stat().st_size for run in runs for path in run.folder.rglob("*") if path.is_file())
    return replace(
        estimate,
        by=f"{len(runs)} of profile {of}, {frames:,} frames, {runs[0].manifest.get('machine')}{gpu and f', {gpu}'}",
        minutes=None if seconds is None else seconds / 60,
        gpu_hours=None if seconds is None or not gpu else seconds / 3600,
        disk_gib=disk / frames * total / 2**30,
        peak_mib=max(run.mib for run in runs),
    )


def _planned_frames(profile: str, scene: str, data: DataRoot, unlinked: Collection[str]) -> int | None:
    """Frames that a scene, or a group's scenes, will have: those imported with this profile; else those that would be
    simulated; else those imported with another profile. None where none of these is known, or of these captures."""
    if scene in unlinked:
        return None
    config = data.scene(scene)[0]
    if config.is_group:
        counts = [_planned_frames(profile, leaf, data, unlinked) for leaf in data.leaves(config)]
        return None if None in counts else sum(count or 0 for count in counts)
    captures = data.captures(scene)
    imported = [_rows(run.folder) for run in finished_stages(data, "import") if run.folder.parent.name == scene]
    mine = _rows(data.run(profile, scene, "import"))
    if mine or not config.can_simulate or (has_capture_files(captures) and not marker_of(captures)):
        return mine or max(imported, default=None)
    return sum(resolve_settings(SimulateSettings, "simulate", data, profile, scene).images.values())


def _rows(imported: Path) -> int:
    """Frames of a finished import; 0 where there is none."""
    frames = imported / "frames.parquet"
    return pq.read_metadata(frames).num_rows if frames.is_file() else 0


def _frames(run: Finished, data: DataRoot) -> int:
    """Frames of the scenes of a finished run; 0 where their import is gone."""
    read = [source.partition("/") for source in run.manifest.get("inputs", {})]
    scenes = {scene for scene, _, stage in read if stage == "import"} or {run.folder.parent.name}
    return sum(_rows(run.folder.parents[1] / scene / "import") for scene in scenes)


def _cards(run: Finished) -> pd.DataFrame:
    """The models that a finished run has trained."""
    cards = pd.read_parquet(run.folder / "models.parquet")
    return cards[cards["train_seconds"] > 0]


def _gpu(run: Finished) -> str:
    """The GPU that a finished run has trained on; "" for none."""
    if run.folder.name != "train":
        return ""
    devices = (str(device).partition(",")[0] for device in _cards(run)["device"])
    return next((device for device in devices if not device.endswith("CPU")), "")


def _comparable(profile: str, runs: list[Finished], data: DataRoot) -> list[Finished]:
    """Those runs of one profile, machine and GPU that say most of a run of this profile on this machine. One that went
    on from a checkpoint, or from what was there before recordings were added, took longer than its manifest says."""
    whole = [run for run in runs if not (run.manifest.get("resumed") or run.manifest.get("extends"))]
    runs = [run for run in whole if run.seconds and _frames(run, data)]
    kinds = [(run.folder.parents[1].name, str(run.manifest.get("machine")), _gpu(run)) for run in runs]
    counts = Counter(kinds)

    def says(kind: tuple[str, str, str]) -> tuple[bool, bool, bool, int]:
        return kind[0] == profile, bool(kind[2]), kind[1] == machine(), counts[kind]

    best = max(counts, key=says, default=None)
    return [run for run, kind in zip(runs, kinds, strict=True) if kind == best]


def _training_seconds(
    profile: str, counts: dict[str, int], runs: list[Finished], frames: int, data: DataRoot
) -> float | None:
    """Seconds of the stage train of scenes with so many frames each; None where a model of theirs wasn't trained in one
    of the runs. Models train side by side: the slowest counts."""
    cards = pd.concat([_cards(run).assign(frames=_frames(run, data)) for run in runs])
    rest = sum(run.seconds - run.manifest["seconds"].get("train", 0) for run in runs) / frames
    total = 0.0
    for scene, count in counts.items():
        settings = resolve_settings(stage_of("train").settings, "train", data, profile, scene)
        slowest = 0.0
        for model in settings.models:
            if data.scene(scene)[0].is_group and not REGRESSORS.find(model).multi_scene:
                continue
            mine = cards[cards["model"] == model]
            if mine.empty:
                return None
            # A model that sees the whole image sees as many pixels of each in all profiles.
            whole = REGRESSORS.find(model).whole_image_px is not None
            pixels = 1 if whole else settings.crop**2
            work = mine["epochs"] * mine["frames"] * (1 if whole else mine["crop_px"] * mine["width_px"])
            slowest = max(
                slowest, mine["train_seconds"].sum() / work.sum() * settings.regressors[model].epochs * count * pixels
            )
        total += slowest + rest * count
    return total


def _print(rows: list[Estimate]) -> None:
    table = Table(box=None, pad_edge=False)
    for name in ("profile", "stage", "by"):
        table.add_column(name, no_wrap=True)
    for name in ("runs", "frames", "minutes", "GPU hours", "disk GiB", "peak MiB"):
        table.add_column(name, justify="right", no_wrap=True)

    def numbers(minutes: float | None, gpu: float | None, disk: float | None, mib: float | None) -> list[str]:
        formats = ((minutes, ",.1f"), (gpu, ",.2f"), (disk, ",.2f"), (mib, ",.0f"))
        return ["–" if value is None else format(value, form) for value, form in formats]

    notes = list(dict.fromkeys(row.by for row in rows))
    for row in rows:
        figures = numbers(row.minutes, row.gpu_hours, row.disk_gib, row.peak_mib)
        if row.minutes is None:
            figures[1:] = "", "", ""
        elif row.stage != "train":
            figures[1] = ""
        count = "?" if row.frames is None else f"{row.frames:,}"
        table.add_row(row.profile, row.stage, f"({notes.index(row.by) + 1})", str(row.runs), count, *figures)
    measured = [row for row in rows if row.minutes is not None]
    hours = [row.gpu_hours for row in rows if row.stage == "train"]
    gpu_hours = sum(h or 0 for h in hours) if hours and None not in hours else None
    sums = numbers(
        sum(row.minutes or 0 for row in measured) if measured else None,
        gpu_hours,
        sum(row.disk_gib or 0 for row in measured) if measured else None,
        max((row.peak_mib or 0 for row in measured), default=None),
    )
    table.add_row("", "sum", "", "", "", *sums)
    progress.stdout.print(table)
    for number, note in enumerate(notes, start=1):
        progress.stdout.print(f"({number}) {note}")
    if missing := [f"{row.profile}/{row.stage}" for row in rows if row.minutes is None]:
        progress.stdout.print(f"The sums lack {', '.join(missing)}.")
