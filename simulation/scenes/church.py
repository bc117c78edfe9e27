"""Church: a stone church with a tower in its yard, houses and walls around it, 50 by 40 m."""

import math

from groundwalk.simulation import details, materials
from groundwalk.simulation.canvas import Canvas
from groundwalk.simulation.place import Light, Place
from groundwalk.simulation.scenes import parts
from groundwalk.simulation.scenes.builder import Builder
from groundwalk.simulation.scenes.parts import Facade

EXTENT_M = (50.0, 40.0)
_EAVES_M = 8.0


def build(seed: int) -> Place:
    """The place; houses along the four sides, the church west of the middle."""
    b = Builder("Church", EXTENT_M, 14.0, Light(0.62, (0.5, 0.75, 0.45), 0.6), seed)
    b.floor("ground", (-27, -22), (27, 22), 0, _ground)
    _nave(b)
    _tower(b)
    _surroundings(b)
    _yard(b)
    return b.place


def _ground(c: Canvas) -> None:
    materials.cobbles(0.16, [(120, 126, 130), (104, 108, 114), (138, 142, 146), (92, 104, 120)], (88, 92, 94))(c)
    # The picture's (0, 0) is the south-west corner, so plan (x, z) is (x + 27, 22 - z).
    for name, low, high in (("a", (4, 6), (15, 10.5)), ("b", (38, 17), (47, 27)), ("c", (19, 33.5), (33, 38))):
        points = [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
        c.area(points, materials.grass if name != "b" else materials.gravel)
        c.line([*points, points[0]], 0.18, (150, 156, 160))
    tones = [(160, 168, 172), (142, 150, 156), (172, 176, 178)]
    slabs = materials.masonry(0.6, 0.9, tones, (90, 94, 96), 0.02, 12, 0.3)
    c.area([(31, 19), (38, 19), (38, 25), (31, 25)], slabs)
    c.area([(1, 0.5), (53, 0.5), (53, 3.2), (1, 3.2)], materials.asphalt)
    for k in range(14):
        x = c.rng.uniform(2, 52)
        y = c.rng.uniform(1, 43)
        c.disc(x, y, 0.35, (62, 64, 66))
        c.disc(x, y, 0.29, (100, 102, 104))
        c.text(x - 0.2, y - 0.05, 0.1, f"{k}{details.word(c.rng, 1)}", (40, 40, 40), 0.4)
    materials.litter(c, 0.5)


def _church_side(c: Canvas) -> None:
    parts.SANDSTONE(c)
    count = max(1, int(c.width_m / 3.2))
    for k in range(count):
        x = (k + 0.5) * c.width_m / count
        details.arched_window(c, x - 0.65, 2.2, 1.3, 4.2)
        c.box(x - c.width_m / count / 2 - 0.3, 0, x - c.width_m / count / 2 + 0.3, 6.5, (112, 140, 160))
    for _ in range(int(c.width_m / 2)):
        details.notice(c, c.rng.uniform(0.2, c.width_m - 0.8), c.rng.uniform(1.0, 1.7), 0.35, 0.45)
    c.box(0, 0, c.width_m, 0.5, (96, 112, 124))
    c.add(c.noise((0.06, 0.3, 1.1)), (9, 9, 9))
    details.ivy(c, c.rng.uniform(0, 0.6) * c.width_m, 0.3, 2.4, 4.0)


def _west_front(c: Canvas) -> None:
    parts.SANDSTONE(c)
    w = c.width_m
    details.arched_window(c, w / 2 - 1.2, 4.4, 2.4, 3.2)
    for k in range(5):
        inset = 0.14 * k
        tone = 200 - 30 * k
        left, right = w / 2 - 1.6 + inset, w / 2 + 1.6 - inset
        arch = [(left, 0), (right, 0), (right, 2.6), (w / 2, 3.9 - inset), (left, 2.6)]
        c.polygon(arch, (tone * 0.8, tone * 0.92, tone))
    details.door(c, w / 2 - 0.85, 1.7, 2.5, (40, 62, 96))
    for x in (0.8, w - 1.9):
        details.arched_window(c, x, 1.8, 1.0, 2.6)
        details.notice(c, x + 0.1, 0.9, 0.6, 0.75)
    c.add(c.noise((0.06, 0.3, 1.1)), (8, 8, 8))


def _nave(b: Builder) -> None:
    x0, x1, z0, z1 = -12.0, 4.0, -4.5, 4.5
    b.wall("nave.south", (x0, z1), (x1, z1), 0, _EAVES_M, _church_side)
    b.wall("nave.north", (x1, z0), (x0, z0), 0, _EAVES_M, _church_side)
    b.wall("nave.west", (x0, z0), (x0, z1), 0, _EAVES_M, _west_front)
    b.wall("nave.east", (x1, z1), (x1, z0), 0, _EAVES_M, _church_side)
    ridge = 4.2
    for side, z in (("south", z1 + 0.4), ("north", z0 - 0.4)):
        right = (x1 - x0, 0, 0) if side == "south" else (x0 - x1, 0, 0)
        corner = (x0 if side == "south" else x1, _EAVES_M - 0.2, z)
        b.quad(f"nave.roof.{side}", corner, right, (0, ridge, -z), parts.SLATES, 1.5)
    for side, x, sign in (("west", x0, 1), ("east", x1, -1)):
        start = z0 if sign > 0 else z1
        b.quad(f"gable.{side}", (x, _EAVES_M, start), (0, 0, sign * 9), (0, 2.2, 0), parts.SANDSTONE)
    for k in range(4):
        x = x0 + 1.6 + 4.1 * k
        for z, yaw in ((z1 + 0.4, 0), (z0 - 0.4, 180)):
            b.box(f"buttress{k}{yaw}", (x, z), (0.7, 5.2, 0.8), parts.GRANITE, yaw_deg=yaw)
    b.block((x0, 0, z0), (x1, _EAVES_M + ridge, z1))


def _tower(b: Builder) -> None:
    def side(c: Canvas) -> None:
        parts.GRANITE(c)
        for y in (4.0, 8.5):
            details.arched_window(c, c.width_m / 2 - 0.5, y, 1.0, 2.2)
        c.disc(c.width_m / 2, 12.4, 1.05, (40, 44, 48))
        c.disc(c.width_m / 2, 12.4, 0.92, (228, 234, 238))
        for hour in range(12):
            a = math.radians(30 * hour)
            c.disc(c.width_m / 2 + 0.75 * math.sin(a), 12.4 + 0.75 * math.cos(a), 0.07, (30, 30, 30))
        c.line([(c.width_m / 2, 12.4), (c.width_m / 2 + 0.4, 12.7)], 0.08, (20, 20, 20))
        c.line([(c.width_m / 2, 12.4), (c.width_m / 2 - 0.2, 13.1)], 0.05, (20, 20, 20))
        details.notice(c, 0.6, 1.1, 0.7, 0.9)
        details.poster(c, c.width_m - 1.4, 1.0, 0.7, 1.0)
        c.add(c.noise((0.07, 0.4, 1.5)), (9, 9, 9))

    b.box("tower", (6.25, 0.0), (4.5, 15.5, 4.5), side, faces="fblr")
    top = 15.5
    for k in range(4):
        yaw = math.radians(90 * k)
        right = (math.cos(yaw) * 5.2, 0, -math.sin(yaw) * 5.2)
        corner = (6.25 - right[0] / 2 + 2.6 * math.sin(yaw), top, -right[2] / 2 + 2.6 * math.cos(yaw))
        up = (-2.6 * math.sin(yaw), 5.0, -2.6 * math.cos(yaw))
        b.quad(f"spire{k}", corner, right, up, parts.SLATES, 1.5)


def _surroundings(b: Builder) -> None:
    red = Facade(parts.BRICK_RED, 3, graffiti=True)
    yellow = Facade(parts.BRICK_YELLOW, 2, shop=True, frame=(60, 90, 60))
    cream = Facade(materials.plaster((176, 214, 230)), 3, ivy=True)
    pink = Facade(materials.plaster((168, 172, 214)), 2, window_m=(0.9, 1.3), pitch_m=2.0, posters=3)
    blue = Facade(materials.plaster((196, 170, 138)), 3, shop=True)
    stone = Facade(parts.GRANITE, 2, frame=(50, 60, 80), posters=3)
    dark = Facade(parts.BRICK_DARK, 3, graffiti=True, frame=(200, 205, 205))
    timber = Facade(parts.TIMBER, 2, window_m=(0.9, 1.2), posters=2)
    same = Facade(materials.plaster((190, 200, 204), 0.8), 3, same=True, posters=1)
    blank = Facade(materials.plaster((206, 214, 216), 0.25), 2, pitch_m=7.0, posters=0)
    rubble = Facade(parts.RUBBLE, 2, window_m=(0.8, 1.1), pitch_m=3.0)
    row = parts.row_of_houses
    row(b, "north", (-25, -20), (25, -20), [red, yellow, same, cream, stone, blue, pink], [7, 7, 9, 7, 6, 8, 6])
    row(b, "east", (25, -20), (25, 20), [timber, dark, blank, yellow, rubble, cream], [6, 8, 5, 8, 6, 7])
    row(b, "south", (25, 20), (-25, 20), [pink, rubble, blue, red, same, timber, stone], [7, 7, 8, 8, 7, 6, 7])
    row(b, "west", (-25, 20), (-25, -20), [dark, cream, pink, yellow, red], [8, 7, 8, 8, 9])


def _yard(b: Builder) -> None:
    for k, at in enumerate(((-18.5, 13), (-14, 13.4), (17, -2.4), (19.5, 3.0), (1, -14), (-2.5, -14.2), (14.5, -13))):
        b.tree(f"tree{k}", at, b.rng.uniform(5, 7))
    b.benches((-16, 11.2, 180), (16.6, 0.2, -90), (4.2, -12.6, 0), (-21.8, -3, 90), (10, 14.5, 180))
    b.lamp_posts((-20.5, 6), (-20, -9.5), (-7, -9.2), (10, -9), (19.5, -8), (20, 9), (6, 9.6), (-8, 9.8))
    parts.kiosk(b, (17.5, 13.5), 25)
    parts.car(b, "van", (-11, 17.6), 3)
    parts.car(b, "car", (12, 17.8), -2)
    parts.bins(b, (-15, -14.5), (15, -9.5), (19.8, 6.2))
    for k, (x, z, yaw) in enumerate(((-19.5, 0.5, 80), (15.6, -5.4, -60), (-9, -13.5, 10))):

        def stone(c: Canvas) -> None:
            materials.marble((150, 154, 156), (90, 92, 96))(c)
            for row in range(4):
                c.text(0.15, c.height_m - 0.4 - 0.28 * row, 0.15, details.word(c.rng, 4), (50, 50, 54), c.width_m - 0.3)

        b.box(f"memorial{k}", (x, z), (1.6, 1.6, 0.4), stone, yaw_deg=yaw)
