"""Atrium: a high hall with columns, galleries, a reception, plants and glass, 30 by 50 m."""

from groundwalk.simulation import details, materials
from groundwalk.simulation.canvas import Canvas, Material, material
from groundwalk.simulation.place import Light, Place
from groundwalk.simulation.scenes import indoor_parts as parts
from groundwalk.simulation.scenes.builder import Builder
from groundwalk.simulation.scenes.indoor_parts import Hung
from groundwalk.simulation.scenes.parts import BRICK_DARK, BRICK_YELLOW, SANDSTONE, planter

EXTENT_M = (30.0, 50.0)
_HEIGHT_M = 11.0
_STOREY_M = 3.8


def build(seed: int) -> Place:
    """The hall; galleries run along the long sides, columns stand under their edges."""
    lamps = tuple(((x, 10.3, z), 1.9) for x in (-7.0, 7.0) for z in (-18.0, -6.0, 6.0, 18.0))
    b = Builder("Atrium", EXTENT_M, _HEIGHT_M, Light(0.6, None, 0, lamps), seed, 0.8)
    x, z = EXTENT_M[0] / 2, EXTENT_M[1] / 2
    b.floor("floor", (-x, -z), (x, z), 0, _floor)
    b.ceiling("ceiling", (-x, -z), (x, z), _HEIGHT_M, _ceiling)
    _long_wall(b, "west", x=-x, z=z, towards_east=True)
    _long_wall(b, "east", x=x, z=z, towards_east=False)
    b.wall("north", (-x, -z), (x, -z), 0, _HEIGHT_M, _end_wall(SANDSTONE))
    b.wall("south", (x, z), (-x, z), 0, _HEIGHT_M, _end_wall(BRICK_YELLOW))
    _columns(b)
    _furniture(b)
    return b.place


def _floor(c: Canvas) -> None:
    stone = [(150, 164, 172), (166, 178, 184), (134, 148, 158)]
    materials.tiles(0.6, stone, (100, 106, 110))(c)
    dark = materials.tiles(0.3, [(70, 80, 96), (90, 100, 116), (110, 124, 140)], (60, 64, 68))
    for y in (4.0, 13.0, 24.0, 35.0, 44.5):
        c.area([(4, y), (26, y), (26, y + 1.5), (4, y + 1.5)], dark)
    for k, (x, y) in enumerate(((15, 9), (15, 19), (15, 30), (15, 40.5))):
        for ring in range(4):
            c.disc(x, y, 2.4 - 0.55 * ring, details.bright(c.rng) if ring % 2 == 0 else (190, 196, 200))
        details.emblem(c, x, y, 0.9)
        c.text(x - 2, y - 3.2, 0.6, f"{details.word(c.rng)} {k}", (60, 70, 80), 4.0)
    c.add(c.noise((0.05, 0.15, 0.5)), (8, 8, 8))
    materials.litter(c, 0.5)


def _ceiling(c: Canvas) -> None:
    materials.panels((196, 200, 204), 2.0, 2.0)(c)
    for y in range(2, 48, 5):
        for x in (3.0, 11.5, 20.0):
            c.box(x, y, x + 6.5, y + 3.2, (248, 244, 238))
            for k in range(1, 5):
                c.box(x + 1.3 * k, y, x + 1.3 * k + 0.1, y + 3.2, (110, 114, 118))
    for x in (2.0, 10.5, 19.0, 27.5):
        c.box(x, 0, x + 0.35, c.height_m, (90, 70, 60))


@material
def _shopfront(c: Canvas, base: Material) -> None:
    """A storey of doors, posters, boards and windows to rooms behind."""

    base(c)
    u = 0.4
    while u < c.width_m - 2.2:
        kind = c.rng.integers(5)
        if kind == 0:
            details.door(c, u, 1.0, 2.2, details.bright(c.rng))
            u += 1.6
        elif kind == 1:
            details.window(c, u, 0.9, 1.7, 1.6, (90, 96, 100))
            u += 2.2
        elif kind == 2:
            details.picture(c, u, 1.0, 1.4, 1.1)
            u += 1.9
        elif kind == 3:
            for k in range(3):
                details.notice(c, u + 0.38 * k, c.rng.uniform(1.1, 1.5), 0.3, 0.42)
            u += 1.6
        else:
            details.poster(c, u, 0.8, 0.95, 1.4)
            u += 1.4
    for k in range(max(1, int(c.width_m / 6))):
        details.shop_sign(c, 0.5 + 6 * k, 2.75, min(4.0, c.width_m - 1), 0.6)
    c.box(0, 0, c.width_m, 0.12, (60, 64, 68))
    c.add(c.noise((0.04, 0.15, 0.6)), (4, 4, 4))


@material
def _end_wall(c: Canvas, base: Material) -> None:
    base(c)
    for k in range(5):
        details.picture(c, 1.2 + 5.8 * k, 4.6, 4.2, 3.0)
    for k in range(7):
        x = 0.8 + 4.1 * k
        if k % 2:
            details.door(c, x, 1.6, 2.4, details.bright(c.rng))
        else:
            details.poster(c, x, 0.8, 1.6, 2.1)
    details.shop_sign(c, 8, 8.6, 14, 1.5)
    for _ in range(12):
        details.notice(c, c.rng.uniform(0.5, c.width_m - 1), c.rng.uniform(1.0, 1.8), 0.4, 0.55)
    c.add(c.noise((0.05, 0.2, 0.8)), (6, 6, 6))


def _long_wall(b: Builder, name: str, x: float, z: float, towards_east: bool) -> None:
    """One long side: pieces of wall on three storeys, a gallery with a glass rail before the upper ones."""
    materials_low = [
        materials.plaster((150, 180, 196), 0.6),
        BRICK_DARK,
        materials.wood((90, 130, 170), 0.2),
        materials.plaster((204, 210, 212), 0.2),
        materials.panels((170, 160, 150)),
    ]
    inward = 1.0 if towards_east else -1.0
    pieces = len(materials_low)
    for k in range(pieces):
        ends = [z - 2 * z * (k + i) / pieces for i in (0, 1)]
        if not towards_east:
            ends = [-e for e in ends]
        left, right = (x, ends[0]), (x, ends[1])
        b.wall(f"{name}.low{k}", left, right, 0, _STOREY_M, _shopfront(materials_low[k]))
        middle, upper = (_shopfront(materials_low[(k + i) % pieces]) for i in (2, 1))
        b.wall(f"{name}.mid{k}", left, right, _STOREY_M, 2 * _STOREY_M, middle, 1.5)
        b.wall(f"{name}.high{k}", left, right, 2 * _STOREY_M, _HEIGHT_M, upper, 1.5)
    edge = materials.masonry(0.35, 1.5, [(186, 192, 196), (160, 168, 174)], (90, 92, 94), 0.02, 14, 0.4)
    centre = (x + inward * 1.1, 0.0)
    b.box(f"{name}.gallery", centre, (2.2, 0.35, 2 * z), edge, bottom=_STOREY_M, faces="lrtu", solid=False)
    rail_x = x + inward * 2.15
    for k in range(10):
        z0, z1 = -z + 5.0 * k + 0.1, -z + 5.0 * k + 4.9
        parts.pane(b, f"{name}.rail{k}", (rail_x, z0), (rail_x, z1), _STOREY_M + 0.35, _STOREY_M + 1.35, False)


def _columns(b: Builder) -> None:
    def coat(c: Canvas) -> None:
        materials.marble((186, 192, 194), (110, 118, 126))(c)
        for _ in range(2):
            details.notice(c, 0.02, c.rng.uniform(1.0, 2.0), max(0.1, c.width_m - 0.04), 0.26)
        c.box(0, 2.6, c.width_m, 2.85, details.bright(c.rng))

    for side in (-1, 1):
        for k in range(7):
            b.column(f"column{side}{k}", (side * 12.4, -21 + 7.0 * k), 0.4, _STOREY_M, coat, sides=8)


def _furniture(b: Builder) -> None:
    def counter(c: Canvas) -> None:
        materials.wood((70, 106, 150), 0.2)(c)
        text = f"{details.word(c.rng)} {details.word(c.rng)}"
        c.text(0.3, c.height_m * 0.45, 0.3, text, (235, 240, 240), c.width_m - 0.6)
        details.notice(c, 0.1, 0.2, 0.3, 0.4)
        details.emblem(c, c.width_m - 0.3, 0.6, 0.2)

    b.box("reception", (0, -13.5), (5.0, 1.15, 1.2), counter)
    b.box("reception.back", (0, -15.0), (4.0, 2.4, 0.25), Hung(SANDSTONE, 0.5, 0.5, 0.5).paint)
    places = ((-4.5, -6), (4.5, -5), (-4.0, 4.5), (4.8, 6), (-5, 15), (4.6, 16.5), (-11.4, -1.5), (11.2, 2.5))
    for k, at in enumerate(places):
        planter(b, f"planter{k}", at, 20.0 * k)
    b.benches((-2.5, 1.0, 0), (2.5, 1.5, 180), (-2.2, 11.5, 20), (2.4, 11.0, 200), (-6, -19.5, 0), (10, 21.5, 180))
    b.tree("ficus0", (0.0, -3.5), 5.5, spread=1.3)
    b.tree("ficus1", (0.2, 7.0), 5.0, spread=1.2)
    b.tree("ficus2", (0.0, 17.2), 5.2, spread=1.2)
    for k, (x, z, yaw) in enumerate(((-3.2, -9.5, 30), (3.4, 9.4, -40), (-3.0, 19.8, 10), (6.0, -11.0, 60))):

        def board(c: Canvas) -> None:
            details.number_board(c, [details.word(c.rng) for _ in range(4)])

        b.box(f"board{k}", (x, z), (1.1, 1.9, 0.2), board, yaw_deg=yaw)
    for k, z in enumerate((-8.5, 0.5, 9.0)):
        parts.pane(b, f"screen{k}", (-1.6, z + 0.9), (1.6, z + 0.9), 0, 2.4)
