"""Small simulated captures for `benchmarks.gates`: three walks over the same stretch of a place, and a corridor whose
stretches look alike."""

import shutil
import zlib
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from groundwalk.simulation import details, materials
from groundwalk.simulation.atlas import TexturedMesh
from groundwalk.simulation.canvas import Canvas, Material
from groundwalk.simulation.mesh import build_mesh
from groundwalk.simulation.place import Light, Route, SceneryPlan
from groundwalk.simulation.render import Renderer
from groundwalk.simulation.scenes import scenery
from groundwalk.simulation.scenes.builder import Builder
from groundwalk.simulation.session import SessionOutline, plan_session, take, write_frames
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.simulation.simulate import write_truth
from groundwalk.store.files import write_json
from groundwalk.store.simulated import SIMULATED_MARKER

CORRIDOR = "Corridor"
_LENGTH_M, _WIDTH_M, _HEIGHT_M = 44.0, 2.4, 2.6
_SETTINGS = SimulateSettings(width=320, texel_m=0.03, supersampling=1)
# Seconds of a walk, with one picture a second.
_WALK_S = {"Stairs": 24, "Office": 24, CORRIDOR: 34}
_OTHER_WALK_S = 20


@dataclass(frozen=True)
class Capture:
    """Which capture: a place, a seed, how many walks, and how long one is where it is short and slow, metres."""

    place: str
    seed: int
    walks: int = 3
    length_m: float | None = None

    @property
    def name(self) -> str:
        """The folder's name."""
        short = "" if self.length_m is None else f"-{self.length_m:g}m"
        return f"{self.place}-{self.seed}-{self.walks}{short}"


def write_capture(folder: Path, capture: Capture, plan: SceneryPlan | None = None) -> None:
    """Render a capture into `folder`, which must not be there, with its true poses beside it; through `plan` where its
    place isn't one of ours."""
    if plan is None:
        plan = _corridor(capture.seed) if capture.place == CORRIDOR else scenery(capture.place, capture.seed)
    if capture.length_m is not None:
        speed_mps = capture.length_m / _seconds(capture)
        plan = SceneryPlan(plan.place, replace(plan.route, speed_mps=speed_mps, spread_m=0.1, far_glances=0.0))
    work = folder.with_name(f".{folder.name}.partial")
    work.mkdir(parents=True, exist_ok=True)
    build_mesh(plan.place, _SETTINGS.texel_m, capture.seed, lambda items, _: items).save(work / ".mesh")
    renderer = Renderer(TexturedMesh.load(work / ".mesh"))
    sessions = []
    for outline in _outlines(capture):
        target = work / outline.name
        target.mkdir(exist_ok=True)
        indoor = capture.place in (CORRIDOR, "Stairs", "Office", "Atrium")
        session = plan_session(outline, plan, _SETTINGS, indoor, renderer, target, capture.seed)
        for shot in session.shots:
            take(shot, renderer, _SETTINGS)
        write_frames(target, session.frames)
        sessions.append(session)
    write_truth(work, sessions)
    write_json(work / SIMULATED_MARKER, {"what": "Simulated capture for benchmarks.gates", **vars(capture)})
    shutil.rmtree(work / ".mesh")
    work.rename(folder)


def _outlines(capture: Capture) -> list[SessionOutline]:
    """Walks over the same stretch, side by side, begun a step apart, hours after each other."""
    rng = np.random.default_rng([capture.seed, zlib.crc32(capture.place.encode())])
    start = 0.0 if capture.place == CORRIDOR else float(rng.uniform())
    seconds = _seconds(capture)
    sides = np.linspace(-0.7, 0.7, capture.walks) if capture.walks > 1 else [0.0]
    boots = 20_000 + np.cumsum(rng.uniform(5_000, 20_000, capture.walks))
    return [
        SessionOutline(f"walk-{k + 1}", seconds, float(side), start + 0.01 * k, float(boot))
        for k, (side, boot) in enumerate(zip(sides, boots, strict=True))
    ]


def _seconds(capture: Capture) -> int:
    return _WALK_S.get(capture.place, _OTHER_WALK_S)


def _corridor(seed: int) -> SceneryPlan:
    """A straight corridor of equal stretches: the same doors, the same pictures, the same floor, again and again; one
    notice in each is its own."""
    rng = np.random.default_rng([seed, 7])
    period = float(rng.uniform(4.0, 6.0))

    b = Builder(CORRIDOR, (_WIDTH_M, _LENGTH_M), _HEIGHT_M, Light(0.9), seed, 0.6)
    x, end = _WIDTH_M / 2, _LENGTH_M / 2
    edges = np.append(np.arange(-end, end - 0.5, period), end)
    for k, (low, high) in enumerate(pairwise(edges)):
        b.wall(f"west{k}", (-x, high), (-x, low), 0, _HEIGHT_M, _repeated(seed, period, k, 0))
        b.wall(f"east{k}", (x, low), (x, high), 0, _HEIGHT_M, _repeated(seed + 1, period, k, 1))
        b.floor(f"floor{k}", (-x, low), (x, high), 0, _same(seed + 2, materials.tiles(0.5, _STONE, (70, 74, 78))))
        b.ceiling(f"ceiling{k}", (-x, low), (x, high), _HEIGHT_M, _same(seed + 3, materials.panels((200, 204, 206))))
    for name, left, right in (("north", (-x, -end), (x, -end)), ("south", (x, end), (-x, end))):
        b.wall(name, left, right, 0, _HEIGHT_M, materials.plaster((170, 190, 200), 0.6))
    far = end - 1.2
    route = Route([(0.25, far, 0), (0.25, 0.0, 0), (0.25, -far, 0), (-0.25, -far, 0), (-0.25, 0.0, 0), (-0.25, far, 0)])
    return SceneryPlan(b.place, replace(route, spread_m=0.2, speed_mps=1.1, look_deg=10, far_glances=0.0))


_STONE = [(150, 162, 170), (120, 132, 142), (96, 110, 126)]


def _same(seed: int, paint: Material) -> Material:
    """The material painted from a seed of its own, so that it comes out the same wherever it is."""

    def painted(c: Canvas) -> None:
        caller_rng, c.rng = c.rng, np.random.default_rng(seed)
        paint(c)
        c.rng = caller_rng

    return painted


def _repeated(seed: int, period_m: float, number: int, side: int) -> Material:
    def furnish(c: Canvas) -> None:
        materials.plaster((186, 200, 206), 0.5)(c)
        details.door(c, 0.4, 0.95, 2.1, details.bright(c.rng))
        details.poster(c, 1.7, 0.9, 0.8, 1.2)
        details.picture(c, 2.8, 1.2, 0.8, 0.6)
        for k in range(3):
            details.notice(c, 1.5 + 0.4 * k, 2.2, 0.25, 0.3)
        c.add(c.noise((0.04, 0.15, 0.6)), (7, 7, 7))

    def paint(c: Canvas) -> None:
        _same(seed, furnish)(c)
        details.notice(c, min(3.65, c.width_m - 0.4), 1.3, 0.25, 0.35)
        c.text(0.5, 2.3, 0.12, f"{10 * side + number}", (40, 40, 60), 0.6)

    return paint
