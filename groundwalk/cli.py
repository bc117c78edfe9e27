"""The command `groundwalk`: every command line of the packages under one name.

The table below says where each command is; its module, with the libraries that it needs, is imported when it is run.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
from typing import Annotated, Any

import typer
from typer.core import TyperGroup
from typer.main import get_command

from groundwalk.store.cli import new_app, settings_help, stage_command
from groundwalk.store.registry import Lazy


@dataclass(frozen=True)
class Command:
    """A command: its name, one line of help, and where it is.

    `module`, in groundwalk, has a typer application `app`, of which this is the subcommand `subcommand`, or the only
    command; or it has a pipeline stage `STAGE`, where `is_stage`.
    """

    name: str
    help: str
    module: str
    subcommand: str | None = None
    is_stage: bool = False

    def load(self) -> Any:
        """The command itself."""
        if not self.is_stage:
            command: Any = get_command(import_module(f"groundwalk.{self.module}").app)
            return command.commands[self.subcommand] if self.subcommand else command
        app, stage = new_app(""), self.stage()
        epilog = settings_help(self.name, stage.settings)
        command = stage_command(stage, Lazy("groundwalk.reports.runs_index:write_index"))
        app.command(self.name, help=stage.help, epilog=epilog)(command)
        return get_command(app)

    def stage(self) -> Any:
        """The stage that a stage's command runs."""
        return import_module(f"groundwalk.{self.module}").STAGE


COMMANDS = {
    "Whole scenes": [
        Command("judge", "Say which frames of a capture can be trusted: a page.", "commands", "judge"),
        Command("run", "Run all stages of a scene in order, as far as needed.", "commands", "run"),
        Command("plan", "Say what runs would take, by finished ones.", "planning"),
        Command("campaign", "Run many scenes, on this machine or a cluster.", "campaign"),
        Command("add", "Add a recording to a finished ground truth.", "adding", "add"),
        Command("remove", "Take a recording out of a ground truth.", "adding", "remove"),
        Command("compare", "Compare runs: settings, and figures beyond noise.", "commands", "compare"),
        Command("scenes", "List scenes, profiles and finished stages.", "commands", "scenes"),
        Command("simulate", "Simulate captures of a scene that has none.", "simulation.__main__"),
        Command("view", "Open a scene's recordings in the Rerun viewer.", "store.__main__", "view"),
        Command("clean", "Remove a scene's results and simulated captures.", "store.__main__", "clean"),
    ],
    "Stages": [
        Command(name, help_text, f"{package}.definition", is_stage=True)
        for name, package, help_text in (
            ("import", "capture_import", "Import phone captures as checked frames with VIO poses."),
            ("sfm", "sfm", "Structure from motion with COLMAP."),
            ("align", "alignment", "Make metric, gravity-aligned ground truth; measure VIO drift."),
            ("localise", "localisation", "Build maps of points; localise every query frame."),
            ("train", "training", "Train absolute pose regressors; predict every frame's pose."),
            ("fuse", "fusion", "Fuse predictions with VIO; measure pose errors."),
            ("report", "reports", "Make tables, figures and one page."),
        )
    ],
    "Captures, exports and checks": [
        Command("inspect", "Show what a capture holds, without import.", "inspecting"),
        Command("formats", "List the capture formats.", "capture_import.__main__", "formats"),
        Command("export", "Export ground truth, or a regressor for a phone.", "export.__main__"),
        Command("locate", "Localise images in a map, or by a regressor.", "localisation.locate"),
        Command("evaluate", "Fuse predictions from Parquet files; measure errors.", "fusion.__main__", "evaluate"),
        Command(
            "check-truth",
            "Compare a simulated scene's ground truth with its true poses.",
            "alignment.__main__",
            "check-truth",
        ),
    ],
}


def all_commands() -> Iterator[Command]:
    """Every command, in the order of --help."""
    for commands in COMMANDS.values():
        yield from commands


def stage_of(name: str) -> Any:
    """A stage of the pipeline; loads its libraries."""
    return next(command for command in COMMANDS["Stages"] if command.name == name).stage()


def stages() -> list[Any]:
    """The stages of the pipeline in their order; loads their libraries."""
    return [command.stage() for command in COMMANDS["Stages"]]


class _LoadedWhenRun(TyperGroup):
    """A group whose commands are names and help lines until one is resolved."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, command, rest = super().resolve_command(ctx, args)
        record = next((c for c in all_commands() if c.name == name), None)
        return name, record.load() if record else command, rest


app = new_app(
    "Visual-localisation datasets from phone captures: frames, SfM, ground truth, regressors, fusion, report.",
    cls=_LoadedWhenRun,
    add_completion=True,
    no_args_is_help=True,
)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"groundwalk {version('groundwalk')}")
        raise typer.Exit


@app.callback()
def _groundwalk(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def _list_command(command: Command, panel: str) -> None:
    @app.command(command.name, help=command.help, rich_help_panel=panel)
    def name_list() -> None:
        raise AssertionError("replaced by the loaded command in resolve_command")


for _panel, _commands in COMMANDS.items():
    for _command in _commands:
        _list_command(_command, _panel)
