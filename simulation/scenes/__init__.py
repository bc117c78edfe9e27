"""The places that can be simulated, one module each, with the extents of the paper's Table I."""

import tomllib
from importlib import import_module
from pathlib import Path

from groundwalk.simulation.place import Route, SceneryPlan

NAMES = ("Square", "Church", "Bar", "Stairs", "Office", "Atrium")
_ROUTES = Path(__file__).parents[1] / "routes.toml"


def scenery(name: str, seed: int) -> SceneryPlan:
    """Build the place `name`, one of NAMES."""
    module = import_module(f"groundwalk.simulation.scenes.{name.lower()}")
    routes = tomllib.loads(_ROUTES.read_text(encoding="utf-8"))
    return SceneryPlan(module.build(seed), Route(**routes[name]))
