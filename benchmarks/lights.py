"""The test walks of a simulated capture in the simulator's other lights, pose by pose.

Only images are made, with the capture's settings and seed: the walks are the same in every light, so that the ground
truth of the capture's frames is theirs, too.
"""

from pathlib import Path
from typing import Any

import numpy as np

from groundwalk.simulation.settings import SimulateSettings
from groundwalk.simulation.simulate import plan_sessions, render_images, write_truth
from groundwalk.store import UserError
from groundwalk.store.choices import Appearance
from groundwalk.store.files import read_json
from groundwalk.store.schemas import schema
from groundwalk.store.simulated import SIMULATED_MARKER, TRUE_POSES, appearances_of
from groundwalk.store.tables import poses_of, read_table


def frames_in(captures: Path, appearance: Appearance, out: Path, processes: int) -> None:
    """Images of a simulated capture's test walks in a light, in folders of `out` named by session; those that are there
    are kept. UserError where the capture isn't simulated, or was simulated by another version."""
    marker = _marker(captures)
    settings = SimulateSettings.model_validate({**marker["settings"], "appearances": [appearance]})
    indoor, seed = marker["environment"] == "indoor", marker["seed"]
    out.mkdir(parents=True, exist_ok=True)
    sessions = plan_sessions(marker["scene"], settings, indoor, out, seed, test_only=True)
    write_truth(out, sessions)
    here, there = (read_table(folder / TRUE_POSES, schema("simulate", "true_poses")) for folder in (out, captures))
    there = there[there["session_id"].isin(here["session_id"])].reset_index(drop=True)
    same = here[["session_id", "t_ns"]].equals(there[["session_id", "t_ns"]])
    if not (same and np.array_equal(poses_of(here, "map_cam"), poses_of(there, "map_cam"))):
        raise UserError("the capture's test walks aren't those of this simulator", where=captures, do="simulate again")
    render_images([shot for session in sessions for shot in session.shots], settings, out, processes)


def _marker(captures: Path) -> dict[str, Any]:
    marker = read_json(captures / SIMULATED_MARKER)
    if set(appearances_of(captures).values()) != {Appearance.SAME}:
        raise UserError(
            "this isn't a simulated capture whose test walks have the training walks' light",
            where=captures / SIMULATED_MARKER,
            do="simulate the scene with appearances same alone",
        )
    return marker
