"""Every setting of every stage and entry: another type is refused, with the key and the file."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from groundwalk.cli import stage_of
from groundwalk.fusion.methods import METHODS
from groundwalk.localisation.localisers import LOCALISERS
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.store import DataRoot, Settings, UserError
from groundwalk.store.settings import STAGES, resolve_settings
from groundwalk.training.regressors import REGRESSORS
from tests.known import written

# A value of each type of JSON schema, as TOML.
VALUES = {"boolean": "true", "integer": "1", "number": "0.5", "string": "'1'", "array": "[['1']]", "object": "{x = 1}"}
SECTIONS: dict[str, type[Settings]] = {
    "simulate": SimulateSettings,
    **{stage: stage_of(stage).settings for stage in STAGES},
    **{f"train.regressors.{name}": REGRESSORS[name].settings for name in REGRESSORS},
    **{f"localise.localisers.{name}": LOCALISERS[name].settings for name in LOCALISERS},
    **{f"fuse.options.{name}": METHODS[name].options for name in METHODS},
}
ALSO = {("predictions", "string")}  # one file instead of a list


def types(schema: dict[str, Any], definitions: dict[str, Any]) -> set[str]:
    """The types that a setting's JSON schema allows."""
    schema = definitions[schema["$ref"].rpartition("/")[2]] if "$ref" in schema else schema
    if "anyOf" in schema:
        return set().union(*(types(option, definitions) for option in schema["anyOf"]))
    return {schema["type"], *(["integer"] if schema["type"] == "number" else [])}


def wrong_values(model: type[Settings]) -> Iterator[tuple[str, str]]:
    """Each setting with a value of each type that it doesn't have, also as an item of a list."""
    schema = model.model_json_schema()
    definitions = schema.get("$defs", {})
    for key, of_key in schema.get("properties", {}).items():
        allowed = types(of_key, definitions)
        for kind, value in VALUES.items():
            if kind not in allowed and (key, kind) not in ALSO:
                yield key, value
        if of_key.get("items"):
            of_item = types(of_key["items"], definitions)
            yield from ((key, f"[{value}]") for kind, value in VALUES.items() if kind not in of_item)


def said_of(section: str, setting: str, data: DataRoot) -> str:
    written(data.root / "scenes" / "place.toml", f"[{section}]\n{setting}\n")
    stage = section.split(".")[0]
    try:
        resolve_settings(SECTIONS[stage], stage, data, "empty", "place", [])
    except UserError as error:
        return str(error)
    return "accepted"


@pytest.mark.parametrize("section", SECTIONS)
def test_a_setting_of_another_type_is_refused(section: str, tmp_path: Path) -> None:
    data = DataRoot(tmp_path)
    written(tmp_path / "profiles" / "empty.toml", "")
    tried = list(wrong_values(SECTIONS[section]))
    assert len(tried) >= 4 * len(SECTIONS[section].model_fields)
    for key, value in tried:
        said = said_of(section, f"{key} = {value}", data)
        assert key in said and f"{tmp_path}/scenes/place.toml" in said, f"{key} = {value}: {said}"
