"""Office: a furnished room with shelves, desks, a window and a glass partition, 7.5 by 4 m."""

from groundwalk.simulation import details, materials
from groundwalk.simulation.canvas import Canvas
from groundwalk.simulation.place import Light, Place
from groundwalk.simulation.scenes import indoor_parts as parts
from groundwalk.simulation.scenes.builder import Builder
from groundwalk.simulation.scenes.indoor_parts import Hung

EXTENT_M = (7.5, 4.0)
_CEILING_M = 2.8


def build(seed: int) -> Place:
    """The room; its window looks north, the glass partition closes a niche in the east."""
    lamps = (((-2.0, 2.6, 0.0), 0.55), ((1.2, 2.6, 0.0), 0.55))
    b = Builder("Office", EXTENT_M, _CEILING_M, Light(0.55, None, 0, lamps), seed, 0.33)
    x, z = EXTENT_M[0] / 2, EXTENT_M[1] / 2
    b.floor("floor", (-x, -z), (x, z), 0, materials.carpet((120, 108, 98)))
    b.ceiling("ceiling", (-x, -z), (x, z), _CEILING_M, _ceiling)
    b.wall("north", (-x, -z), (x, -z), 0, _CEILING_M, _window_wall)
    b.wall("south", (x, z), (-x, z), 0, _CEILING_M, Hung(materials.plaster((196, 206, 210), 0.5), 0.5, 0.5, 0.4).paint)
    b.wall("west", (-x, z), (-x, -z), 0, _CEILING_M, Hung(materials.plaster((150, 186, 170), 0.5), 0.3, 0.6, 0.5).paint)
    b.wall("east", (x, -z), (x, z), 0, _CEILING_M, Hung(materials.plaster((176, 190, 222), 0.4), 0.6, 0.5, 0.3).paint)
    _furniture(b)
    return b.place


def _ceiling(c: Canvas) -> None:
    parts.CEILING(c)
    for x in (1.4, 4.2):
        for y in (0.9, 2.5):
            c.box(x, y, x + 1.2, y + 0.6, (250, 250, 250))
    materials.weather(c, 0.5)


def _window_wall(c: Canvas) -> None:
    Hung(materials.plaster((204, 210, 212), 0.35), 0.1, 0.8, 0.3).paint(c)
    for x in (1.3, 4.2):

        def view(p: Canvas) -> None:
            materials.foliage((60, 110, 80))(p)
            p.box(0, p.height_m * 0.6, p.width_m, p.height_m, (238, 226, 214))
            for _ in range(4):
                u = p.rng.uniform(0, p.width_m - 0.3)
                p.box(u, p.height_m * 0.3, u + 0.3, p.height_m * p.rng.uniform(0.55, 0.85), details.bright(p.rng))

        c.box(x - 0.08, 0.92, x + 1.88, 2.38, (60, 64, 68))
        c.inset(x, 1.0, x + 1.8, 2.3, view)
        c.box(x + 0.87, 1.0, x + 0.95, 2.3, (60, 64, 68))
        for k in range(5):
            c.box(x, 2.22 - 0.09 * k, x + 1.8, 2.27 - 0.09 * k, (214, 218, 222))


def _furniture(b: Builder) -> None:
    parts.bookcase(b, "shelf.west", (-3.55, -0.6), 1.6, 90)
    parts.bookcase(b, "shelf.south", (-2.6, 1.8), 1.5, 180)
    parts.bookcase(b, "shelf.low", (2.9, 1.8), 1.3, 180, 1.2)
    parts.desk(b, "desk0", (-2.0, -1.6), 0)
    parts.desk(b, "desk1", (0.6, -1.6), 0)
    parts.desk(b, "desk2", (1.0, 1.62), 180, 1.3)
    parts.chair(b, "chair0", (-3.2, 0.9), 130)
    edge, board = materials.plain((150, 154, 158)), parts.whiteboard
    b.box("board", (-0.75, 1.96), (1.5, 1.1, 0.05), edge, front=board, bottom=0.95, yaw_deg=180)
    b.box("cabinet", (3.5, -1.5), (0.8, 1.35, 0.45), _cabinet, yaw_deg=-90)
    b.box("copier", (2.3, -1.65), (0.7, 1.0, 0.6), _cabinet)
    b.box("plant", (3.45, 0.75), (0.34, 0.4, 0.34), materials.plain((60, 90, 150)))
    b.bush("plant.leaves", (3.45, 0.75), 0.3, 0.4)
    parts.pane(b, "partition", (2.75, -1.35 + 0.35), (2.75, -0.55), 0, 2.1)


def _cabinet(c: Canvas) -> None:
    materials.plain((170, 176, 180))(c)
    rows = max(2, round(c.height_m / 0.33))
    for k in range(rows):
        y = c.height_m * k / rows
        c.box(0.02, y + 0.01, c.width_m - 0.02, y + c.height_m / rows - 0.02, (196, 200, 204))
        c.box(c.width_m / 2 - 0.06, y + 0.2, c.width_m / 2 + 0.06, y + 0.22, (60, 60, 60))
        details.notice(c, 0.06 + c.rng.uniform(0, 0.2), y + 0.06, 0.12, 0.1)
    details.notice(c, c.width_m * 0.55, c.height_m * 0.5, 0.18, 0.24)
