"""The builder that scenes are written with."""

import math
from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from groundwalk.simulation.canvas import Bgr, Canvas, Material, material
from groundwalk.simulation.materials import foliage, plain, wood
from groundwalk.simulation.place import UP, Crown, Light, Place, Quad, Vec, Xz


class Builder:
    """Adds things to a place. `rng` decides shapes and layouts; pictures are painted later, each from its own seed."""

    def __init__(
        self, name: str, extent_m: Sequence[float], height_m: float, light: Light, seed: int, texel: float = 1.0
    ) -> None:
        """A place of extent_m (x, z) around the origin."""
        half = np.array([extent_m[0] / 2, 0.0, extent_m[1] / 2])
        high = np.array([half[0], height_m, half[2]])
        self.place = Place(name, -half, high, light, texel)
        self.rng = np.random.default_rng(np.random.SeedSequence([seed, *name.encode()]))

    def quad(
        self,
        name: str,
        corner: Sequence[float],
        right: Sequence[float],
        up: Sequence[float],
        paint: Material,
        texel: float = 1.0,
        glass: bool = False,
    ) -> None:
        at, along, tall = (np.array(v, float) for v in (corner, right, up))
        self.place.quads.append(Quad(name, at, along, tall, paint, texel, glass))

    def wall(
        self,
        name: str,
        left: Xz,
        right: Xz,
        bottom: float,
        top: float,
        paint: Material,
        texel: float = 1.0,
        glass: bool = False,
    ) -> None:
        """An upright rectangle between two points of the plan, named as one sees them."""
        corner, along = (left[0], bottom, left[1]), (right[0] - left[0], 0, right[1] - left[1])
        self.quad(name, corner, along, (0, top - bottom, 0), paint, texel, glass)

    def floor(self, name: str, low: Xz, high: Xz, y: float, paint: Material, texel: float = 1.0) -> None:
        """A level rectangle seen from above, x to the right and -z up in its picture."""
        self.quad(name, (low[0], y, high[1]), (high[0] - low[0], 0, 0), (0, 0, low[1] - high[1]), paint, texel)

    def ceiling(self, name: str, low: Xz, high: Xz, y: float, paint: Material) -> None:
        """A level rectangle seen from below."""
        self.quad(name, (low[0], y, low[1]), (high[0] - low[0], 0, 0), (0, 0, high[1] - low[1]), paint, 1.5)

    def box(
        self,
        name: str,
        centre: Xz,
        size: tuple[float, float, float],
        paint: Material,
        *,
        bottom: float = 0.0,
        yaw_deg: float = 0.0,
        top: Material | None = None,
        front: Material | None = None,
        faces: str = "fblrt",
        solid: bool = True,
        texel: float = 1.0,
    ) -> None:
        """A box of size (width, height, depth); its front looks towards +z before it is turned by yaw_deg.

        `faces` are those with a picture: front, back, left, right, top, under. `solid` ones stand in the way.
        """
        w, h, d = size
        turn = math.radians(yaw_deg)
        x_axis = np.array([math.cos(turn), 0, -math.sin(turn)])
        z_axis = np.array([math.sin(turn), 0, math.cos(turn)])
        middle = np.array([centre[0], bottom, centre[1]])
        a, b = x_axis * w / 2, z_axis * d / 2
        tall = UP * h
        sides = {
            "f": (middle - a + b, 2 * a, tall),
            "b": (middle + a - b, -2 * a, tall),
            "l": (middle - a - b, 2 * b, tall),
            "r": (middle + a + b, -2 * b, tall),
            "t": (middle - a + b + tall, 2 * a, -2 * b),
            "u": (middle - a - b, 2 * a, 2 * b),
        }
        painters = {"t": top or paint, "f": front or paint}
        for face in faces:
            corner, right, up = sides[face]
            self.place.quads.append(Quad(f"{name}.{face}", corner, right, up, painters.get(face, paint), texel))
        if solid:
            corners = np.array([middle + i * a + j * b for i in (-1, 1) for j in (-1, 1)])
            self.block(corners.min(axis=0), corners.max(axis=0) + tall)

    def block(self, low: Sequence[float] | Vec, high: Sequence[float] | Vec) -> None:
        """Something in the way, without a look of its own."""
        self.place.obstacles.append((np.array(low, float), np.array(high, float)))

    def column(
        self, name: str, centre: Xz, radius: float, height: float, paint: Material, bottom: float = 0.0, sides: int = 10
    ) -> None:
        angle = 2 * math.pi * np.arange(sides + 1) / sides
        x, z = centre
        points = np.stack([x + radius * np.cos(angle), z - radius * np.sin(angle)], axis=1)
        for k in range(sides):
            left, right = points[k], points[k + 1]
            self.wall(f"{name}.{k}", tuple(left), tuple(right), bottom, bottom + height, paint)
        self.block((x - radius, bottom, z - radius), (x + radius, bottom + height, z + radius))

    def tree(self, name: str, centre: Xz, height: float, spread: float = 1.6) -> None:
        """A trunk and a crown of several balls of leaves, which begins well above heads."""
        trunk = max(2.6, 0.45 * height)
        bark = wood((58, 74, 92), 0.07)
        self.column(f"{name}.trunk", centre, 0.16 + 0.01 * height, trunk, bark, 0.0, sides=7)
        tone = (self.rng.uniform(30, 60), self.rng.uniform(85, 125), self.rng.uniform(50, 105))
        for k in range(5):
            offset = self.rng.normal(0, 0.4 * spread, 3) * [1, 0.6, 1]
            middle = np.array([centre[0], trunk + 0.3 * (height - trunk) + 0.4, centre[1]]) + offset
            radius = self.rng.uniform(0.55, 0.8) * spread
            middle[1] = max(middle[1], 2.35 + radius * 0.85)
            self._add_crown(f"{name}.crown{k}", middle, radius, foliage(tone))

    def bush(self, name: str, centre: Xz, radius: float, bottom: float = 0.0) -> None:
        tone = (self.rng.uniform(30, 60), self.rng.uniform(80, 120), self.rng.uniform(45, 95))
        self._add_crown(name, np.array([centre[0], bottom + 0.6 * radius, centre[1]]), radius, foliage(tone))
        low = (centre[0] - radius, bottom, centre[1] - radius)
        self.block(low, (centre[0] + radius, bottom + 1.6 * radius, centre[1] + radius))

    def _add_crown(self, name: str, centre: Vec, radius: float, paint: Material) -> None:
        vertices, faces = _icosphere()
        bumps = 1 + 0.13 * self.rng.standard_normal(len(vertices))
        shape = centre + vertices * (radius * bumps)[:, None] * [1, 0.85, 1]
        self.place.crowns.append(Crown(name, shape[faces], paint))

    def benches(self, *places: tuple[float, float, float]) -> None:
        """Park benches with a back at (x, z, yaw in degrees); one sits looking along +z before it is turned."""
        for k, (x, z, yaw) in enumerate(places):
            turn = math.radians(yaw)
            boards = wood(((40, 70, 110), (60, 90, 120), (50, 90, 60))[self.rng.integers(3)], 0.1)
            back = (x - 0.22 * math.sin(turn), z - 0.22 * math.cos(turn))
            self.box(f"bench{k}.seat", (x, z), (1.7, 0.07, 0.45), boards, bottom=0.42, yaw_deg=yaw, faces="fblrtu")
            self.box(f"bench{k}.back", back, (1.7, 0.42, 0.06), boards, bottom=0.52, yaw_deg=yaw)
            for side in (-0.7, 0.7):
                leg = (x + side * math.cos(turn), z - side * math.sin(turn))
                self.box(f"bench{k}.leg{side}", leg, (0.08, 0.42, 0.4), plain((50, 50, 50)), yaw_deg=yaw)

    def lamp_posts(self, *places: Xz, height: float = 4.0) -> None:
        for k, at in enumerate(places):
            self.column(f"lamp{k}.pole", at, 0.08, height, _stickered((60, 64, 60)), sides=6)
            self.box(f"lamp{k}.light", at, (0.35, 0.5, 0.35), plain((190, 220, 225)), bottom=height, solid=False)


@material
def _stickered(c: Canvas, colour: Bgr) -> None:
    plain(colour)(c)
    for _ in range(4):
        y = c.rng.uniform(0.7, min(2.2, c.height_m - 0.2))
        blue, green, red = c.rng.uniform(60, 250, 3)
        c.box(0, y, c.width_m, y + c.rng.uniform(0.05, 0.12), (blue, green, red))


def _icosphere() -> tuple[Vec, NDArray[np.int64]]:
    """Vertices (V, 3) of the unit sphere and faces (F, 3), outward, an icosahedron split twice."""
    g = (1 + math.sqrt(5)) / 2
    raw: list[tuple[float, float, float]] = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0), (0, -1, g), (0, 1, g)]
    raw += [(0, -1, -g), (0, 1, -g), (g, 0, -1), (g, 0, 1), (-g, 0, -1), (-g, 0, 1)]
    points = [np.array(p, float) / math.hypot(1, g) for p in raw]
    faces = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4), (11, 10, 2)]
    faces += [(10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9), (4, 9, 5), (2, 4, 11)]
    faces += [(6, 2, 10), (8, 6, 7), (9, 8, 1)]

    @cache
    def half(edge: frozenset[int]) -> int:
        i, j = edge
        middle = points[i] + points[j]
        points.append(middle / np.linalg.norm(middle))
        return len(points) - 1

    for _ in range(2):
        split = []
        for i, j, k in faces:
            a, b, c = (half(frozenset(edge)) for edge in ((i, j), (j, k), (k, i)))
            split += [(i, a, c), (j, b, a), (k, c, b), (a, b, c)]
        faces = split
    return np.array(points), np.array(faces)
