"""The walks of a simulated scene without pictures, at one pose a second: what fusion needs, in a second or two."""

import zlib
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array, inverse
from groundwalk.simulation.scenes import scenery
from groundwalk.simulation.session import outline
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.simulation.vio import start_frame
from groundwalk.simulation.walks import plan_walk
from groundwalk.store import DataRoot
from groundwalk.store.settings import SHIPPED_DATA, resolve_settings

_SEED = 0


@dataclass(frozen=True, eq=False)
class PoseWalk:
    """A walk's name, times t_ns (N,) and true poses map_T_cam (N, 4, 4), the map with +y up."""

    name: str
    t_ns: NDArray[np.int64]
    map_T_cam: Array


@cache
def pose_walks(scene: str) -> list[PoseWalk]:
    """The test walks, with as many images as Table I lists.

    The map is that of the ground truth: its origin is where the first session began. UserError for an unknown scene.
    """
    settings = resolve_settings(SimulateSettings, "simulate", DataRoot(SHIPPED_DATA), "paper", scene, [])
    plan = scenery(scene, _SEED)
    walks = []
    for session in outline(settings, scene, _SEED):
        rng = np.random.default_rng([_SEED, zlib.crc32(f"{scene}/{session.name}".encode())])
        seconds = np.arange(session.images) / settings.image_hz
        walk = plan_walk(plan.route, plan.place, session.images / settings.image_hz, session.side, session.start, rng)
        t_ns = np.round((session.boot_s + seconds) * 1e9).astype(np.int64)
        walks.append(PoseWalk(session.name, t_ns, walk.world_T_cam(seconds)))
    map_T_world = inverse(start_frame(min(walks, key=lambda w: w.name).map_T_cam[0]))
    tested = [w for w in walks if w.name.startswith("test-")]
    return [PoseWalk(w.name, w.t_ns, map_T_world @ w.map_T_cam) for w in tested]
