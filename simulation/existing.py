"""The captures of a scene that are there: whether the simulator made them, and of the same settings."""

import hashlib
import json
from pathlib import Path
from typing import Any

from groundwalk.simulation.settings import SimulateSettings
from groundwalk.store.errors import UserError
from groundwalk.store.files import file_names, finish_interrupted_swap, partial_folder, refuse_irreplaceable
from groundwalk.store.locks import locked
from groundwalk.store.settings import DataRoot, resolve_settings
from groundwalk.store.simulated import SIMULATED_MARKER, marker_of, simulated_files
from groundwalk.store.text import name_list

VERSION = 5  # goes up when the same settings give other captures


def key_of(scene: str, settings: SimulateSettings, seed: int) -> tuple[str, dict[str, Any]]:
    """A hash of everything that simulated captures depend on, and what that is."""
    parts = {"version": VERSION, "scene": scene, "seed": seed, "settings": settings.model_dump(mode="json")}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest(), parts


def is_up_to_date(scene: str, profile: str, data: DataRoot) -> bool:
    """Whether `simulate` without overrides, seed and force would do nothing. UserError as it raises it."""
    settings = resolve_settings(SimulateSettings, "simulate", data, profile, scene)
    final = data.captures(scene)
    with locked(final):
        return is_made(final, key_of(scene, settings, 0)[0])


def is_made(final: Path, key: str) -> bool:
    """Whether captures of this key are there. What a killed run left undone is done; UserError where a capture folder
    can't be put there, or the simulator didn't write what is there."""
    for folder in (final, partial_folder(final)):
        refuse_irreplaceable(folder)
    finish_interrupted_swap(final, SIMULATED_MARKER, simulated_files)
    marker = _simulator_marker(final)
    return marker is not None and marker.get("key") == key


def _simulator_marker(folder: Path) -> dict[str, Any] | None:
    """The marker of a simulated capture folder, None for an absent or empty folder; UserError for anything else."""
    if not folder.exists() or not any(folder.iterdir()):
        return None
    marker = marker_of(folder)
    if not marker:
        raise UserError(
            "the captures of this scene aren't simulated, and the simulator doesn't replace them",
            where=folder,
            expected=f"an empty folder, or one with {SIMULATED_MARKER}",
            do="use them as they are, or move them away to simulate this scene",
        )
    files = simulated_files(folder)
    if not files:
        found = f"{SIMULATED_MARKER} doesn't list its sessions"
        raise UserError("the marker of simulated captures is damaged", where=folder, found=found)
    if foreign := sorted({*file_names(folder)} - files):
        found, do = name_list(foreign, 3), "move them away"
        raise UserError("the folder of simulated captures holds other files", where=folder, found=found, do=do)
    return marker
