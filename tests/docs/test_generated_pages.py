"""The generated pages follow the code, and every profile's settings are settings that there are."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from benchmarks.reference import RULERS, reference_pages
from groundwalk.capture_import.formats import FORMATS
from groundwalk.cli import all_commands
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.store import DataRoot, Settings
from groundwalk.store.settings import SHIPPED_DATA, SceneConfig, SplitRules, resolve_settings

DOCS = Path(__file__).resolve().parents[2] / "docs"
REFERENCE = DOCS / "reference"
SECTIONS = {"simulate": SimulateSettings} | {c.name: c.stage().settings for c in all_commands() if c.is_stage}


@pytest.mark.parametrize("name", reference_pages())
def test_a_generated_page_is_up_to_date(name: str) -> None:
    assert (DOCS / name).read_text(encoding="utf-8") == reference_pages()[name], "run `make docs`"


def fields(model: type[Settings], name: str) -> Iterator[tuple[str, Any]]:
    for key, field in model.model_fields.items():
        default = field.get_default(call_default_factory=True) if not field.is_required() else None
        if isinstance(default, Settings):
            yield from fields(type(default), f"{name}.{key}")
        else:
            yield f"{name}.{key}", field


def test_each_setting_has_a_description() -> None:
    models = {"scene": SceneConfig, "split": SplitRules, **SECTIONS, **RULERS}
    named = [pair for name, model in models.items() for pair in fields(model, name)]
    assert len(named) > 100
    for name, field in named:
        assert field.description or name.rpartition(".")[2] in ("kind", "name"), f"{name} has no description"


def test_each_capture_format_is_in_the_table() -> None:
    lines = (REFERENCE / "capture-formats.md").read_text(encoding="utf-8").splitlines()
    start = lines.index(next(line for line in lines if line.startswith("| name | app")))
    rows = [line.split("`")[1] for line in lines[start + 2 :][: len(FORMATS.builtin)]]
    assert rows == list(FORMATS.builtin)


@pytest.mark.parametrize("profile", DataRoot(SHIPPED_DATA).names("profiles"))
def test_each_profile_s_settings_are_settings_of_their_stages(profile: str) -> None:
    for section, model in SECTIONS.items():
        resolved = resolve_settings(model, section, DataRoot(SHIPPED_DATA), profile, "Church", [])
        assert isinstance(resolved, model)
