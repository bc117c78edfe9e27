"""Stairs: two flights with landings around a glass screen, 5.5 by 4.5 m and 6 m high."""

from groundwalk.simulation import details, materials
from groundwalk.simulation.canvas import Canvas, Material, material
from groundwalk.simulation.place import Light, Place
from groundwalk.simulation.scenes import indoor_parts as parts
from groundwalk.simulation.scenes.builder import Builder
from groundwalk.simulation.scenes.indoor_parts import Hung
from groundwalk.simulation.scenes.parts import BRICK_RED, BRICK_YELLOW

EXTENT_M = (5.5, 4.5)
HEIGHT_M = 6.0
_FLIGHT = (-1.3, 1.4)  # x of the first and the last step
_RISE_M = 1.5  # of one flight
_STEPS = 9
_WELL = 0.35  # half the gap between the flights


def build(seed: int) -> Place:
    """The first flight goes up on the north side towards +x, the second comes back on the south side."""
    lamps = (((0.0, 5.6, 0.0), 0.7), ((2.1, 4.4, 0.0), 0.4), ((-2.1, 2.7, -0.6), 0.4))
    b = Builder("Stairs", EXTENT_M, HEIGHT_M, Light(0.6, None, 0, lamps), seed, 0.33)
    x, z = EXTENT_M[0] / 2, EXTENT_M[1] / 2
    for name, left, right, low, high in (
        ("north", (-x, -z), (x, -z), BRICK_RED, materials.plaster((200, 208, 206), 1.0)),
        ("east", (x, -z), (x, z), materials.plaster((140, 180, 214), 1.0), BRICK_YELLOW),
        ("south", (x, z), (-x, z), materials.plaster((196, 188, 160), 1.0), materials.plaster((206, 186, 150), 1.0)),
        ("west", (-x, z), (-x, -z), BRICK_YELLOW, materials.plaster((170, 176, 214), 1.0)),
    ):
        b.wall(f"{name}.low", left, right, 0, 3, _wall(low))
        b.wall(f"{name}.high", left, right, 3, HEIGHT_M, _wall(high))
    stone = [(150, 162, 170), (130, 142, 152), (110, 122, 136)]
    b.floor("floor", (-x, -z), (x, z), 0, materials.tiles(0.3, [*stone, (60, 66, 74)], (80, 84, 88)))
    b.ceiling("ceiling", (-x, -z), (x, z), HEIGHT_M, _ceiling)
    _flight(b, "lower", -z, -_WELL, 0.0, up=True)
    _flight(b, "upper", _WELL, z, _RISE_M, up=False)
    centre, size = ((_FLIGHT[1] + x) / 2, 0.0), (x - _FLIGHT[1], _RISE_M, 2 * z)
    b.box("landing", centre, size, BRICK_YELLOW, top=_landing, faces="lt")
    centre, size = ((-x + _FLIGHT[0]) / 2, 0.0), (_FLIGHT[0] + x, 0.22, 2 * z)
    under = materials.plain((190, 196, 200))
    b.box("gallery", centre, size, under, top=_landing, bottom=2 * _RISE_M - 0.22, faces="rtu")
    parts.pane(b, "screen.lower", (_FLIGHT[0] + 0.1, 0), (0.05, 0), 0.0, 2.6, False)
    parts.pane(b, "screen.upper", (0.05, 0), (_FLIGHT[1] - 0.05, 0), 0.0, 3.4, False)
    parts.pane(b, "gallery.rail", (_FLIGHT[0] - 0.05, -z + 0.05), (_FLIGHT[0] - 0.05, 0.3), 3.0, 4.0, False)
    b.box("plant", (2.5, 2.0), (0.3, 0.45, 0.3), materials.plain((50, 80, 140)), bottom=_RISE_M)
    b.bush("plant.leaves", (2.5, 2.0), 0.28, _RISE_M + 0.4)
    return b.place


@material
def _wall(c: Canvas, base: Material) -> None:
    Hung(base, 0.5, 0.9, 0.6).paint(c)
    for _ in range(14):
        details.notice(c, c.rng.uniform(0.1, c.width_m - 0.4), c.rng.uniform(0.3, 2.5), 0.2, 0.27)
    for _ in range(4):
        x, y = c.rng.uniform(0.1, c.width_m - 0.9), c.rng.uniform(1.7, 2.2)
        (details.picture, details.poster)[c.rng.integers(2)](c, x, y, 0.65, 0.6)
    x = c.rng.uniform(0.2, c.width_m - 1.2)
    c.box(x, 2.35, x + 0.9, 2.6, (90, 150, 40))
    c.text(x + 0.05, 2.42, 0.13, f"{details.word(c.rng)} {c.rng.integers(1, 30)}", (240, 245, 240), 0.8)
    materials.streaks(c, 4)


def _ceiling(c: Canvas) -> None:
    parts.CEILING(c)
    c.box(2.1, 1.7, 3.3, 2.8, (250, 250, 250))
    materials.weather(c, 0.8)


def _landing(c: Canvas) -> None:
    stone = [(96, 110, 126), (120, 134, 148), (70, 82, 96), (150, 160, 168)]
    materials.tiles(0.25, stone, (70, 74, 78))(c)
    c.box(0.15, 0.3, min(0.95, c.width_m - 0.1), 1.1, (60, 60, 110))
    c.text(0.2, 0.6, 0.16, details.word(c.rng), (220, 225, 230), 0.65)
    c.add(c.noise((0.03, 0.1, 0.3)), (8, 8, 8))


def _flight(b: Builder, name: str, z0: float, z1: float, base: float, up: bool) -> None:
    first, last = _FLIGHT
    run = (last - first) / _STEPS

    def tread(c: Canvas) -> None:
        materials.marble((140, 156, 168), (80, 92, 104))(c)
        c.box(0, 0, c.width_m, 0.03, (50, 54, 58))
        materials.litter(c, 6)

    def side(c: Canvas) -> None:
        materials.wood((84, 120, 156), 0.1)(c)
        if c.width_m > 1:
            c.box(0, c.height_m - 0.03, c.width_m, c.height_m, (40, 44, 50))
            for _ in range(3):
                details.emblem(c, c.rng.uniform(0.1, c.width_m - 0.1), c.height_m - 0.09, 0.05)

    for k in range(_STEPS):
        x = first + run * (k + 0.5) if up else last - run * (k + 0.5)
        height = base + _RISE_M * (k + 1) / _STEPS
        b.box(f"{name}{k}", (x, (z0 + z1) / 2), (run, height, z1 - z0), side, top=tread, faces="fblrt")
