"""A simulated place: its surfaces, what stands in the way, its light, and the course of the walks through it.

World axes: metres, x to the right, +y up, z towards the reader of the plan; the ground is y = 0. A quad is seen from
the side that its normal (right x up) points to: standing in front of a wall, `right` is to one's right.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from groundwalk.simulation.canvas import Bgr, Material

Vec = NDArray[np.float64]
Xz = tuple[float, float]
UP: Vec = np.array([0.0, 1.0, 0.0])
WHITE: Bgr = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Quad:
    """A textured rectangle: its lower left corner, its sides as vectors, and who paints it.

    `texel` multiplies the texture's texel size (2 = half as fine). `glass` is seen through and mirrors. `glow` is the
    brightness of a lamp's surface, whatever falls on it.
    """

    name: str
    corner: Vec
    right: Vec
    up: Vec
    paint: Material
    texel: float = 1.0
    glass: bool = False
    glow: float | None = None

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
class Obstacle:
    """An upright box nobody walks through: opposite corners."""

    low: Vec
    high: Vec


@dataclass(frozen=True)
class Light:
    """Where light comes from; strengths are in display brightness (1 = textures as painted), colours factors of them.

    `sun` is the direction towards it, or None; `lamps` are (position, strength at 1 m). `exposure` is how many times as
    long a camera exposes as by full day for the same display brightness. `windows` is the display brightness of lit
    rooms behind windows, 0 by day.
    """

    ambient: float = 0.6
    sun: tuple[float, float, float] | None = None
    sun_strength: float = 0.55
    lamps: tuple[tuple[tuple[float, float, float], float], ...] = ()
    ambient_bgr: Bgr = WHITE
    sun_bgr: Bgr = WHITE
    lamp_bgr: Bgr = WHITE
    exposure: float = 1.0
    windows: float = 0.0


@dataclass(frozen=True)
class SkyLook:
    """Colours of the sky overhead, at the horizon and of clouds, and the fraction that these cover on average."""

    zenith: Bgr = (235, 190, 150)
    horizon: Bgr = (240, 232, 225)
    cloud: Bgr = (244, 244, 244)
    cover: float = 0.35


DAY_SKY = SkyLook()


@dataclass(frozen=True)
class Movable:
    """What can be carried or driven off: which of a place's quads, crowns and obstacles it is made of."""

    name: str
    quads: slice
    crowns: slice
    obstacles: slice


@dataclass
class Place:
    """All that can be seen and bumped into. `low` and `high` bound where a camera may be.

    `texel` multiplies the texel size of every picture: below 1 for rooms, whose walls are seen from near. `lanterns`
    names the surfaces of street lamps and where their light comes from.
    """

    name: str
    low: Vec
    high: Vec
    light: Light
    texel: float = 1.0
    quads: list[Quad] = field(default_factory=list)
    crowns: list[Crown] = field(default_factory=list)
    obstacles: list[Obstacle] = field(default_factory=list)
    movables: list[Movable] = field(default_factory=list)
    lanterns: dict[str, tuple[float, float, float]] = field(default_factory=dict)
    sky: SkyLook = DAY_SKY

    def clearance_m(self, xyz_N3: Vec) -> Vec:
        """Distance (N,) of points to the nearest obstacle or bound; negative inside an obstacle or out of bounds."""
        gaps = [np.min(np.hstack([xyz_N3 - self.low, self.high - xyz_N3]), axis=1)]
        for box in self.obstacles:
            outside = np.maximum(np.maximum(box.low - xyz_N3, xyz_N3 - box.high), 0)
            inside = np.min(np.hstack([xyz_N3 - box.low, box.high - xyz_N3]), axis=1)
            away = np.linalg.norm(outside, axis=1)
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
    """A place, the course of the walks through it, and the name of the folder where its mesh is kept."""

    place: Place
    route: Route
    mesh: str = "mesh"
