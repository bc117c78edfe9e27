"""Furniture and walls of rooms."""

from dataclasses import dataclass

from groundwalk.simulation import details, materials
from groundwalk.simulation.canvas import Bgr, Canvas, Material
from groundwalk.simulation.place import Xz
from groundwalk.simulation.scenes.builder import Builder

CEILING = materials.tiles(0.6, [(216, 220, 222), (208, 213, 216)], (150, 152, 154), 4)


@dataclass(frozen=True)
class Hung:
    """A wall with things on it: how many pictures, notices and posters a metre of its length."""

    wall: Material
    pictures: float = 0.25
    notices: float = 0.4
    posters: float = 0.25

    def paint(self, c: Canvas) -> None:
        """The wall; things hang between 0.6 and 2.3 m above its lower edge, in places of their own."""
        self.wall(c)
        c.box(0, 0, c.width_m, 0.1, (60, 66, 72))
        rng = c.rng
        x = rng.uniform(0.1, 0.4)
        total = self.pictures + self.notices + self.posters
        while total > 0 and x < c.width_m - 0.5:
            kind = rng.choice(3, p=[self.pictures / total, self.notices / total, self.posters / total])
            w, h = ((0.75, 0.55), (0.24, 0.32), (0.5, 0.72))[kind]
            w, h = w * rng.uniform(0.7, 1.3), h * rng.uniform(0.8, 1.2)
            if x + w > c.width_m - 0.1:
                break
            y = rng.uniform(0.9, max(1.0, min(2.3, c.height_m - 0.1) - h))
            (details.picture, details.notice, details.poster)[kind](c, x, y, w, h)
            if kind == 1:
                details.notice(c, x + rng.uniform(-0.05, 0.05), max(0.5, y - h - 0.08), w, h)
            x += w + rng.exponential(max(0.15, 1 / total - 0.45)) + 0.1
        if c.rng.random() < 0.6:
            s = rng.uniform(0.2, max(0.3, c.width_m - 0.3))
            c.box(s, 1.05, s + 0.09, 1.17, (236, 238, 240))
            c.box(s + 0.03, 1.08, s + 0.06, 1.14, (120, 124, 126))
        c.add(c.noise((0.03, 0.1, 0.4)), (3, 3, 3))


def bookcase(b: Builder, name: str, centre: Xz, width: float, yaw_deg: float, height: float = 2.1) -> None:
    """A shelf full of books; its front looks along +z before it is turned."""
    tone: Bgr = ((70, 104, 140), (50, 60, 70), (190, 200, 206))[b.rng.integers(3)]
    side, front = materials.wood(tone, 0.3), details.bookcase(tone)
    b.box(name, centre, (width, height, 0.35), side, front=front, yaw_deg=yaw_deg)


def desk(b: Builder, name: str, centre: Xz, yaw_deg: float, width: float = 1.4) -> None:
    """A desk with papers and a screen on it; one sits on its +z side before it is turned."""

    def top(c: Canvas) -> None:
        materials.wood((96, 136, 170), 0.4)(c)
        for _ in range(7):
            details.notice(c, c.rng.uniform(0, c.width_m - 0.3), c.rng.uniform(0, c.height_m - 0.3), 0.21, 0.29)
        for _ in range(6):
            c.disc(c.rng.uniform(0.1, c.width_m), c.rng.uniform(0.1, c.height_m), 0.04, details.bright(c.rng))

    def side(c: Canvas) -> None:
        materials.wood((80, 116, 150), 0.25)(c)
        for k in range(3):
            c.box(0.05, 0.06 + 0.22 * k, min(0.5, c.width_m - 0.05), 0.24 + 0.22 * k, (110, 148, 180))
            c.box(0.2, 0.14 + 0.22 * k, 0.32, 0.16 + 0.22 * k, (50, 50, 50))
        details.notice(c, c.width_m * 0.55, 0.2, 0.25, 0.35)

    def screen(c: Canvas) -> None:
        c.fill((24, 22, 20))

        def windows(p: Canvas) -> None:
            p.fill((120, 80, 40))
            for _ in range(3):
                x, y = p.rng.uniform(0, 0.6 * p.width_m), p.rng.uniform(0, 0.5 * p.height_m)
                details.notice(p, x, y, 0.38 * p.width_m, 0.5 * p.height_m)

        c.inset(0.02, 0.02, c.width_m - 0.02, c.height_m - 0.02, windows)

    b.box(name, centre, (width, 0.74, 0.7), side, top=top, yaw_deg=yaw_deg)
    case = materials.plain((40, 40, 42))
    b.box(f"{name}.screen", centre, (0.55, 0.4, 0.06), case, front=screen, bottom=0.84, yaw_deg=yaw_deg)
    b.box(f"{name}.foot", centre, (0.2, 0.1, 0.15), materials.plain((60, 60, 62)), bottom=0.74, yaw_deg=yaw_deg)


def chair(b: Builder, name: str, centre: Xz, yaw_deg: float) -> None:
    """An office chair; one sits looking along +z before it is turned."""
    tone = details.bright(b.rng)
    cloth = materials.carpet(tone)
    b.box(f"{name}.seat", centre, (0.46, 0.1, 0.46), cloth, bottom=0.42, yaw_deg=yaw_deg, faces="fblrtu")
    b.box(f"{name}.stem", centre, (0.1, 0.42, 0.1), materials.plain((60, 60, 64)), yaw_deg=yaw_deg)
    b.box(f"{name}.back", centre, (0.44, 0.5, 0.07), cloth, bottom=0.5, yaw_deg=yaw_deg)


def whiteboard(c: Canvas) -> None:
    c.fill((236, 240, 240))
    for _ in range(16):
        x, y = c.rng.uniform(0.05, 0.7) * c.width_m, c.rng.uniform(0.08, 0.85) * c.height_m
        c.text(x, y, 0.07, f"{details.word(c.rng)} {c.rng.integers(10, 99)}", details.bright(c.rng), 0.5 * c.width_m)
    for _ in range(8):
        points = [(c.rng.uniform(0, c.width_m), c.rng.uniform(0, c.height_m)) for _ in range(3)]
        c.line(points, 0.012, details.bright(c.rng))


def pane(b: Builder, name: str, left: Xz, right: Xz, bottom: float, top: float, stickers: bool = True) -> None:
    """A sheet of glass in a frame, with a band of stickers at eye height; it stands in the way."""
    b.wall(name, left, right, bottom, top, materials.plain((120, 120, 110)), 4, True)
    frame = materials.plain((70, 72, 76))
    for end, at in (("left", left), ("right", right)):
        b.box(f"{name}.{end}", at, (0.06, top - bottom, 0.06), frame, bottom=bottom)
    if stickers:

        def band(c: Canvas) -> None:
            c.fill((226, 230, 232))
            u = 0.0
            while u < c.width_m:
                step = c.rng.uniform(0.1, 0.4)
                c.box(u, 0, u + step * 0.7, c.height_m, details.bright(c.rng))
                u += step

        along = ((right[0] - left[0]), (right[1] - left[1]))
        length = (along[0] ** 2 + along[1] ** 2) ** 0.5
        for away in (0.012, -0.012):
            shift = (-along[1] / length * away, along[0] / length * away)
            ends = [(p[0] + shift[0], p[1] + shift[1]) for p in (left, right)]
            if away < 0:
                ends.reverse()
            b.wall(f"{name}.band{away}", ends[0], ends[1], bottom + 1.25, bottom + 1.37, band)
    low = (min(left[0], right[0]) - 0.03, bottom, min(left[1], right[1]) - 0.03)
    b.block(low, (max(left[0], right[0]) + 0.03, top, max(left[1], right[1]) + 0.03))
