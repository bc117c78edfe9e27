"""Every fusion method on the same walks: `python -m benchmarks.fusion`, or `make bench-fusion`.

Prints Markdown tables and writes them, with all figures as JSON, to a folder. The walks:

- *simulated*: walks through the six scenes, odometry with drift as fitted to real recordings (simulation/vio.py);
- *recorded*: real odometry. It has no ground truth, so the true walk is made: the recorded motion with a drift of the
  fitted size applied. Motion, noise and jumps are real, the drift's size is fitted, its course is made up;
- *measured*: real odometry beside motion capture, two walks of 20 m in one room;
- *trained*: test walks of the pipeline's runs, predicted by trained models;
- then simulated walks whose odometry is spoilt in one way each, and a phone that is carried on for a minute unseen.

But for *trained*, predictions are simulated: as wrong as the published PN and MS-T are in each of the six scenes
(benchmarks/regressor_errors/model.py). Nothing here measures a phone or a regressor.

What `drift_aware` and `smoother` learn from beforehand are predictions of the same regressor for held-out frames of
training walks, a tenth of each as import holds them out.
"""

import json
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
import typer

from benchmarks import fusion_inputs as inputs
from benchmarks import fusion_scores as scores
from benchmarks.fusion_inputs import Case
from benchmarks.fusion_scores import OURS, RAW, RULE, Target, Variant
from benchmarks.regressor_errors.fit import REGRESSORS
from groundwalk.fusion.evaluation.evaluate import FuseSettings, resolved
from groundwalk.fusion.evaluation.leaderboard_report import markdown
from groundwalk.fusion.evaluation.sweep import grid, sweep
from groundwalk.fusion.methods import method
from groundwalk.fusion.methods.decide import RuleWalk
from groundwalk.fusion.methods.mobilearloc import MobileARLocOptions
from groundwalk.fusion.methods.offline import stepped
from groundwalk.fusion.walk import Walk
from groundwalk.geometry.poses import Array
from groundwalk.simulation.scenes import NAMES
from groundwalk.store import DataRoot, UserError
from groundwalk.store.cli import SetOption, new_app
from groundwalk.store.progress import track
from groundwalk.store.settings import SHIPPED_DATA, resolve_settings

KINDS = (inputs.SIMULATED, inputs.RECORDED, inputs.MEASURED, inputs.TRAINED, *inputs.BAD_ODOMETRY, inputs.KIDNAPPED)
_COMPARED = (inputs.SIMULATED, inputs.RECORDED, inputs.TRAINED)
# A step of these takes milliseconds; with bad odometry, which is about ours and the raw regressor, they are left out.
_SLOW = ("window30", "pose_graph", "smoother")
_EVERY_METHOD = (inputs.SIMULATED, inputs.RECORDED, inputs.MEASURED, inputs.TRAINED)
_RECORDINGS_EACH = 3
_RECORDED_DRAWS = 3  # of the regressors' errors on recorded walks: of one, a single unlucky walk decides the average
_REPEATS = 5  # runs of a walk whose least times are taken
_PHONE_FRAME_MS = 76.0  # published: inference and the rest of a frame on the phone

STEP_MEDIAN, STEP_P99 = f"{OURS}: median step, ms", f"{OURS}: 99th percentile of a step, ms"
BATCH = "the rule over whole walks, frames a second"


# ---------------------------------------------------------------- speed


@dataclass(frozen=True)
class StepTimes:
    """Milliseconds of each step of a method over some walks. Other work on the machine interrupts one run here and
    another there, so `least_ms` (N,) is the least that each step took in several runs: what the step itself needs.
    `went_ms` is how all of them went; `processor_ms` the processor time of all of them, a step."""

    least_ms: Array
    went_ms: Array
    processor_ms: float


def step_times(variant: Variant, cases: Sequence[Case]) -> StepTimes:
    """The same walks again and again, on one core."""
    runs, processor_ns = [], 0
    for _ in range(_REPEATS):
        spent: list[int] = []
        for walk, error_map in ((w, m) for c in cases for w, m in zip(c.walks, c.error_maps, strict=True)):
            localiser: Any = method(variant.method).localiser(variant.options, error_map)

            def timed(
                *frame: Any, step: Callable[..., Any] = localiser.step, note: Callable[[int], None] = spent.append
            ) -> Any:
                start = time.perf_counter_ns()
                estimate = step(*frame)
                note(time.perf_counter_ns() - start)
                return estimate

            localiser.step = timed
            start = time.thread_time_ns()
            stepped(localiser, walk)
            processor_ns += time.thread_time_ns() - start
        runs.append(spent)
    went_ms = np.array(runs) * 1e-6
    return StepTimes(went_ms.min(axis=0), went_ms.ravel(), processor_ns * 1e-6 / went_ms.size)


def frames_per_second(walks: Sequence[Walk]) -> tuple[float, float]:
    """The paper's rule over whole walks on one core, everything counted in: by the least time that each walk took in
    several runs, and as all of them went."""
    seconds = np.empty((4 * _REPEATS, len(walks)))
    for run, number in np.ndindex(seconds.shape):
        start = time.perf_counter()
        RuleWalk(walks[number]).decide(MobileARLocOptions())
        seconds[run, number] = time.perf_counter() - start
    frames = sum(len(w) for w in walks)
    return frames / float(seconds.min(axis=0).sum()), frames * len(seconds) / float(seconds.sum())


def sweep_seconds(scenes: Sequence[str], processes: int) -> tuple[float, int]:
    """Wall time of a full grid of the rule's thresholds over one draw of each scene's test walks, predicted by PN, and
    the number of settings."""
    walks = {(s, "PN"): inputs.simulated_case(inputs.SIMULATED, s, "PN", [0]).walks for s in scenes}
    settings = grid(MobileARLocOptions())
    start = time.perf_counter()
    sweep(walks, settings, processes)
    return time.perf_counter() - start, len(settings)


def step_table(methods: Sequence[Variant], cases: Sequence[Case]) -> pd.DataFrame:
    """Step times of the causal methods."""
    rows = []
    for variant in methods:
        if method(variant.method).causal:
            times = step_times(variant, cases)
            least, went = (np.percentile(ms, [50, 99]) for ms in (times.least_ms, times.went_ms))
            rows.append(
                {
                    "method": variant.label,
                    "median ms": least[0],
                    "99 % ms": least[1],
                    "median, % of a frame": 100 * least[0] / _PHONE_FRAME_MS,
                    "processor ms": times.processor_ms,
                    "median ms as it went": went[0],
                    "99 % ms as it went": went[1],
                }
            )
    return pd.DataFrame(rows).set_index("method")


# ---------------------------------------------------------------- running


@dataclass(frozen=True)
class Task:
    """One worker's job: build a case and run methods on it."""

    build: Callable[[], Case]
    methods: Sequence[Variant]


def run(task: Task) -> tuple[pd.DataFrame, pd.DataFrame]:
    return scores.score(task.build(), task.methods)


def _all(tasks: Sequence[Task], processes: int) -> Iterator[tuple[pd.DataFrame, pd.DataFrame]]:
    if processes == 1:
        yield from map(run, tasks)
        return
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        yield from pool.imap_unordered(run, tasks)


def _as_it_is(case: Case) -> Case:
    return case


@dataclass(frozen=True)
class Plan:
    """What is to be run: kinds of walks, scenes, draws of the simulated ones, methods,"""

    kinds: Sequence[str]
    scenes: Sequence[str]
    seeds: int
    methods: Sequence[Variant]
    recordings: Path
    data: DataRoot

    def tasks(self) -> Iterator[Task]:
        pairs = [(s, m) for s in self.scenes for m in REGRESSORS]
        for kind in self.kinds:
            methods = [v for v in self.methods if v.method not in _SLOW or kind in _EVERY_METHOD]
            if kind == inputs.TRAINED:
                builds = [partial(_as_it_is, case) for case in inputs.trained_cases(self.data)]
            elif kind in (inputs.RECORDED, inputs.MEASURED):
                real = inputs.recorded_tracks if kind == inputs.RECORDED else inputs.measured_tracks
                tracks = real(self.recordings)
                # Each pair gets some of the recordings, and each recording several pairs.
                count = min(_RECORDINGS_EACH, len(tracks))
                some = [[tracks[(i + 3 * k) % len(tracks)] for k in range(count)] for i in range(len(pairs))]
                seeds = range(_RECORDED_DRAWS if kind == inputs.RECORDED else 1)
                builds = [
                    partial(inputs.recorded_case, kind, t, *pair, seeds) for t, pair in zip(some, pairs, strict=True)
                ]
            else:
                seeds = range(self.seeds if kind == inputs.SIMULATED else 1)
                builds = [partial(inputs.simulated_case, kind, *pair, seeds) for pair in pairs]
            yield from (Task(build, methods) for build in builds)


# ---------------------------------------------------------------- report


def report(
    plan: Plan,
    summary: pd.DataFrame,
    sessions: pd.DataFrame,
    steps: pd.DataFrame,
    speed: Sequence[Target],
    went: Sequence[str] = (),
) -> str:
    """The tables of a run in Markdown."""
    kinds = [k for k in plan.kinds if (summary["kind"] == k).any()]
    compared = [k for k in kinds if k in _COMPARED]
    guarded = [k for k in kinds if k != inputs.KIDNAPPED]
    targets = [*scores.accuracy_targets(summary, compared), *scores.guard_targets(summary, guarded), *speed]
    parts = ["# Fusion methods on the same walks", "## Targets", markdown(scores.target_table(targets))]
    for kind in kinds:
        if kind not in inputs.BAD_ODOMETRY:
            parts += [
                f"## {kind.capitalize()}: means over scenes and regressors",
                markdown(scores.overview(summary, kind)),
            ]
    for kind in compared:
        what = f"## {kind.capitalize()}: means over the rule's, with 95 % intervals by bootstrap over walks"
        parts += [what, markdown(scores.ratio_intervals(sessions, kind))]
    parts += ["## Worst scene, as a ratio to the raw regressor's error", markdown(scores.worst(summary, guarded))]
    if inputs.KIDNAPPED in kinds:
        parts += [
            "## Back after a minute unseen",
            markdown(scores.recovery_table(sessions[sessions["kind"] == inputs.KIDNAPPED])),
        ]
    if inputs.SIMULATED in kinds:
        parts += [
            "## What a user sees, simulated",
            markdown(scores.user_table(sessions[sessions["kind"] == inputs.SIMULATED])),
        ]
        beside = scores.beside_published(summary)
        parts += ["## Simulated walks beside the published tables", markdown(scores.differences(beside))]
        parts += ["### Cell by cell", markdown(beside)]
    parts += ["## One step on one core", _STEPS_MEAN, markdown(steps)]
    if went:
        parts.append("As they went, other work on the machine counted in: " + "; ".join(went) + ".")
    return "\n\n".join(parts)


_STEPS_MEAN = (
    f"Each step's least time of {_REPEATS} runs, in which other work on the machine hardly counts; the processor time "
    "of all runs, a step; and times as they went."
)

app = new_app(__doc__ or "")


def _refuse_unknown(names: Iterable[str], known: Iterable[str]) -> None:
    if unknown := set(names) - set(known):
        raise UserError(f"unknown: {', '.join(sorted(unknown))}", expected=", ".join(known))


@app.command()
def main(
    recordings: Annotated[Path, typer.Option(help="Folder of real odometry: docs/explanation/vio-drift.md.")] = Path(
        "../shared/trajectories"
    ),
    data: Annotated[Path, typer.Option(help="The data folder, whose runs have trained models.")] = Path("data"),
    out: Annotated[Path, typer.Option(help="Folder for benchmark.md and benchmark.json.")] = Path("build/fusion"),
    kinds: Annotated[str, typer.Option(help=f"Kinds of walks, of: {', '.join(KINDS)}.")] = ",".join(KINDS),
    scenes: Annotated[str, typer.Option(help="Scenes, joined by commas.")] = ",".join(NAMES),
    seeds: Annotated[int, typer.Option(min=1, help="Draws of the simulated walks' errors.")] = 1,
    processes: Annotated[int, typer.Option(min=1, help="Worker processes.")] = os.cpu_count() or 1,
    quick: Annotated[bool, typer.Option("--quick", help="Raw, rule and ours on one draw of simulated walks.")] = False,
    set_: SetOption = None,
) -> None:
    """Run it and print the tables. `--set` takes the fuse stage's settings: `options.drift_aware.keyframes=32`."""
    settings = resolve_settings(FuseSettings, "fuse", DataRoot(SHIPPED_DATA), "demo", "benchmark", set_ or [])
    chosen = [k.strip() for k in kinds.split(",")]
    _refuse_unknown(chosen, KINDS)
    _refuse_unknown(scenes.split(","), NAMES)
    if quick:
        settings = settings.model_copy(update={"methods": [RAW, RULE, OURS]})
        chosen = [k for k in chosen if k in (inputs.SIMULATED, *inputs.BAD_ODOMETRY)]
        seeds = 1
    if {RAW, RULE, OURS} - set(settings.methods):
        raise UserError(f"the benchmark compares {RAW}, {RULE} and {OURS}", found=", ".join(settings.methods))
    if not recordings.is_dir() and {inputs.RECORDED, inputs.MEASURED} & set(chosen):
        print(f"no recordings in {recordings}: leaving out the walks that need them")
        chosen = [k for k in chosen if k not in (inputs.RECORDED, inputs.MEASURED)]
    if not chosen:
        raise UserError("no kind of walks is left to be run", found=kinds)

    methods = [Variant(name, name, options) for name, options in resolved(settings).items()]
    plan = Plan(chosen, scenes.split(","), seeds, methods, recordings, DataRoot(data))
    cases = [inputs.simulated_case(inputs.SIMULATED, plan.scenes[0], m, [0]) for m in REGRESSORS]
    walks = [w for case in cases for w in case.walks]
    first = replace(cases[0], walks=cases[0].walks[:1], error_maps=cases[0].error_maps[:1])
    steps = step_table(methods, [first])
    batch, batch_now = frames_per_second(walks)
    speed = [
        Target(STEP_MEDIAN, "", float(steps["median ms"].loc[OURS]), high=0.2),
        Target(STEP_P99, "", float(steps["99 % ms"].loc[OURS]), high=1.0),
        Target(BATCH, "", batch, low=100_000),
    ]
    if not quick:
        workers = min(processes, 2)
        seconds, settings_tried = sweep_seconds(plan.scenes, workers)
        what = f"sweep of {settings_tried} settings over {len(plan.scenes)} scenes, processes: {workers}, s"
        speed.append(Target(what, "", seconds, high=60))
    tasks = list(plan.tasks())
    parts = list(track(_all(tasks, processes), "running the methods", len(tasks)))
    summary, sessions = (pd.concat(p, ignore_index=True) for p in zip(*parts, strict=True))
    text = report(plan, summary, sessions, steps, speed, [f"{BATCH}: {batch_now:.0f}"])
    print(text)
    _write(out, text, {"summary": summary, "sessions": sessions, "steps": steps.reset_index()}, speed)


def _write(out: Path, text: str, tables: Mapping[str, pd.DataFrame], speed: Sequence[Target]) -> None:
    """Write benchmark.md and benchmark.json."""
    out.mkdir(parents=True, exist_ok=True)
    (out / "benchmark.md").write_text(text + "\n", encoding="utf-8")
    content = {name: json.loads(table.to_json(orient="records")) for name, table in tables.items()}
    content["speed"] = {t.what: t.value for t in speed}
    (out / "benchmark.json").write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    app()
