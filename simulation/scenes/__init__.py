"""The places that can be simulated, one module each, with the extents of the paper's Table I."""

from dataclasses import dataclass
from importlib import import_module

from groundwalk.simulation.place import Place
from groundwalk.simulation.walks import Route

NAMES = ("Square", "Church", "Bar", "Stairs", "Office", "Atrium")


@dataclass(frozen=True)
class SceneryPlan:
    """A place, the course of the walks through it, and the name of the folder where its mesh is kept."""

    place: Place
    route: Route
    mesh: str = "mesh"


def scenery(name: str, seed: int) -> SceneryPlan:
    """Build the place `name`, one of NAMES."""
    module = import_module(f"groundwalk.simulation.scenes.{name.lower()}")
    return SceneryPlan(module.build(seed), module.ROUTE)
