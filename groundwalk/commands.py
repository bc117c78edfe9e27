"""The commands that aren't one package's: `run`, `scenes` and `docs`."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from groundwalk.pipeline import run_steps, steps
from groundwalk.store import progress
from groundwalk.store.__main__ import link_captures
from groundwalk.store.cli import DataOption, ProfileOption, SceneOption, new_app
from groundwalk.store.errors import UserError
from groundwalk.store.files import read_json
from groundwalk.store.hints import view_command
from groundwalk.store.inputs import capture_files
from groundwalk.store.manifests import MANIFEST, is_manifest, outdated_stages
from groundwalk.store.settings import STAGES, DataRoot
from groundwalk.store.simulated import are_simulated, marker_of
from groundwalk.store.text import printable

app = new_app("Whole scenes.")
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
    if until == STAGES[-1]:
        progress.console.print(f"Look at {page}, or: {view_command(root.run(profile, scene))}")


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
