"""The commands that aren't one package's: `judge`, `run`, `scenes` and `docs`."""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from groundwalk.pipeline import Reported, run_steps, steps
from groundwalk.store import progress
from groundwalk.store.__main__ import link_captures
from groundwalk.store.cli import DataOption, ProfileOption, SceneOption, new_app
from groundwalk.store.errors import UserError
from groundwalk.store.files import read_json
from groundwalk.store.hints import view_command
from groundwalk.store.inputs import capture_files
from groundwalk.store.manifests import MANIFEST, is_manifest, outdated_stages
from groundwalk.store.settings import SHIPPED_DATA, STAGES, DataRoot
from groundwalk.store.simulated import are_simulated, marker_of
from groundwalk.store.text import printable

app = new_app("Whole scenes.")
VERDICT = "verdict.json"
_JUDGED_IN = "demo"  # the profile: its settings of sfm take minutes on two cores
_EXIT = {"accepted": 0, "undecided": 3, "refused": 4}
_PICTURES = {
    ".jpg",
    ".jpeg",
    ".png",
    ".heic",
    ".heif",
    ".tif",
    ".tiff",
    ".webp",
    ".dng",
    ".mov",
    ".mp4",
    ".m4v",
    ".avi",
}
CapturesOption = Annotated[
    Path | None,
    typer.Option(help="A folder of phone captures that the scene is to use; it is linked, not copied."),
]
UntilOption = Annotated[str, typer.Option(help="The last stage to run.", autocompletion=lambda: list(STAGES))]


@app.command()
def run(
    scene: SceneOption,
    profile: ProfileOption = "demo",
    captures: CapturesOption = None,
    until: UntilOption = STAGES[-1],
    data: DataOption = Path("data"),
) -> None:
    """Run all stages of a scene, or of each scene of a group and then of the group.

    A stage that is up to date is skipped. A scene that can be simulated, and has no captures, is simulated first.
    """
    root = DataRoot(data)
    if captures is not None:
        link_captures(scene, captures, data)
    run_steps(steps(root, profile, scene, until), profile, root)
    page = root.run(profile, scene, "report") / "page.html"
    if page.is_file():  # a group of scenes may have none of its own
        progress.console.print(f"Look at {page}, or: {view_command(root.run(profile, scene))}")


@app.command()
def judge(
    folder: Annotated[Path, typer.Argument(help="A folder of phone captures, or one capture.")],
    out: Annotated[
        Path | None,
        typer.Option(help="The folder for page, verdict and all between; judged/<folder's name> unless named."),
    ] = None,
) -> None:
    """Say which frames of a capture can be trusted to what, and how far VIO is off: page.html and verdict.json.

    Runs import, structure from motion and alignment in a data folder of its own, <out>/data; the same command goes on
    where it was stopped. The capture isn't changed.

    Exit status: **0** accepted: half of the frames or more are of class A or B, scale and vertical are known; **3**
    undecided: there is ground truth, but less than that; **4** refused: no ground truth; **2** the capture can't be
    read.
    """
    folder = folder.expanduser().resolve()
    _refuse_without_poses(folder)
    out = (out or Path("judged") / folder.name).absolute()
    name = re.sub(r"[^A-Za-z0-9_-]+", "-", folder.name).strip("-_") or "capture"
    root = DataRoot(out / "data")
    if (SHIPPED_DATA / "scenes" / f"{name}.toml").exists():  # its settings are another place's
        name += "-capture"
    progress.console.print(f"judging {folder}; all that is made lies below {out}")
    link_captures(name, folder, root.root)
    report = root.run(_JUDGED_IN, name, "report")
    try:
        run_steps(steps(root, _JUDGED_IN, name, "align"), _JUDGED_IN, root)
    except Reported as refused:
        if read_json(report / VERDICT).get("verdict") != "refused":
            raise SystemExit(refused.code) from None
    for file in ("page.html", VERDICT):
        shutil.copyfile(report / file, out / file)
    verdict = read_json(out / VERDICT)
    progress.stdout.print(f"{verdict['verdict']}: {verdict['why']}")
    for file in ("page.html", VERDICT):
        progress.stdout.print(str(out / file))
    raise typer.Exit(_EXIT[verdict["verdict"]])


def _refuse_without_poses(folder: Path) -> None:
    """UserError for what holds no capture, or pictures alone."""
    if not folder.is_dir():
        raise UserError("there is no such folder", where=folder, expected="a folder of phone captures")
    files = capture_files(folder)
    if files and all(file.suffix.lower() in _PICTURES for file in files):
        raise UserError(
            "these are photos or videos alone: without the phone's poses (VIO) there is no scale, and nothing that "
            "says which frames to trust",
            where=folder,
            found=f"{len(files)} pictures or videos and nothing else",
            do="record with an app that logs the phone's poses, too: docs/reference/capture-formats.md lists them",
        )


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
        table.add_row(*map(printable, (name, of(name, _captures), "; ".join(_finished(root, name)))))
    console.print(table)
    for number, fault in enumerate(faults, start=1):
        console.print(f"\n({number}) {fault}", soft_wrap=True)


@app.command()
def docs(out: Annotated[Path, typer.Option(help="The folder of the docs.")] = Path("docs")) -> None:
    """Write the generated pages of the docs: reference of tables, settings, commands and checks."""
    from groundwalk.reference import write_reference

    for path in write_reference(out):
        progress.stdout.print(str(path))


def _captures(data: DataRoot, scene: str) -> str:
    config = data.scene(scene)[0]
    if config.is_group:
        data.leaves(config)
        return f"those of {', '.join(config.members)}"
    folder = data.captures(scene)
    if marker := marker_of(folder):
        return f"simulated, profile {marker.get('profile', 'unknown')}"
    if files := capture_files(folder):
        return "simulated" if are_simulated(files) else "real"
    return "none, can be simulated" if config.can_simulate else "none"


def _finished(data: DataRoot, scene: str) -> list[str]:
    """`<profile>: <stages>` of each profile that the scene was run with."""
    runs = []
    for folder in sorted((data.root / "runs").glob(f"*/{scene}")):
        stages = [stage for stage in STAGES if (folder / stage / MANIFEST).is_file()]
        manifests = {stage: read_json(folder / stage / MANIFEST) for stage in stages}
        outdated = outdated_stages(folder, {stage: m for stage, m in manifests.items() if is_manifest(m)})
        if stages:
            named = (f"{stage} (outdated)" if stage in outdated else stage for stage in stages)
            runs.append(f"{folder.parent.name}: {', '.join(named)}")
    return runs
