"""Names, messages, help and docs keep to the glossary: words that were retired don't come back."""

import ast
import re
import tomllib
from collections.abc import Iterator
from enum import EnumType
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from groundwalk.cli import all_commands, stages
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.store import Settings, choices
from groundwalk.store.schemas import all_tables
from groundwalk.store.settings import SplitRules
from groundwalk.training.regressors import REGRESSORS

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = [path.parent for path in ROOT.glob("*/__init__.py") if path.parent.name not in ("tests", "benchmarks")]
# What must not be in a name or text, and what is written instead.
RETIRED = {
    r"per_root": "per_sqrt",
    r"look-alike|folded together": "perceptual aliasing",
    r"\bgate\.p(ng|arquet)|align's gate|the gate (took|lets|catches)": "checks",
    r"broken off": "disconnected",
    r"times shuffled": "images and poses mismatched",
    r"bridge_(m|deg)\b|\bunsure\b": "vio_link_, uncertain",
    r"heldout": "held_out",
    r"second hearing": "fitted again",
    r"\bsure enough\b": "certain",
    r"\bladder\b": "attempts",
    r"moves? otherwise|moving as VIO|disagrees? with VIO": "inconsistent with VIO",
    r"\bkept out\b": "excluded",
    r"needs VIO's word|nothing speaks against": "consistent",
    r"safe point": "checkpoint",
}
# The same in names alone: in a sentence these are plain English.
RETIRED_NAMES = {
    r"(^|_)(told|own|found|taken|shown|kept|wanted|blamed|spoilt|chosen)(_|$)": "a noun that says what it is",
    r"(^|_)(least|most|fewest|largest|farthest)_": "min_ or max_",
    r"(^|_)share(_|$)": "fraction",
    r"(^|_)(verdict|gate|stretch|rung|sighting)(_|$)": "status, checks, segment, attempt, detection",
    r"(^|_)(unsure|folded)(_|$)": "uncertain, aliased",
}
# Tables and settings that still have such a name: a list that may only become shorter.
PENDING: set[str] = set()


# Participles and pronouns that say nothing of what they name, in code; `found` is one of an error's parts.
RETIRED_IN_CODE = re.compile(r"(^|_)(told|own|found|taken|shown|blamed)(_|$)")
ALLOWED_IN_CODE = {("groundwalk/store/errors.py", "found")}


def settings_texts() -> Iterator[tuple[str, str]]:
    """Names and descriptions of all settings."""
    for package in PACKAGES:
        for path in (*package.rglob("*settings.py"), *package.rglob("stage.py")):
            module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            for value in vars(import_module(f"groundwalk.{module}")).values():
                if isinstance(value, type) and issubclass(value, BaseModel) and value is not Settings:
                    for name, field in value.model_fields.items():
                        yield name, field.description or ""


def table_texts() -> Iterator[tuple[str, str]]:
    """Names and meanings of all tables and columns, and what text columns can hold."""
    for table in all_tables():
        yield table.name, table.meaning
        for column in table.columns:
            yield column.name, column.meaning
            yield from (("", text) for text in column.choices or ())


def help_texts() -> Iterator[tuple[str, str]]:
    """Options and help of all commands."""
    for command in all_commands():
        loaded: Any = command.load()
        yield command.name, f"{command.help}\n{loaded.help}"
        yield from ((option.name, getattr(option, "help", None) or "") for option in loaded.params)


def message_texts() -> Iterator[tuple[str, str]]:
    """What UserErrors say: the text in each call that makes one."""
    for path in (path for package in PACKAGES for path in package.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "UserError":
                parts = (n.value for n in ast.walk(node) if isinstance(n, ast.Constant) and isinstance(n.value, str))
                yield "", "\n".join(parts)


def choice_texts() -> Iterator[tuple[str, str]]:
    """All enumerations of texts that are written to files."""
    for value in vars(choices).values():
        if isinstance(value, EnumType) and value.__module__ == choices.__name__:
            yield from (("", str(text)) for text in list[Any](value))


def doc_texts() -> Iterator[tuple[str, str]]:
    """The pages of docs/, without what is generated or measured."""
    for path in (*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")):
        if path.name != "artefacts.md" and "results" not in path.parts:
            yield "", path.read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("texts", "at_least"),
    [
        (settings_texts, 150),
        (table_texts, 300),
        (help_texts, 100),
        (message_texts, 150),
        (choice_texts, 20),
        (doc_texts, 20),
    ],
)
def test_no_retired_word(texts: Any, at_least: int) -> None:
    read = list(texts())
    assert len(read) >= at_least
    wrong = [
        f"{match.group()!r} in {name or text[max(0, match.start() - 60) : match.end() + 60]!r}: {instead}"
        for name, text in read
        for pattern, instead in RETIRED.items()
        for match in (*re.finditer(pattern, name), *re.finditer(pattern, text, re.IGNORECASE))
    ]
    wrong += [
        f"{name}: {why}"
        for name, _ in read
        for word, why in RETIRED_NAMES.items()
        if re.search(word, name) and name not in PENDING
    ]
    assert not wrong, "\n".join(wrong)


def test_pending_names_are_still_there() -> None:
    names = {name for texts in (settings_texts, table_texts) for name, _ in texts()}
    assert names >= PENDING


@pytest.mark.parametrize("name", ["vio_drift_deg_per_root_m", "heldout_px", "told_px", "least_step", "frame_share"])
def test_retired_words_are_seen(name: str) -> None:
    assert any(re.search(word, name) for word in (*RETIRED, *RETIRED_NAMES))


@pytest.mark.parametrize("name", ["held_out_px", "download_s", "unknown", "shared", "at_least"])
def test_other_words_are_left(name: str) -> None:
    assert not any(re.search(word, name) for word in (*RETIRED, *RETIRED_NAMES))


def names_bound(path: Path) -> Iterator[str]:
    """What a module names: variables, parameters, attributes, functions and classes."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield name
            case ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                yield name


@pytest.mark.parametrize("package", [*PACKAGES, ROOT / "benchmarks"], ids=lambda package: package.name)
def test_names_in_code_are_nouns(package: Path) -> None:
    wrong = {
        (path.relative_to(ROOT).as_posix(), name)
        for path in package.rglob("*.py")
        for name in names_bound(path)
        if RETIRED_IN_CODE.search(name)
    }
    assert wrong <= ALLOWED_IN_CODE


# A scene's sections, and what each may hold.
SECTIONS: dict[str, type[Settings]] = {
    "split": SplitRules,
    "simulate": SimulateSettings,
    **{stage.name: stage.settings for stage in stages()},
    **{f"train.regressors.{name}": entry.settings for name, entry in REGRESSORS.items()},
}


def texts_in_code() -> Iterator[str]:
    """All strings of the packages but docstrings and descriptions of settings."""
    for path in (path for package in PACKAGES for path in package.rglob("*.py")):
        nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
        unsaid = [n.value for n in nodes if isinstance(n, ast.Expr)]
        unsaid = [value for value in unsaid if isinstance(value, ast.Constant)]
        descriptions = [n.value for n in nodes if isinstance(n, ast.keyword) and n.arg == "description"]
        left_out = {id(part) for value in (*unsaid, *descriptions) for part in ast.walk(value)}
        yield from (
            n.value for n in nodes if isinstance(n, ast.Constant) and type(n.value) is str and id(n) not in left_out
        )


def settings_without_a_file(text: str) -> list[str]:
    """Settings as `sfm.max_features` or `[sfm] max_features`: neither says in which file. A text that is nothing but a
    name is a key; tables are named `import.frames`, too."""
    tables = {f"{table.stage}.{table.name}" for table in all_tables()}
    dotted = [".".join(pair) for pair in re.findall(r"(?<![\w./])(\w+)\.(\w+)(?!\.)\b", text)]
    names = {f"{section}.{name}" for section, settings in SECTIONS.items() for name in settings.model_fields}
    bracketed = re.findall(rf"\[(?:{'|'.join(stage.name for stage in stages())})\b[\w.-]*\](?!\()", text)
    return bracketed + [name for name in dotted if name in names - tables and name != text]


def test_a_setting_is_named_with_its_file() -> None:
    """`setting_of` makes the text, and knows where."""
    read = list(texts_in_code())
    assert len(read) > 5000
    assert not [(name, text) for text in read for name in settings_without_a_file(text)]


@pytest.mark.parametrize("text", ["a larger sfm.max_features", " (import.min_frames): ", "set it in [import]"])
def test_a_setting_without_a_file_is_seen(text: str) -> None:
    assert settings_without_a_file(text)


def test_settings_that_advice_names_are_there() -> None:
    """With the value that it advises, too."""
    calls = [
        [argument.value for argument in node.args if isinstance(argument, ast.Constant)]
        for path in (path for package in PACKAGES for path in package.rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "setting_of"
    ]
    advised = [(str(call[0]), str(call[1])) for call in calls if len(call) == 2]
    assert len(advised) > 35
    for section, setting in advised:
        settings = SECTIONS[section.replace("<model>", "PN")]
        content = tomllib.loads(setting) if "=" in setting else {}
        assert setting.split(" = ")[0] in settings.model_fields
        settings.model_validate(content)
