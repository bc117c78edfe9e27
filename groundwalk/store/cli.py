"""The command line that every stage shares: `groundwalk <stage> --scene … --profile …`."""

import os
import platform
import shutil
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperCommand

from groundwalk.store.damage import as_user_error, causes, sentence
from groundwalk.store.errors import UserError
from groundwalk.store.settings import DataRoot, Settings
from groundwalk.store.signals import Stopped, signals_raise
from groundwalk.store.text import printable

if TYPE_CHECKING:
    from groundwalk.store.definition import Stage


SceneOption = Annotated[str, typer.Option(help="The scene: a folder of data/captures, or one that can be simulated.")]
ProfileOption = Annotated[
    str,
    typer.Option(
        help="Settings for the whole run: demo, standard, paper or tiny (shipped/profiles), or yours (data/profiles)."
    ),
]
DataOption = Annotated[Path, typer.Option(help="The data folder, with captures/ and runs/.")]
# The limits are those of the libraries that take it.
SeedOption = Annotated[int, typer.Option(help="Seed of everything random.", min=0, max=2**31 - 1)]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="One setting, key=value as in TOML; may be given several times.")
]

EXPECTED_VERSION = "GROUNDWALK_EXPECTED_VERSION"
"""The environment variable with the version that a campaign expects of whoever runs a stage."""

# Those that numexpr, which pandas loads, and numba read.
_THREADS = ("OMP_NUM_THREADS", "NUMEXPR_NUM_THREADS", "NUMEXPR_MAX_THREADS", "NUMBA_NUM_THREADS")
_NUMBA_CONFIG = ".numba_config.yaml"


class _Command(TyperCommand):
    """A command that refuses two scenes, or captures, of which the last would count as of other options, and an empty
    path, which would be the current folder; and finds ~ where shells leave it alone: in --data=~/here."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        values, _, given = self.make_parser(ctx).parse_args(args=[*args])
        for param in given:
            if given.count(param) > 1 and param.name in ("scene", "captures"):
                raise UserError(f"{param.opts[0]} was given twice", do="run the command once for each")
        rest = super().parse_args(ctx, args)
        for name, value in ctx.params.items():
            if isinstance(value, Path):
                if values.get(name) == "":
                    raise UserError(f"the path {name!r} is empty", expected="a path; . is the current folder")
                ctx.params[name] = Path(os.path.expanduser(value))  # noqa: PTH111 - it fails where there is no such user
        return rest


class App(typer.Typer):
    """A typer application that shows what a user or the machine caused in a few lines and exits with 2; with 130 after
    Ctrl-C, 143 after SIGTERM."""

    def command(self, *args: Any, **options: Any) -> Any:
        return super().command(*args, **{"cls": _Command, **options})

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        try:
            with signals_raise():
                _check_environment()
                _distrust_current_folder()
                return super().__call__(*args, **kwargs)
        except (Stopped, Exception) as error:
            # Python hides what stops it in some places, as while it makes a class.
            stopped = next((cause for cause in causes(error) if isinstance(cause, Stopped)), None)
            if stopped is not None:
                print(f"stopped by {stopped}{f'; {stopped.again}' if stopped.again else ''}", file=sys.stderr)
                sys.exit(stopped.exit_code)
            has_number = isinstance(error, OSError) and error.errno is not None
            message = as_user_error(error) if has_number or isinstance(error, MemoryError | shutil.Error) else error
            if message is None and isinstance(error, OSError):
                message = sentence(error)
            if not isinstance(message, UserError):
                raise
            print(f"error: {printable(str(message))}", file=sys.stderr)
            sys.exit(2)


def _check_environment() -> None:
    """What libraries fail without: open standard streams, as helper processes would take the numbers of closed ones for
    their pipes, and numbers of threads that are numbers."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # it gets the lowest number that is free
    for name in _THREADS:
        if (value := os.environ.get(name)) and not (value.strip().isdecimal() and int(value) > 0):
            raise UserError(
                f"{name} is no number of threads", found=repr(value), expected="a whole number", do=f"unset {name}"
            )


def _distrust_current_folder() -> None:
    """Nothing that lies in the current folder, which may be a stranger's captures, becomes code.

    Processes that this one starts look for modules there only where this one does (`python -m`); of itself Python looks
    there first. numba reads there which folder to load compiled code from.
    """
    try:
        current = os.getcwd()  # noqa: PTH109 (as in sys.path)
    except FileNotFoundError:
        raise UserError("the current folder has been removed", do="change to one that is there") from None
    if os.path.lexists(_NUMBA_CONFIG):
        raise UserError(
            "the current folder has settings of numba, which loads code from where they say",
            where=Path(current) / _NUMBA_CONFIG,
            do="run the command from another folder, or move the file away",
        )
    if not {"", current} & {*sys.path}:
        os.environ["PYTHONSAFEPATH"] = "1"


def new_app(help_text: str, **options: Any) -> App:
    """An empty application; subcommands are added by its caller."""
    fixed: dict[str, Any] = {"rich_markup_mode": "markdown", "pretty_exceptions_enable": False}
    return App(help=help_text, **{"add_completion": False, **fixed, **options})


def stage_app(stage: "Stage[Any]") -> App:
    """The command line of a stage: without a subcommand it runs the stage."""
    app = new_app(stage.help, epilog=settings_help(stage.name, stage.settings))
    app.callback(invoke_without_command=True)(stage_command(stage))
    return app


def stage_command(stage: "Stage[Any]", after: Callable[[DataRoot], None] = lambda data: None) -> Callable[..., None]:
    """The function behind a stage's command line; `after` is called when it has ended, well or not."""

    def main(
        context: typer.Context,
        scene: SceneOption = "",
        profile: ProfileOption = "demo",
        set_: SetOption = None,
        seed: SeedOption = 0,
        force: Annotated[bool, typer.Option("--force", help="Run anew, even if the artefact is up to date.")] = False,
        data: DataOption = Path("data"),
    ) -> None:
        if context.invoked_subcommand is not None:
            return
        if not scene:
            raise UserError(
                "no scene was named", do=f"add --scene <name>, for example --scene Church (stage {stage.name})"
            )
        # Here, as it takes a second, and more than `--help`.
        from groundwalk.store.stage import execute

        expected = os.environ.get(EXPECTED_VERSION, version_of(stage))
        if expected != version_of(stage):
            raise UserError(
                "this worker has another version of groundwalk than the campaign was planned with",
                where=f"{platform.node()}, {sys.executable}",
                expected=expected,
                found=version_of(stage),
                do="install the expected version there, or give `groundwalk campaign` again with this one",
            )
        try:
            execute(stage, scene, profile, DataRoot(data), set_, seed, force)
        finally:
            after(DataRoot(data))

    return main


def version_of(stage: "Stage[Any]") -> str:
    """The version of what a stage does, in words."""
    return f"groundwalk {version('groundwalk')}, {stage.name} version {stage.version}"


def settings_help(section: str, model: type[Settings]) -> str:
    """The settings of a stage as a Markdown list, shown below the options of --help."""
    lines = [
        f"**Settings**, section `[{section}]` of `data/profiles/<profile>.toml` or `data/scenes/<scene>.toml`, or "
        f"`--set key=value` (docs/reference/settings.md#{section}):"
    ]
    for name, info in model.model_fields.items():
        default = info.get_default(call_default_factory=True)
        default_text = "" if isinstance(default, Settings) else f" (default {default!r})"
        lines.append(f"- `{name}`{default_text}: {info.description or ''}")
    # typer makes one line break of two.
    return "\n\n".join(lines).replace(":\n\n-", ":\n\n\n\n-", 1)
