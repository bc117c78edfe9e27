"""Square: a town square with a fountain, market stalls, an arcade and trees, 40 by 25 m."""

import math

from groundwalk.simulation import details, materials
from groundwalk.simulation.canvas import Canvas
from groundwalk.simulation.place import Light, Place
from groundwalk.simulation.scenes import parts
from groundwalk.simulation.scenes.builder import Builder
from groundwalk.simulation.scenes.parts import Facade

EXTENT_M = (40.0, 25.0)


def build(seed: int) -> Place:
    """The place; houses on all four sides, the fountain in the middle."""
    b = Builder("Square", EXTENT_M, 12.0, Light(0.66, (-0.45, 0.8, 0.35), 0.52), seed)
    b.floor("ground", (-22, -14.5), (22, 14.5), 0, _ground)
    _houses(b)
    _fountain(b)
    _market(b)
    for k, at in enumerate(((-9.5, -3.2), (-9.8, 3.4), (9.6, -3.6), (16.6, 9.6), (-16.6, -9.4))):
        b.tree(f"tree{k}", at, b.rng.uniform(4.8, 6.2), spread=1.4)
    b.benches((-6.5, 1.5, 90), (6.8, -1.2, -90), (0.5, 3.9, 180), (-17.3, 4.0, 90))
    lamps = ((-12.5, 10.3), (0.2, 10.4), (12.8, 10.2), (-4.5, -10.2), (17.2, -1.5), (-17.6, -3))
    b.lamp_posts(*lamps, height=3.8)
    parts.bins(b, (6.5, 10.2), (-17.3, 8.8), (-11.0, -10.4))
    parts.kiosk(b, (-6.2, -2.2), 70)
    return b.place


def _ground(c: Canvas) -> None:
    slabs = [(150, 164, 176), (134, 148, 160), (164, 176, 186), (118, 134, 150)]
    materials.masonry(0.5, 0.75, slabs, (88, 92, 96), 0.015, 12, 0.35)(c)
    # The picture's (0, 0) is the south-west corner, so plan (x, z) is (x + 22, 14.5 - z).
    middle = (22.0, 14.5)
    for radius, tone in ((6.3, (96, 100, 116)), (5.6, (176, 184, 190)), (4.9, (80, 96, 140)), (4.2, (150, 158, 164))):
        c.disc(*middle, radius, tone)
    for k in range(24):
        a = 2 * math.pi * k / 24
        tip = (middle[0] + 6.0 * math.cos(a), middle[1] + 6.0 * math.sin(a))
        side = [(middle[0] + 3.2 * math.cos(a + d), middle[1] + 3.2 * math.sin(a + d)) for d in (-0.09, 0.09)]
        c.polygon([tip, *side], (60, 66, 74) if k % 2 else (196, 204, 208))
    for x0, x1 in ((3.0, 9.5), (34.5, 41.0)):
        stones = materials.cobbles(0.13, [(96, 100, 108), (120, 124, 130), (80, 88, 98)], (66, 70, 74))
        c.area([(x0, 3), (x1, 3), (x1, 26), (x0, 26)], stones)
    for _ in range(10):
        x, y = c.rng.uniform(2, 42), c.rng.uniform(2, 27)
        c.box(x, y, x + 0.6, y + 0.6, (70, 72, 74))
        for k in range(5):
            c.box(x + 0.06, y + 0.08 + 0.1 * k, x + 0.54, y + 0.12 + 0.1 * k, (150, 152, 154))
    c.add(c.noise((0.03, 0.08, 0.3, 1.0)), (8, 8, 8))
    materials.weather(c)
    materials.litter(c, 0.7)


def _houses(b: Builder) -> None:
    ochre = Facade(materials.plaster((120, 178, 216)), 3, shop=True, window_m=(0.9, 1.4), pitch_m=2.1)
    green = Facade(materials.plaster((150, 190, 160)), 3, frame=(70, 90, 70), posters=3)
    hall = Facade(parts.SANDSTONE, 3, window_m=(1.2, 1.9), pitch_m=2.5, storey_m=3.3, posters=1)
    brick = Facade(parts.BRICK_RED, 3, shop=True)
    pale = Facade(parts.BRICK_YELLOW, 2, graffiti=True, posters=3)
    terracotta = Facade(materials.plaster((110, 136, 204)), 2, ivy=True, posters=2)
    slate = Facade(parts.BRICK_DARK, 3, frame=(190, 200, 205), shop=True)
    same = Facade(materials.plaster((200, 206, 198), 0.7), 3, same=True, posters=1, pitch_m=2.1)
    timber = Facade(parts.TIMBER, 2, window_m=(0.85, 1.1), pitch_m=1.9)
    blank = Facade(materials.plaster((190, 198, 204), 0.2), 2, pitch_m=6.0, posters=0)
    rubble = Facade(parts.RUBBLE, 2, window_m=(0.8, 1.2))
    row = parts.row_of_houses
    row(b, "north", (-20, -12.5), (20, -12.5), [ochre, same, brick, green, rubble, slate], [6, 7, 7, 6, 6, 8])
    row(b, "south", (20, 12.5), (-20, 12.5), [terracotta, timber, slate, pale, ochre, rubble], [7, 6, 7, 7, 7, 6])
    row(b, "east", (20, -12.5), (20, 12.5), [hall, blank, green], [13, 4, 8])
    row(b, "west", (-20, 12.5), (-20, -12.5), [brick, pale, terracotta, timber], [7, 6, 7, 5])
    for k in range(6):
        column = materials.marble((150, 172, 186), (96, 112, 128))
        b.column(f"arcade{k}", (18.4, -9.6 + 2.4 * k), 0.22, 3.1, column)

    def lintel(c: Canvas) -> None:
        parts.SANDSTONE(c)
        c.text(0.6, 0.2, 0.4, f"{details.word(c.rng)} {details.word(c.rng)}", (40, 50, 60), c.width_m - 1.2)

    b.box("arcade", (18.4, -3.6), (0.6, 0.7, 13.0), lintel, bottom=3.1, faces="fblrtu", solid=False)


def _fountain(b: Builder) -> None:
    def basin(c: Canvas) -> None:
        parts.GRANITE(c)
        details.emblem(c, c.width_m / 2, c.height_m / 2, 0.22)
        c.add(c.noise((0.05, 0.2, 0.6)), (10, 10, 10))

    b.column("basin", (0, 0), 2.2, 0.7, basin, sides=12)

    def water(c: Canvas) -> None:
        materials.marble((150, 140, 90), (210, 205, 180))(c)
        materials.litter(c, 2)

    b.floor("water", (-1.55, -1.55), (1.55, 1.55), 0.62, water)
    b.column("shaft", (0, 0), 0.45, 2.4, materials.marble((168, 176, 180), (90, 96, 104)), sides=8)
    b.column("bowl", (0, 0), 0.95, 0.3, basin, 1.4, sides=12)
    b.box("statue", (0, 0), (0.6, 1.5, 0.5), materials.marble((96, 120, 84), (60, 76, 50)), bottom=2.4, yaw_deg=20)


def _market(b: Builder) -> None:
    for k, (x, z, yaw) in enumerate(((-3.5, -6.0 + 2.2, 8), (3.6, -4.0, -12), (5.6, 3.6, 20), (-4.8, 4.2, -24))):
        cloth = materials.stripes((228, 232, 236), details.bright(b.rng), 0.25)

        def goods(c: Canvas) -> None:
            materials.wood((70, 100, 130), 0.1)(c)
            for _ in range(int(c.width_m * c.height_m * 40)):
                x, y = c.rng.uniform(0.1, c.width_m - 0.1), c.rng.uniform(0.15, c.height_m)
                c.disc(x, y, c.rng.uniform(0.03, 0.07), details.bright(c.rng))
            details.notice(c, c.width_m * 0.4, 0.1, 0.3, 0.22)

        turn, roof = math.radians(yaw), (2.8, 0.3, 1.6)
        b.box(f"stall{k}", (x, z), (2.4, 0.95, 1.1), goods, yaw_deg=yaw)
        b.box(f"stall{k}.roof", (x, z), roof, cloth, bottom=2.15, yaw_deg=yaw, faces="fblrtu", solid=False)
        for i in (-1.2, 1.2):
            pole = (x + i * math.cos(turn), z - i * math.sin(turn))
            b.box(f"stall{k}.pole{i}", pole, (0.07, 2.15, 0.07), materials.plain((60, 60, 64)), yaw_deg=yaw)
