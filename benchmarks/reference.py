"""The generated pages of docs, the reference, from the code that defines it: `make docs`."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any

from benchmarks.results import markdown_table
from groundwalk.alignment.checks.definitions import DEFINITIONS
from groundwalk.alignment.settings import AprilTagRuler, CharucoRuler, ControlSettings, DistanceRuler
from groundwalk.cli import COMMANDS, stages
from groundwalk.fusion.methods import METHODS
from groundwalk.localisation.localisers import LOCALISERS
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.store.choices import FailureCause
from groundwalk.store.registry import Registry
from groundwalk.store.schemas import TableSchema, all_tables
from groundwalk.store.settings import SceneConfig, Settings, SplitRules
from groundwalk.training.regressors import REGRESSORS

RULERS: dict[str, type[Settings]] = {"charuco": CharucoRuler, "apriltag": AprilTagRuler, "distance": DistanceRuler}
_DOCS = Path(__file__).resolve().parents[1] / "docs"
WRITTEN_BY = "This page is written by `make docs`."
_SETTING = ["setting", "type and range", "default", "description"]

_TABLES_HEAD = f"""# Tables

What each stage leaves in `data/runs/<profile>/<scene>/<stage>/`: the tables below as Parquet, `recording.rrd` (a view
of them, with its blueprint) and `manifest.json` (inputs with hashes, resolved settings, versions, seed, git revision,
machine, seconds a step, figures). Parquet is the truth; each column carries its unit, frame and meaning as metadata.
A table's version is `major.minor`; a reader refuses another major.

A pose group is seven columns: `map_cam_*` stands for `map_cam_tx, _ty, _tz` (metres) and `map_cam_qx, _qy, _qz, _qw`
(unit quaternion, w ≥ 0), the pose map_T_cam. [conventions.md](conventions.md) says what the frames are.

Where nothing gave a map metric scale (`scale_source` of align.ground_truth: none, or reference, unit unknown), what is
in m in its frame is in the map's own unit.

{WRITTEN_BY}
"""
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


def reference_pages() -> dict[str, str]:
    """The generated pages by path in docs/."""
    return {
        "reference/tables.md": _tables(),
        "reference/settings.md": _SETTINGS_HEAD + "".join(f"\n## {a}\n\n{b}\n\n{c}" for a, b, c in _sections()),
        "reference/commands.md": _COMMANDS_HEAD + "".join(_commands()),
        "reference/checks.md": _CHECKS_HEAD + "".join(_checks()),
    }


def _tables() -> str:
    """Every table with its columns."""
    parts = [_TABLES_HEAD]
    stage = ""
    for table in all_tables():
        if table.stage != stage:
            stage = table.stage
            parts.append(f"\n## {stage}\n")
        parts.append(f"\n### {table.name} ({table.version})\n\n{table.meaning}\n\n")
        parts.append(_table(["column", "type", "unit", "frame", "meaning"], _columns(table)))
    return "".join(parts)


def _columns(table: TableSchema) -> Iterator[list[str]]:
    """A row a column; a pose group is one row."""
    groups = {name.removesuffix("_qw") for name in table.column_names if name.endswith("_qw")}
    for column in table.columns:
        prefix, _, part = column.name.rpartition("_")
        kind = f"{column.dtype}{' or null' if column.nullable else ''}"
        if prefix not in groups or len(part) != 2:
            meaning = f"{column.meaning}: {', '.join(column.choices)}" if column.choices else column.meaning
            yield [f"`{column.name}`", kind, column.unit, column.frame, meaning]
        elif part == "tx":
            meaning = column.meaning.removesuffix(": position, x")
            yield [f"`{prefix}_*`", kind, "m, unit quaternion", column.frame, meaning]


def _commands() -> Iterator[str]:
    """Every command of `groundwalk` with its arguments and options."""
    for panel, commands in COMMANDS.items():
        yield f"\n## {panel}\n"
        for command in commands:
            loaded = command.load()
            # The help of a group is its stage's, with all settings.
            is_group = hasattr(loaded, "commands")
            text = command.stage().help if command.is_stage else command.help if is_group else loaded.help
            yield f"\n### groundwalk {command.name}\n\n{_cell(text or command.help)}\n"
            if command.is_stage:
                yield f"\nSettings: [`[{command.name}]`](settings.md#{command.name}).\n"
            options = map(_option, (parameter for parameter in loaded.params if not parameter.hidden))
            yield "\n" + _table(["option", "type", "default", "what it does"], options)


def _checks() -> Iterator[str]:
    """Every check of align with what it estimates and what to do, and the causes in their order."""
    rows = (
        [f"`{name}`", *map(_cell, (check.estimate, check.unit, check.remedy, check.evidence))]
        for name, check in DEFINITIONS.items()
    )
    yield "\n## Checks\n\n" + _table(["check", "estimates", "unit", "where it failed", "what would decide it"], rows)
    yield "\n## Causes\n\nWhat a failure says is wrong, column `cause`. The first in this order names the run.\n\n"
    yield from (f"{number}. {_cell(str(cause))}\n" for number, cause in enumerate(FailureCause, 1))


def _sections() -> Iterator[tuple[str, str, str]]:
    """Title, introduction and table of each section of settings."""
    yield "A scene's file", "At the top of `data/scenes/<scene>.toml`.", _settings(SceneConfig, {"name", "split"})
    yield "[split]", "In a scene's file: which sessions train and which test.", _settings(SplitRules)
    yield "[simulate]", "How a scene's captures are simulated.", _settings(SimulateSettings)
    for stage in stages():
        yield f"[{stage.name}]", stage.help, _settings(stage.settings)
        if stage.name == "align":
            for kind, model in RULERS.items():
                (text, *_) = (model.__doc__ or "").strip().splitlines()
                text += " In a scene's file, any number of these: [rulers](../how-to/ruler.md)."
                yield f'[[ruler]] of kind "{kind}"', text, _settings(model, {"kind"})
            text = "In a scene's file, any number of these: [control points](../how-to/control-points.md)."
            yield "[[control]]", text, _settings(ControlSettings)
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
        for name, kind, default, text in _rows(model, ""):
            rows.setdefault((name, kind, text), {}).setdefault(default or "none", []).append(entry_id)
    listed = "\n".join(f"- `{entry_id}`: {_cell(registry[entry_id].meaning)}" for entry_id in models)
    lines = []
    for (name, kind, text), defaults in rows.items():
        owners = [entry_id for ids in defaults.values() for entry_id in ids]
        # The default of most is said without names where every entry has the setting.
        common = max(defaults, key=lambda default: len(defaults[default])) if len(owners) == len(models) > 1 else None
        others = [f"{', '.join(ids)}: {default}" for default, ids in defaults.items() if default != common]
        lines.append([f"`{name}`", kind, "; ".join(filter(None, [common, *others])), _cell(text)])
    table = _table(_SETTING, lines) if lines else "None has settings.\n"
    return f"[{section}.<name>]", f"`<name>` is one of these:\n\n{listed}", table


def _settings(model: type[Settings], without: Collection[str] = ()) -> str:
    rows = [row for row in _rows(model, "") if row[0].split(".")[0] not in without]
    lines = ([f"`{name}`", kind, default, _cell(text)] for name, kind, default, text in rows)
    return _table(_SETTING, lines) if rows else "It has no settings.\n"


def _rows(model: type[Settings], prefix: str) -> Iterator[tuple[str, str, str, str]]:
    """Name, type, default and description of each setting; a section inside gives a row for each of its own."""
    schema = model.model_json_schema()
    for name, field in model.model_fields.items():
        value = field.get_default(call_default_factory=True) if not field.is_required() else None
        if isinstance(value, Settings):
            for row_name, kind, _, text in _rows(type(value), f"{prefix}{name}."):
                yield row_name, kind, _value_text(getattr(value, row_name.rpartition(".")[2])), text
            continue
        default = "required" if field.is_required() else _value_text(value)
        kind = _kind(schema["properties"][name], schema.get("$defs", {}))
        yield f"{prefix}{name}", kind, default, field.description or ""


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


def _option(parameter: Any) -> list[str]:
    """An option's names, type, default and help."""
    annotation, value = parameter.type_descriptor.annotation, parameter.default
    is_enum = isinstance(annotation, type) and issubclass(annotation, Enum)
    kind = ", ".join(str(item.value) for item in annotation) if is_enum else _KINDS.get(annotation, "text")
    default = _value_text(str(value) if isinstance(value, Path) else value).replace('"', "") if value != "" else ""
    if parameter.required:
        default = "required"
    elif isinstance(parameter.show_default, str):
        default = parameter.show_default
    if getattr(parameter, "is_flag", False):
        kind = default = ""
    return [", ".join(f"`{name}`" for name in parameter.opts), kind, default, _cell(parameter.help or "")]


_KINDS: dict[Any, str] = {int: "whole number", float: "number", Path: "path", list[str]: "text, repeatable"}


def _table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return markdown_table([heading, *rows]) + "\n"


def _cell(text: str) -> str:
    """Text as Markdown on one line, for a cell of a table, too: outside of code, < begins no tag."""
    parts = " ".join(text.split()).split("`")
    return "`".join(part if i % 2 else part.replace("<", "\\<") for i, part in enumerate(parts))


if __name__ == "__main__":
    for _name, _page in reference_pages().items():
        (_DOCS / _name).write_text(_page, encoding="utf-8")
