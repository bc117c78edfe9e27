"""A simulated place: its surfaces, what stands in the way, its light, and the course of the walks through it.

World axes: metres, x to the right, +y up, z towards the reader of the plan; the ground is y = 0. A quad is seen from
the side that its normal (right x up) points to: standing in front of a wall, `right` is to one's right.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from groundwalk.simulation.canvas import Material

Vec = NDArray[np.float64]
Xz = tuple[float, float]
UP: Vec = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Quad:
    """A textured rectangle: its lower left corner, its sides as vectors, and who paints it.

    `texel` multiplies the texture's texel size (2 = half as fine). `glass` is seen through and mirrors.
    """

    name: str
    corner: Vec
    right: Vec
    up: Vec
    paint: Material
    texel: float = 1.0
    glass: bool = False

    @property
    def width_m(self) -> float:
        return float(np.linalg.norm(self.right))

    @property
    def height_m(self) -> float:
        return float(np.linalg.norm(self.up))

    @property
    def normal(self) -> Vec:
        n = np.cross(self.right, self.up)
        return n / np.linalg.norm(n)


@dataclass(frozen=True)
class Crown:
    """A faceted blob of leaves: triangles (T, 3, 3) in metres, each with a piece of one shared picture."""

    name: str
    triangles_T33: Vec
    paint: Material
    picture_m: float = 3.0


@dataclass(frozen=True)
class Light:
    """Where light comes from; strengths are in display brightness (1 = textures as painted).

    `sun` is the direction towards it, or None; `lamps` are (position, strength at 1 m).
    """

    ambient: float = 0.6
    sun: tuple[float, float, float] | None = None
    sun_strength: float = 0.55
    lamps: tuple[tuple[tuple[float, float, float], float], ...] = ()


@dataclass
class Place:
    """All that can be seen and bumped into. `low` and `high` bound where a camera may be; `obstacles` are upright boxes
    that nobody walks through, by opposite corners.

    `texel` multiplies the texel size of every picture: below 1 for rooms, whose walls are seen from near.
    """

    name: str
    low: Vec
    high: Vec
    light: Light
    texel: float = 1.0
    quads: list[Quad] = field(default_factory=list)
    crowns: list[Crown] = field(default_factory=list)
    obstacles: list[tuple[Vec, Vec]] = field(default_factory=list)

    def clearance_m(self, xyz_N3: Vec) -> Vec:
        """Distance (N,) of points to the nearest obstacle or bound; negative inside an obstacle or out of bounds."""
        gaps = [np.min(np.hstack([xyz_N3 - self.low, self.high - xyz_N3]), axis=1)]
        for low, high in self.obstacles:
            away = np.linalg.norm(np.maximum(np.maximum(low - xyz_N3, xyz_N3 - high), 0), axis=1)
            inside = np.min(np.hstack([xyz_N3 - low, high - xyz_N3]), axis=1)
            gaps.append(np.where(away > 0, away, -inside))
        return np.min(gaps, axis=0)


@dataclass(frozen=True)
class Route:
    """A closed course: points (x, z, gaze in degrees to the left of the way ahead) or (x, z, gaze, floor height).

    Walkers keep within `spread_m` to each side of it, at `speed_mps` on the straight, and look `look_deg` around
    the gaze. `tilt_deg` is how far up they hold the phone. `far_glances` is the fraction of their glances aside that
    go far.
    """

    points: Sequence[tuple[float, ...]]
    speed_mps: float = 1.15
    spread_m: float = 0.9
    look_deg: float = 8.0
    tilt_deg: float = 4.0
    turn_deg_s: float = 30.0
    far_glances: float = 0.35


@dataclass(frozen=True)
class SceneryPlan:
    """A place, and the course of the walks through it."""

    place: Place
    route: Route
