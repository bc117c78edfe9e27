"""Houses and other things that more than one scene has."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from groundwalk.simulation import details, materials
from groundwalk.simulation.canvas import Bgr, Canvas, Material, vary
from groundwalk.simulation.place import Vec, Xz
from groundwalk.simulation.scenes.builder import Builder

BRICK_RED = materials.masonry(
    0.075, 0.22, [(62, 74, 150), (70, 84, 168), (58, 66, 128), (80, 98, 170)], (160, 168, 172)
)
BRICK_YELLOW = materials.masonry(0.075, 0.22, [(120, 168, 196), (104, 150, 180), (90, 132, 160)], (150, 160, 165))
BRICK_DARK = materials.masonry(0.075, 0.22, [(66, 62, 74), (80, 74, 88), (52, 52, 66)], (130, 135, 140))
SANDSTONE = materials.masonry(
    0.34, 0.7, [(132, 172, 198), (118, 158, 184), (146, 184, 204)], (96, 110, 120), 0.015, 12, 0.4
)
GRANITE = materials.masonry(0.4, 0.8, [(140, 142, 142), (122, 124, 126), (158, 158, 156)], (84, 86, 88), 0.015, 14, 0.4)
RUBBLE = materials.cobbles(0.3, [(120, 132, 140), (98, 112, 124), (140, 152, 160), (84, 94, 110)], (96, 104, 110))
TIMBER = materials.wood((72, 104, 140), 0.18)
SLATES = materials.masonry(0.2, 0.16, [(84, 78, 74), (96, 90, 86), (70, 66, 64)], (48, 48, 48), 0.012, 12)
ROOF_TILES = materials.masonry(0.22, 0.2, [(52, 72, 150), (60, 84, 170), (46, 60, 122)], (36, 44, 80), 0.015, 16)


@dataclass(frozen=True)
class Facade:
    """How the front of a house looks. `same` repeats one window."""

    wall: Material
    storeys: int = 3
    storey_m: float = 3.0
    frame: Bgr = (225, 228, 230)
    window_m: tuple[float, float] = (1.1, 1.5)
    pitch_m: float = 2.4
    shop: bool = False
    same: bool = False
    graffiti: bool = False
    posters: int = 2
    ivy: bool = False

    def paint(self, c: Canvas) -> None:
        """The front, with its ground floor on the canvas's lower edge."""
        self.wall(c)
        w, h = self.window_m
        rng = c.rng
        count = max(1, int((c.width_m - 0.6) / self.pitch_m))
        margin = (c.width_m - count * self.pitch_m) / 2
        doorway = int(rng.integers(count))
        for storey in range(self.storeys):
            base = storey * self.storey_m + 0.95
            if storey and not self.same:
                c.box(0, base - 0.75, c.width_m, base - 0.62, (150, 158, 164))
            for k in range(count):
                x = margin + (k + 0.5) * self.pitch_m - w / 2
                if storey == 0 and (k == doorway or self.shop):
                    continue
                if not self.same and rng.random() < 0.06:
                    self._something(c, x, base)
                    continue
                jitter = 0.0 if self.same else rng.uniform(-0.12, 0.12)
                if base + h < c.height_m:
                    details.window(c, x + jitter, base, w, h, self.frame, self.same)
        colour = vary(details.bright(rng), rng, 15)
        if self.shop:
            self._shop(c, colour)
        else:
            details.door(c, margin + (doorway + 0.5) * self.pitch_m - 0.5, 1.0, 2.2, colour)
        if self.graffiti:
            for _ in range(max(1, int(c.width_m / 5))):
                details.graffiti(c, rng.uniform(0.2, max(0.3, c.width_m - 2.4)), rng.uniform(0.1, 0.8), 2.0, 0.9)
        for _ in range(self.posters):
            x, y = rng.uniform(0.1, max(0.2, c.width_m - 0.9)), rng.uniform(0.75, 1.5)
            details.poster(c, x, y, rng.uniform(0.45, 0.75), rng.uniform(0.6, 1.05))
        if self.ivy:
            x = rng.uniform(0, 0.6) * c.width_m
            details.ivy(c, x, 0, 0.35 * c.width_m, 0.75 * c.height_m)
        c.box(0, 0, c.width_m, 0.28, (92, 98, 102))
        c.add(c.noise((0.05, 0.2, 0.8)), (5, 5, 5))

    def _something(self, c: Canvas, x: float, y: float) -> None:
        """What hangs where a window is missing."""
        kind = c.rng.integers(3)
        if kind == 0:
            details.emblem(c, x + 0.5, y + 0.7, 0.45)
        elif kind == 1:
            details.poster(c, x, y, 0.9, 1.3)
        else:
            c.box(x, y + 0.2, x + 0.9, y + 0.9, (70, 75, 80))
            for k in range(5):
                c.box(x + 0.05, y + 0.27 + 0.12 * k, x + 0.85, y + 0.32 + 0.12 * k, (170, 175, 180))

    def _shop(self, c: Canvas, colour: Bgr) -> None:
        w = c.width_m
        c.box(0.15, 0, w - 0.15, self.storey_m - 0.1, colour)
        entry = w * c.rng.uniform(0.35, 0.6)
        for x0, x1 in ((0.35, entry - 0.65), (entry + 0.65, w - 0.35)):
            if x1 - x0 < 0.6:
                continue
            c.box(x0 - 0.05, 0.5, x1 + 0.05, 2.25, (40, 42, 45))
            c.box(x0, 0.55, x1, 2.2, vary((95, 85, 75), c.rng, 20))
            for _ in range(int((x1 - x0) * 7)):
                u, size = c.rng.uniform(x0 + 0.1, x1 - 0.25), c.rng.uniform(0.08, 0.3)
                v = 0.6 + 0.5 * c.rng.integers(3)
                c.box(u, v, u + size * 0.7, min(v + size * 1.3, 2.15), vary(details.bright(c.rng), c.rng, 30))
            for level in (1.08, 1.58):
                c.box(x0, level, x1, level + 0.03, (190, 195, 200))
        details.door(c, entry - 0.5, 1.0, 2.2, vary(colour, c.rng, 40))
        details.shop_sign(c, 0.4, self.storey_m - 0.62, w - 0.8, 0.58)


@dataclass(frozen=True)
class _Front:
    """A house's front: its corners (x, z), left and right as one faces it."""

    name: str
    left: Vec
    right: Vec

    @property
    def width_m(self) -> float:
        return float(np.linalg.norm(self.right - self.left))

    @property
    def along(self) -> Vec:
        direction: Vec = (self.right - self.left) / self.width_m
        return direction

    @property
    def out(self) -> Vec:
        return np.array([-self.along[1], self.along[0]])

    @property
    def yaw_deg(self) -> float:
        return math.degrees(math.atan2(-self.along[1], self.along[0]))

    def at(self, x: float, forward: float) -> Xz:
        """The point so far along the front and out of it."""
        p = self.left + x * self.along + forward * self.out
        return float(p[0]), float(p[1])

    def box(
        self, b: Builder, name: str, at: Xz, size: tuple[float, float, float], paint: Material, **more: Any
    ) -> None:
        """A box that looks as the front does, so far along it and out of it."""
        b.box(f"{self.name}.{name}", self.at(*at), size, paint, yaw_deg=self.yaw_deg, **more)


def _house(b: Builder, front: _Front, facade: Facade, roof: Material) -> None:
    """A house behind its front: side walls and a roof."""
    name, depth, width, along, back = front.name, 4.0, front.width_m, front.along, -front.out
    left, right = front.left, front.right
    top = facade.storeys * facade.storey_m + 0.7
    b.wall(name, tuple(left), tuple(right), 0, top, facade.paint)
    far_left, far_right = left + depth * back, right + depth * back
    b.wall(f"{name}.left", tuple(far_left), tuple(left), 0, top, facade.wall, 2)
    b.wall(f"{name}.right", tuple(right), tuple(far_right), 0, top, facade.wall, 2)
    eaves = left - 0.35 * along - 0.35 * back
    run, rise = (width + 0.7) * along, (depth + 0.35) * back
    up = (rise[0], 0.75 * depth, rise[1])
    b.quad(f"{name}.roof", (eaves[0], top, eaves[1]), (run[0], 0, run[1]), up, roof, 1.5)
    cornice, size = materials.plain((170, 178, 184)), (width, 0.3, 0.25)
    front.box(b, "cornice", (width / 2, 0.1), size, cornice, bottom=top - 0.3, faces="flru", solid=False)
    low, high = (extreme.reduce([left, right, far_left, far_right]) for extreme in (np.minimum, np.maximum))
    b.block((low[0], 0, low[1]), (high[0], top, high[1]))


def _dress(b: Builder, front: _Front, facade: Facade) -> None:
    """Things that stand out from a front: awnings, balconies, hanging signs, boxes of flowers, a drainpipe."""
    rng = b.rng
    if facade.shop:
        _awning(b, front, facade)
    for k in range(facade.storeys - 1):
        if rng.random() < 0.6 and not facade.same:
            _balcony(b, front, facade, k)
    if rng.random() < 0.75:
        _sign(b, front)
    size = (0.12, facade.storeys * facade.storey_m, 0.12)
    front.box(b, "pipe", (front.width_m - 0.2, 0.07), size, materials.plain((90, 100, 96)), faces="flr")
    if rng.random() < 0.6:
        x = rng.uniform(0.8, max(0.9, front.width_m - 0.8))
        planter(b, f"{front.name}.planter", front.at(x, 0.45), front.yaw_deg)


def _awning(b: Builder, front: _Front, facade: Facade) -> None:
    cloth = materials.stripes((230, 232, 234), details.bright(b.rng), 0.3)
    (x, z), high = front.at(0.3, 1.1), facade.storey_m - 0.75
    run, out = (front.width_m - 0.6) * front.along, front.out
    up = (-1.1 * out[0], 0.4, -1.1 * out[1])
    b.quad(f"{front.name}.awning", (x, high, z), (run[0], 0, run[1]), up, cloth)


def _balcony(b: Builder, front: _Front, facade: Facade, storey: int) -> None:
    x, bottom = b.rng.uniform(1.2, max(1.3, front.width_m - 1.2)), (storey + 1) * facade.storey_m + 0.2
    bars = materials.masonry(0.9, 0.12, [(60, 60, 62), (150, 155, 160)], (30, 30, 30), 0.02, 20)
    front.box(b, f"balcony{storey}", (x, 0.4), (1.9, 0.95, 0.8), bars, bottom=bottom, faces="flrtu", solid=False)


def _sign(b: Builder, front: _Front) -> None:
    def sign(canvas: Canvas) -> None:
        canvas.fill(details.bright(canvas.rng))
        details.emblem(canvas, canvas.width_m / 2, canvas.height_m * 0.62, 0.25 * canvas.width_m)
        canvas.text(0.05, 0.12, 0.14, details.word(canvas.rng, 2), (245, 245, 245), canvas.width_m - 0.1)

    x = b.rng.uniform(0.5, front.width_m - 0.5)
    front.box(b, "sign", (x, 0.5), (0.06, 0.8, 0.8), sign, bottom=2.75, solid=False)


def planter(b: Builder, name: str, centre: Xz, yaw_deg: float = 0.0) -> None:
    side = materials.masonry(0.2, 0.3, [(100, 120, 150), (120, 140, 165)], (70, 80, 90), 0.012, 15)
    b.box(name, centre, (0.9, 0.45, 0.5), side, yaw_deg=yaw_deg)
    b.bush(f"{name}.bush", centre, 0.42, 0.35)


def row_of_houses(
    b: Builder, name: str, left: Xz, right: Xz, facades: list[Facade], widths: list[float], setback_m: float = 0.6
) -> None:
    """Houses side by side from left to right, `widths` sharing the length; some stand back a little."""
    row = _Front(name, np.array(left), np.array(right))
    marks = np.concatenate([[0], np.cumsum(widths)]) / sum(widths) * row.width_m
    for k, facade in enumerate(facades):
        step = -row.out * b.rng.uniform(0, setback_m)
        ends = [row.left + marks[k + i] * row.along + step for i in (0, 1)]
        front = _Front(f"{name}{k}", *ends)
        _house(b, front, facade, [ROOF_TILES, SLATES][k % 2])
        _dress(b, front, facade)


def kiosk(b: Builder, centre: Xz, yaw_deg: float) -> None:
    def side(c: Canvas) -> None:
        materials.plain(details.bright(c.rng))(c)
        for k in range(int(c.width_m / 0.8)):
            for row in range(2):
                details.poster(c, 0.12 + 0.78 * k, 0.25 + 1.05 * row, 0.62, 0.9)
        details.shop_sign(c, 0.1, c.height_m - 0.38, c.width_m - 0.2, 0.34)

    b.box("kiosk", centre, (2.0, 2.6, 1.6), side, yaw_deg=yaw_deg)


def car(b: Builder, name: str, centre: Xz, yaw_deg: float) -> None:
    colour = vary(details.bright(b.rng), b.rng, 20)

    def side(c: Canvas) -> None:
        materials.plain(colour, 4)(c)
        for x in (0.18, 0.8):
            c.disc(x * c.width_m, 0.2, 0.3, (25, 25, 25))
            c.disc(x * c.width_m, 0.2, 0.16, (160, 165, 170))
        for k in range(3):
            x = (0.08 + 0.3 * k) * c.width_m
            c.box(x, 0.95, x + 0.25 * c.width_m, 1.55, (70, 60, 50))
            c.polygon([(x, 1.55), (x + 0.1 * c.width_m, 1.55), (x + 0.04, 0.95), (x, 0.95)], (150, 140, 130))
        text = f"{details.word(c.rng)} {c.rng.integers(10, 99)}"
        c.text(0.1 * c.width_m, 0.55, 0.22, text, (240, 240, 240), 0.6 * c.width_m)

    b.box(name, centre, (4.2, 1.75, 1.8), side, yaw_deg=yaw_deg)


def bins(b: Builder, *places: Xz) -> None:
    def side(c: Canvas) -> None:
        materials.plain((50, 90, 45))(c)
        details.notice(c, 0.1, 0.4, 0.25, 0.3)
        details.emblem(c, 0.25, 0.25, 0.1)

    for k, at in enumerate(places):
        b.box(f"bin{k}", at, (0.5, 0.9, 0.5), side)
