"""The generated pages of docs: the reference from the code that defines it, and results from committed data."""

import dataclasses
import tomllib
from collections.abc import Collection, Iterator, Mapping
from enum import Enum
from pathlib import Path
from typing import Any

from groundwalk.alignment.checks.definitions import DEFINITIONS
from groundwalk.alignment.control.settings import ControlSettings
from groundwalk.alignment.rulers.settings import AprilTagRuler, CharucoRuler, DistanceRuler
from groundwalk.cli import COMMANDS, Command, all_commands
from groundwalk.fusion.methods import METHODS
from groundwalk.localisation.localisers import LOCALISERS
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.simulation.vio import FIT_FILE, VioModel
from groundwalk.store.choices import FailureCause
from groundwalk.store.errors import UserError
from groundwalk.store.reference import reference as tables_page
from groundwalk.store.registry import Registry
from groundwalk.store.settings import SceneConfig, Settings, SplitRules
from groundwalk.training.regressors import REGRESSORS

RULERS: dict[str, type[Settings]] = {"charuco": CharucoRuler, "apriltag": AprilTagRuler, "distance": DistanceRuler}
WRITTEN_BY = "This page is written by `make docs`."

_SETTINGS_HEAD = f"""# Settings

A stage's settings are resolved in this order, the later one wins: the defaults below, the section `[<stage>]` of
the profile's file, the same section of the scene's file, `--set key=value` on the command line
(`--set quality_a.max_position_sd_m=0.01`). Your files are `data/profiles/<profile>.toml` and
`data/scenes/<scene>.toml`; one whose name a shipped file has (in `shipped/profiles` and `shipped/scenes`) adds to that,
and wins. An unknown key, a wrong type and a value out of range are errors that name the key. The resolved settings of a
run are in each stage's `manifest.json`.

{WRITTEN_BY}
"""
_COMMANDS_HEAD = f"""# Commands

`groundwalk <command> --help` prints the same. A command exits with 0 when it did what it says, with 2 after an error
that a user can correct (`check-truth` with 1 where a target is missed), with 130 after Ctrl-C and 143 after SIGTERM; a
stage that was stopped resumes when the same command is run again, without `--force`. `make help` lists the targets of
the Makefile, which call these commands.

{WRITTEN_BY}
"""
_CHECKS_HEAD = f"""# Checks of ground truth

`align` writes a row for each check and each session, model or window that it is about into
[`checks`](tables.md#align). The value is an estimate, `sd` its standard error: the check has *passed* where the value
keeps two of these within the limit, *failed* where it is beyond the limit by two or more, and is *undecided* between.
What has no standard error is counted or measured. The limits are [settings](settings.md#align); why these checks:
[consistency](../explanation/consistency.md); step by step: [act on a failed check](../how-to/failed-check.md).

{WRITTEN_BY}
"""
_DRIFT_HEAD = """# How far phones' VIO drifts

Written by `make docs` from `simulation/vio_fit.toml`, which `python -m benchmarks.vio_drift.fit` measures on real
recordings; a test holds that the recordings still give it. Intervals are of 68 %; where one reaches 0, the value is its
upper end, a bound. What the recordings are and how it is measured: [VIO drift](../explanation/vio-drift.md).

| parameter | meaning | value | 68 % interval | unit | samples | source |
|---|---|---|---|---|---|---|
"""


def write_reference(docs: Path) -> list[Path]:
    """Write all generated pages into the folder docs/; their paths. UserError where they can't be written, or one would
    replace a page that isn't generated."""
    pages = {docs / name: page for name, page in reference_pages().items()}
    try:
        for path in pages:
            if path.exists() and b"`make docs`" not in path.read_bytes():
                raise UserError("this isn't a generated page", where=path, do="name another folder with --out")
        for path, page in pages.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(page, encoding="utf-8")
    except OSError as error:
        raise UserError("a page can't be written", where=error.filename, found=error.strerror) from None
    return [*pages]


def reference_pages() -> dict[str, str]:
    """The generated pages by path in docs/."""
    return {
        "reference/tables.md": tables_page(),
        "reference/settings.md": settings_page(),
        "reference/commands.md": commands_page(),
        "reference/checks.md": checks_page(),
        "results/vio-drift.md": vio_drift_page(),
    }


def vio_drift_page() -> str:
    """What was measured of the drift of phones' VIO, from the committed fit."""
    fit = tomllib.loads(FIT_FILE.read_text(encoding="utf-8"))
    rows = [_DRIFT_HEAD]
    for field in dataclasses.fields(VioModel):
        p = fit[field.name]
        interval = f"{p['low']} to {p['high']}" if p["low"] < p["high"] else ""
        cells = [f"`{field.name}`", _cell(field.metadata["meaning"]), str(p["value"]), interval, p["unit"]]
        rows.append(f"| {' | '.join(cells)} | {p['samples']} | {_cell(p['source'])} |\n")
    return "".join(rows)


def settings_page() -> str:
    """Every setting with its type, range, default and description."""
    return _SETTINGS_HEAD + "".join(f"\n## {title}\n\n{text}\n\n{table}" for title, text, table in _sections())


def commands_page() -> str:
    """Every command of `groundwalk` with its arguments and options."""
    parts = [_COMMANDS_HEAD]
    for panel, commands in COMMANDS.items():
        parts.append(f"\n## {panel}\n")
        parts += [_command(command) for command in commands]
    return "".join(parts)


def checks_page() -> str:
    """Every check of align with what it estimates and what to do, and the causes in their order."""
    parts = [_CHECKS_HEAD, "\n## Checks\n\n| check | estimates | unit | where it failed | what would decide it |\n"]
    parts.append("|---|---|---|---|---|\n")
    for name, check in DEFINITIONS.items():
        cells = " | ".join(_cell(text) for text in (check.estimate, check.unit, check.remedy, check.evidence))
        parts.append(f"| `{name}` | {cells} |\n")
    parts.append(
        "\n## Causes\n\nWhat a failure says is wrong, column `cause`. The first in this order names the run.\n\n"
    )
    parts += [f"{number}. {_cell(str(cause))}\n" for number, cause in enumerate(FailureCause, 1)]
    return "".join(parts)


def _sections() -> Iterator[tuple[str, str, str]]:
    """Title, introduction and table of each section of settings."""
    yield "A scene's file", "At the top of `data/scenes/<scene>.toml`.", _table(SceneConfig, {"name", "split"})
    yield "[split]", "In a scene's file: which sessions train and which test.", _table(SplitRules)
    yield "[simulate]", "How a scene's captures are simulated.", _table(SimulateSettings)
    for command in all_commands():
        if not command.is_stage:
            continue
        stage = command.stage()
        yield f"[{stage.name}]", stage.help, _table(stage.settings)
        if stage.name == "align":
            for kind, model in RULERS.items():
                text = f"{_first_line(model)} In a scene's file, any number of these: [rulers](../how-to/ruler.md)."
                yield f'[[ruler]] of kind "{kind}"', text, _table(model, {"kind"})
            text = "In a scene's file, any number of these: [control points](../how-to/control-points.md)."
            yield "[[control]]", text, _table(ControlSettings)
        if stage.name == "localise":
            yield _of_entries("localise.localisers", LOCALISERS, "settings")
        if stage.name == "train":
            yield _of_entries("train.regressors", REGRESSORS, "settings")
        if stage.name == "fuse":
            yield _of_entries("fuse.options", METHODS, "options")


def _of_entries(section: str, registry: Registry[Any], attribute: str) -> tuple[str, str, str]:
    """The settings of all entries of a kind, each once, with the entries that have it and their defaults."""
    models = {entry_id: getattr(registry[entry_id], attribute) for entry_id in registry.builtin}
    rows: dict[tuple[str, str, str], dict[str, list[str]]] = {}
    for entry_id, model in models.items():
        schema = model.model_json_schema()
        for name, kind, default, text in _rows(model, schema, schema.get("$defs", {}), ""):
            rows.setdefault((name, kind, text), {}).setdefault(default or "none", []).append(entry_id)
    listed = "\n".join(f"- `{entry_id}`: {_cell(registry[entry_id].meaning)}" for entry_id in models)
    table = "| setting | type and range | default | description |\n|---|---|---|---|\n"
    for (name, kind, text), defaults in rows.items():
        owners = [entry_id for ids in defaults.values() for entry_id in ids]
        # The default of most is said without names where every entry has the setting.
        common = max(defaults, key=lambda default: len(defaults[default])) if len(owners) == len(models) > 1 else None
        others = [f"{', '.join(ids)}: {default}" for default, ids in defaults.items() if default != common]
        table += f"| `{name}` | {kind} | {'; '.join(filter(None, [common, *others]))} | {_cell(text)} |\n"
    return f"[{section}.<name>]", f"`<name>` is one of these:\n\n{listed}", table if rows else "None has settings.\n"


def _first_line(model: type[Settings]) -> str:
    return (model.__doc__ or "").strip().splitlines()[0]


def _table(model: type[Settings], without: Collection[str] = ()) -> str:
    schema = model.model_json_schema()
    rows = [row for row in _rows(model, schema, schema.get("$defs", {}), "") if row[0].split(".")[0] not in without]
    if not rows:
        return "It has no settings.\n"
    head = "| setting | type and range | default | description |\n|---|---|---|---|\n"
    return head + "".join(f"| `{n}` | {kind} | {default} | {_cell(text)} |\n" for n, kind, default, text in rows)


def _rows(model: type[Settings], schema: Mapping[str, Any], defs: Mapping[str, Any], prefix: str) -> Iterator[Any]:
    """Name, type, default and description of each setting; a section inside gives a row for each of its own."""
    for name, field in model.model_fields.items():
        value = field.get_default(call_default_factory=True) if not field.is_required() else None
        if isinstance(value, Settings):
            inside = type(value).model_json_schema()
            for row_name, kind, _, text in _rows(type(value), inside, inside.get("$defs", {}), f"{prefix}{name}."):
                yield row_name, kind, _value_text(getattr(value, row_name.rpartition(".")[2])), text
            continue
        default = "required" if field.is_required() else _value_text(value)
        yield f"{prefix}{name}", _kind(schema["properties"][name], defs), default, field.description or ""


def _kind(schema: Mapping[str, Any], defs: Mapping[str, Any]) -> str:
    """A JSON schema in words: `number, > 0, ≤ 1`."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return _kind(defs[name], defs) if "enum" in defs[name] else "table"
    if "anyOf" in schema:
        return " or ".join(dict.fromkeys(_kind(option, defs) for option in schema["anyOf"]))
    if "enum" in schema:
        return ", ".join(f"`{value}`" for value in schema["enum"])
    if "const" in schema:
        return f"`{schema['const']}`"
    if schema.get("type") == "array":
        if "prefixItems" in schema:
            return f"{len(schema['prefixItems'])} × {_kind(schema['prefixItems'][0], defs)}"
        return f"list of {_kind(schema.get('items', {}), defs)}"
    words = {"integer": "whole number", "string": "text", "boolean": "true or false", "object": "table"}
    kind = words.get(schema.get("type", ""), schema.get("type", "any"))
    bounds = {"exclusiveMinimum": ">", "minimum": "≥", "exclusiveMaximum": "<", "maximum": "≤"}
    return ", ".join([kind, *(f"{sign} {schema[key]:g}" for key, sign in bounds.items() if key in schema)])


def _value_text(value: Any) -> str:
    """A default as TOML writes it; what TOML has no word for is an empty cell."""
    if isinstance(value, Enum):
        value = value.value
    if isinstance(value, bool):
        return f"`{str(value).lower()}`"
    if value is None or value == {}:
        return ""
    if isinstance(value, str):
        return f'`"{value}"`'
    if isinstance(value, list | tuple):
        return f"`[{', '.join(_value_text(item).strip('`') for item in value)}]`"
    return f"`{value}`"


def _command(command: Command) -> str:
    loaded = command.load()
    # The help of a group is its stage's, with all settings.
    is_group = hasattr(loaded, "commands")
    text = command.stage().help if command.is_stage else command.help if is_group else loaded.help or command.help
    lines = [f"\n### groundwalk {command.name}\n\n{_cell(text)}\n"]
    if command.is_stage:
        section = command.name
        lines.append(f"\nSettings: [`[{section}]`](settings.md#{section}).\n")
    rows = [_option(parameter) for parameter in loaded.params if not parameter.hidden]
    lines.append("\n| option | type | default | what it does |\n|---|---|---|---|\n")
    return "".join([*lines, *rows])


def _option(parameter: Any) -> str:
    flag = getattr(parameter, "is_flag", False)
    annotation = parameter.type_descriptor.annotation
    choices = [str(item.value) for item in annotation] if _is_enum(annotation) else []
    kind = "" if flag else ", ".join(choices) or _KINDS.get(annotation, "text")
    default = "" if flag else _option_default(parameter)
    names = ", ".join(f"`{name}`" for name in parameter.opts)
    return f"| {names} | {kind} | {default} | {_cell(parameter.help or '')} |\n"


def _option_default(parameter: Any) -> str:
    if parameter.required:
        return "required"
    if isinstance(parameter.show_default, str):
        return parameter.show_default
    default = parameter.default
    return _value_text(str(default) if isinstance(default, Path) else default).replace('"', "") if default != "" else ""


def _is_enum(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, Enum)


_KINDS: dict[Any, str] = {int: "whole number", float: "number", Path: "path", list[str]: "text, repeatable"}


def _cell(text: str) -> str:
    """Text as Markdown on one line, for a cell of a table, too: outside of code, < begins no tag."""
    parts = " ".join(text.replace("|", "\\|").split()).split("`")
    return "`".join(part if i % 2 else part.replace("<", "\\<") for i, part in enumerate(parts))
