"""The commands that aren't one package's: `judge`, `run`, `compare` and `scenes`."""

import math
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from groundwalk.pipeline import USER_ERROR, Reported, run_steps, steps
from groundwalk.store import progress
from groundwalk.store.__main__ import link_folder
from groundwalk.store.cli import DataOption, ProfileOption, SceneOption, new_app
from groundwalk.store.errors import UserError
from groundwalk.store.files import STOPPED, link_or_copy, partial_folder, read_json, write_json, written_aside
from groundwalk.store.hints import view_command
from groundwalk.store.inputs import capture_files, has_capture_files
from groundwalk.store.runs import runs_in
from groundwalk.store.settings import SHIPPED_DATA, STAGES, DataRoot, is_name
from groundwalk.store.simulated import are_simulated, marker_of
from groundwalk.store.text import name_list, printable

if TYPE_CHECKING:
    import pandas as pd

    from groundwalk.reports.comparison import ComparedRun

app = new_app("Whole scenes.")
VERDICT = "verdict.json"
_NOTE = "judged.json"  # in a judgement's data folder: which file its captures are a copy of
_JUDGED_IN = "demo"  # the profile: its settings of sfm take minutes on two cores
_EXIT = {"accepted": 0, "undecided": 3, "refused": 4}


@app.command()
def run(
    scene: SceneOption,
    profile: ProfileOption = "demo",
    captures: Annotated[
        Path | None, typer.Option(help="A folder of phone captures that the scene is to use; it is linked, not copied.")
    ] = None,
    until: Annotated[str, typer.Option(help="The last stage to run.")] = STAGES[-1],
    data: DataOption = Path("data"),
) -> None:
    """Run all stages of a scene, or of each scene of a group and then of the group.

    A stage that is up to date is skipped. A scene that can be simulated, and has no captures, is simulated first.
    """
    root = DataRoot(data)
    if captures is not None:
        link_folder(root, scene, captures)
        progress.stdout.print(f"{root.captures(scene)} → {captures}")
    run_steps(steps(root, profile, scene, until), profile, root)
    report = root.run(profile, scene, "report")
    if verdict := read_json(report / VERDICT):  # a group of scenes has one for each
        for line in closing_lines(verdict):
            progress.console.print(line)
    if (report / "page.html").is_file():  # a group of scenes may have none of its own
        progress.console.print(f"look at {report / 'page.html'}, or: {view_command(root.run(profile, scene))}")


def closing_lines(verdict: dict[str, Any]) -> Iterator[str]:
    """What a run has come to, by its verdict.json: a line each for ground truth, VIO, the structure localiser that
    stands first and the regressor that does, fused where it was."""
    headline, unit = verdict["headline"], verdict["length_unit"]
    small, per_unit = ("cm", 100) if unit == "m" else (unit, 1)
    text = (
        f"{verdict['verdict']}, {100 * headline['trusted_share']:.0f} % of {headline['frames']} frames of class A or B"
    )
    if (sd := headline["position_sd_median"]) is not None:
        text += f", half of them to ± {per_unit * sd:.2g} {small}"
    if (scale_sd := headline["scale_sd"]) is not None:
        text += f"; scale ± {100 * scale_sd:.2g} %"
    if (true := verdict["true_errors"]) is not None:
        stated = f"± {per_unit * true['position_stated']:.2g} {small} are stated with scale and vertical"
        text += f"; {per_unit * true['position']:.2g} {small} from the simulator's truth, where {stated}"
    yield f"ground truth: {text}"
    if drifts := verdict["vio_error_by_distance"]:
        drift = min(drifts, key=lambda row: abs(row["distance_m"] - 5))
        over = f"{drift['median_percent']:.2g} % off over {drift['distance_m']:g} m (median)"
        yield f"VIO: {over}, {headline['vio_jumps']} jumps"
    tested = sum(frame["split"] == "test" and frame["quality"] != "none" for frame in verdict["frames"])
    for kind, fused in (("structure localiser", False), ("regressor", True)):
        known = [row for row in verdict["localisers"] if row["kind"] == kind and row["median_position"] is not None]
        for best in sorted(known, key=lambda row: (row["fused"] != fused, row["median_position"]))[:1]:
            figures = f"median {best['median_position']:g} {unit}, {best['median_rotation_deg']:g}°"
            alone = {row["model"]: row["median_position"] for row in known if best["fused"] and not row["fused"]}
            text = f"; alone {alone[best['model']]:g} {unit}" if best["model"] in alone else ""
            over = f" of {best['frames']} test frames" * (best["frames"] < tested)
            yield f"best {kind}: {best['localiser']}: {figures}, {best['coverage']:g} %{over} have a pose{text}"


@app.command()
def judge(
    folder: Annotated[
        Path, typer.Argument(help="A folder of phone captures, or one capture: a folder, a video, an archive.")
    ],
    out: Annotated[
        Path | None,
        typer.Option(help="The folder for page, verdict and all between; judged/<capture's name> unless named."),
    ] = None,
) -> None:
    """Say which frames of a capture can be trusted to what, and how far VIO is off: page.html and verdict.json.

    Runs import, structure from motion and alignment in a data folder of its own, data/ below --out; the same command
    goes on where it was stopped. The capture isn't changed.

    Exit status: **0** accepted: half of the frames or more are of class A or B, scale and vertical are known; **3**
    undecided: there is ground truth, but less than that; **4** refused: no ground truth; **2** unreadable: the page
    says what is missing.
    """
    folder = folder.resolve()
    if not folder.exists():
        raise UserError("there is no such capture", where=folder, expected="a folder of phone captures, or one of them")
    title = folder.stem if folder.is_file() else folder.name
    out = (out or Path("judged") / title).absolute()
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", title).strip("-_")[:80] or "capture"
    root = DataRoot(out / "data")
    if (SHIPPED_DATA / "scenes" / f"{name}.toml").exists():  # its settings are another place's
        name += "-capture"
    progress.console.print(f"judging {folder}; all that is made lies below {out}")
    captures, note = root.captures(name), root.root / _NOTE
    copy, is_again = captures / folder.name, read_json(note) == {"capture": str(folder)}
    _refuse_another(out, folder, [copy] if is_again else [])
    report, unread = root.run(_JUDGED_IN, name, "report"), partial_folder(root.run(_JUDGED_IN, name, "import"))
    if not folder.is_dir():
        captures.mkdir(parents=True, exist_ok=True)  # a folder of its own, which import reads
        if not (copy.exists() and copy.samefile(folder)):
            write_json(note, {"capture": str(folder)})
            copy.unlink(missing_ok=True)
            link_or_copy(folder, copy)
    elif has_capture_files(folder):
        link_folder(root, name, folder)
    else:
        expected = "a folder of phone captures, photos or videos"
        empty = UserError("the folder is empty", where=folder, expected=expected)
        _write_unreadable(out, title, {"what": empty.what, **empty.details})
        raise empty
    try:
        run_steps(steps(root, _JUDGED_IN, name, "align"), _JUDGED_IN, root)
    except Reported as refused:
        if read_json(report / VERDICT).get("verdict") != "refused":
            raise SystemExit(refused.code) from None
    except SystemExit as stopped:
        if stopped.code == USER_ERROR and (why := read_json(unread / STOPPED)):
            _write_unreadable(out, title, why)
        raise
    verdict = read_json(report / VERDICT)
    progress.stdout.print(f"{verdict['verdict']}: {verdict['why']}")
    for file in ("page.html", VERDICT):
        shutil.copyfile(report / file, out / file)
        progress.stdout.print(str(out / file))
    raise typer.Exit(_EXIT[verdict["verdict"]])


@app.command()
def compare(
    runs: Annotated[list[str], typer.Argument(help="Two runs or more: scenes' names, or folders of runs.")],
    out: Annotated[Path, typer.Option(help="The page to write.")] = Path("compare.html"),
    fail_if_worse: Annotated[
        str,
        typer.Option(
            help="Exit with 1 where a figure is worse by more than this, and by more than noise: 5%. Also where a run "
            "lacks frames, models, methods or metric scale that the first one has."
        ),
    ] = "",
    profile: ProfileOption = "demo",
    data: DataOption = Path("data"),
) -> None:
    """Compare runs with the first of them: what was done differently, and which figures differ by more than noise."""
    from groundwalk.reports.comparison import comparison_page, differences, lost_scale, missing, why_no_positions

    try:
        limit = float(fail_if_worse.removesuffix("%")) if fail_if_worse else 0.0
    except ValueError:
        limit = math.nan
    if not 0 <= limit < math.inf:
        expected = "a number, as in --fail-if-worse 5%"
        raise UserError("this is no percentage", found=fail_if_worse, expected=expected)
    if len(runs) < 2:
        raise UserError("one run can't be compared", found=runs[0], do="name two runs or more")
    # Folders without the folder that all are in.
    folders = [Path(run).absolute() for run in runs if not is_name(run)]
    common = os.path.commonpath([folder.parent for folder in folders]) if folders else ""
    names = [f"{run}, {profile}" if is_name(run) else str(Path(run).absolute().relative_to(common)) for run in runs]
    compared = [_compared(run, name, profile, data) for run, name in zip(runs, names, strict=True)]
    if len({run.name for run in compared}) < len(compared):
        raise UserError("a run was named twice", found=", ".join(run.name for run in compared))
    first, *others = compared
    found = [difference for other in others for difference in differences(first, other)]
    if not found:
        has = (f"{r.name}: {len(r.ground_truth)} of align, {r.errors['frame_id'].nunique()} of fuse" for r in compared)
        raise UserError(
            "these runs have no frame in common",
            expected="the same captures, with align finished",
            found=f"frames of {'; '.join(has)}",
            do="run the stages that are missing, or compare other runs",
        )
    lost = [missed for other in others for missed in missing(first, other)]
    lacking = [*lost, *(missed for other in others for missed in missing(other, first))]
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder, written_aside(out) as path:
        path.write_text(comparison_page(compared, found, lacking, Path(folder)), encoding="utf-8")
    for line in (*filter(None, (why_no_positions(first, other) for other in others)), *lacking):
        progress.stdout.print(str(line))
    for difference in found:
        if difference.is_clear:
            told = f"{difference.verdict}: {difference.run}: {difference.subject}: {difference.figure}"
            progress.stdout.print(f"{told}: {difference.before:.4g} → {difference.after:.4g}")
    same = sum(not difference.is_clear for difference in found)
    progress.stdout.print(f"{same} of {len(found)} figures don't differ by more than noise")
    progress.stdout.print(str(out))
    is_less = lost or any(lost_scale(first, other) for other in others)
    if fail_if_worse and (is_less or any(difference.is_worse_by(limit) for difference in found)):
        raise typer.Exit(1)


def _compared(run_name: str, name: str, profile: str, data: Path) -> "ComparedRun":
    from groundwalk.opening import open_run
    from groundwalk.reports.comparison import ComparedRun
    from groundwalk.store.choices import MapUnit
    from groundwalk.store.schemas import schema
    from groundwalk.store.tables import map_unit

    run = open_run(run_name, profile, data)

    def table(stage: str, table: str) -> "pd.DataFrame":
        is_there = (run.folder / stage / f"{table}.parquet").is_file() and stage not in run.outdated
        if is_there and stage in run.manifests:
            return run.table(stage, table)
        empty: pd.DataFrame = schema(stage, table).arrow().empty_table().to_pandas()
        return empty

    truth = table("align", "ground_truth")
    # A group of scenes, which has no ground truth of its own, is in metres where all of its scenes are.
    in_fuse = table("fuse", "summary")["map_unit"].dropna()
    units = [map_unit(truth)] if len(truth) else [MapUnit(unit) for unit in in_fuse]
    return ComparedRun(
        name=name,
        manifests=run.manifests,
        unit=next((unit for unit in units if unit is not MapUnit.METRE), MapUnit.METRE),
        ground_truth=truth,
        errors=table("fuse", "errors"),
        validation=table("fuse", "validation"),
    )


def _refuse_another(out: Path, capture: Path, copies: list[Path]) -> None:
    """UserError where an output folder has captures that are neither this one nor `copies` of it: captures of one name
    share a folder, and what is linked there, or lies there, may be all that its owner has."""
    there = list[Path]()
    for captures in sorted((out / "data" / "captures").glob("[!.]*")):
        there += [captures] if captures.is_symlink() or capture.is_dir() else capture_files(captures)
    others = [path for path in there if path not in copies and not (path.exists() and path.samefile(capture))]
    if others:
        raise UserError(
            "the output folder is of another capture",
            where=out,
            expected=f"an earlier judgement of {capture}, or nothing",
            found=name_list([str(path.resolve()) for path in others], 3),
            do="name another folder with --out, or move this one away",
        )


def _write_unreadable(folder: Path, name: str, stopped: dict[str, Any]) -> None:
    """Write page.html and verdict.json of a capture that import refuses; `stopped` has `what`, `where`, `expected`,
    `found` and `do` of the error."""
    from markupsafe import Markup

    from groundwalk.reports.details import problems
    from groundwalk.reports.grids import html_table
    from groundwalk.reports.templating import plain_page
    from groundwalk.reports.verdict import State, problem_of

    problem, what = problem_of({key: str(text) for key, text in stopped.items() if text is not None}), stopped["what"]
    lead = Markup('<p class="verdict refused"><strong>Unreadable.</strong> {}.</p>').format(what)
    page = plain_page(name, "capture", [lead, html_table(problems(name, [problem]))])
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "page.html").write_text(page, encoding="utf-8")
    verdict = {"scene": name, "verdict": State.UNREADABLE.value, "why": what, "problems": [vars(problem)], "frames": []}
    write_json(folder / VERDICT, verdict)
    for file in ("page.html", VERDICT):
        progress.stdout.print(str(folder / file))


@app.command()
def scenes(data: DataOption = Path("data")) -> None:
    """List profiles, and scenes with their captures and the stages that are finished.

    A stage is outdated where one that it was made from was run again since.
    """
    root = DataRoot(data)
    console = progress.TextConsole(highlight=False, markup=False)
    faults: list[UserError] = []

    def of(name: str, tell: Callable[[DataRoot, str], str]) -> str:
        try:
            return tell(root, name)
        except UserError as error:
            faults.append(error)
            return f"its file can't be used, see below ({len(faults)})"

    table = Table("profile", "", box=None, pad_edge=False)
    for name in root.names("profiles"):
        described = of(name, lambda data, name: str(data.profile(name).get("description", "")))
        table.add_row(*map(printable, (name, described)))
    console.print(table)
    console.print()
    table = Table("scene", "captures", "finished stages", box=None, pad_edge=False)
    for name in root.scenes():
        finished = (
            f"{run.name[1]}: {', '.join(f'{s} (outdated)' if s in run.outdated else s for s in run.finished)}"
            for run in runs_in(root, name)
        )
        table.add_row(*map(printable, (name, of(name, _captures), "; ".join(finished))))
    console.print(table)
    for number, fault in enumerate(faults, start=1):
        console.print(f"\n({number}) {fault}", soft_wrap=True)


def _captures(data: DataRoot, scene: str) -> str:
    config = data.scene(scene)[0]
    if config.is_group:
        data.leaves(config)
        return f"those of {', '.join(config.members)}"
    folder = data.captures(scene)
    if folder.is_symlink() and not folder.exists():
        return f"a link to {folder.readlink()}, which isn't there"
    if marker := marker_of(folder):
        return f"simulated, profile {marker.get('profile', 'unknown')}"
    if files := capture_files(folder):
        return "simulated" if are_simulated(files) else "real"
    return "none, can be simulated" if config.can_simulate else "none"
