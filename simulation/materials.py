"""What surfaces are made of: each function fills a canvas with a material that doesn't repeat."""

import math
from collections.abc import Sequence

import cv2
import numpy as np

from groundwalk.simulation.canvas import Bgr, Canvas, Field, material

_FINE = (0.006, 0.011, 0.02, 0.04, 0.09, 0.2)
_WEATHER = (0.4, 0.9, 2.0, 5.0)


@material
def masonry(
    c: Canvas,
    course_m: float,
    length_m: float,
    colours: Sequence[Bgr],
    joint: Bgr,
    joint_m: float = 0.012,
    spread: float = 14.0,
    irregular: float = 0.0,
) -> None:
    """Bricks, stones, slabs or planks in courses, each of its own tone; `irregular` varies their sizes (0 to 1)."""

    rng = c.rng
    h, w = c.shape
    x = (np.arange(w, dtype=np.float32) + 0.5) * c.texel_m
    joint_px = max(1, round(joint_m / c.texel_m))
    palette = np.array(colours, np.float32)
    c.fill(joint)
    top, course = 0.0, 0
    while top < h:
        rise = course_m * (1 + irregular * rng.uniform(-0.45, 0.6)) / c.texel_m
        count = math.ceil(w * c.texel_m / length_m * 2.6) + 4
        lengths = length_m * (1 + max(irregular, 0.06) * rng.uniform(-0.6, 0.9, count))
        edges = np.cumsum(lengths) - length_m * (1.5 + 0.5 * (course % 2))
        block = np.searchsorted(edges, x)
        base = palette[rng.integers(len(palette), size=len(edges) + 1)]
        tone = base + rng.normal(0, spread, (len(edges) + 1, 1)) + rng.normal(0, spread / 4, (len(edges) + 1, 3))
        row = tone[block]
        seam = np.zeros(w, bool)
        changes = np.flatnonzero(np.diff(block))
        for k in range(joint_px):
            seam[np.clip(changes - k, 0, w - 1)] = True
        row[seam] = joint
        r0, r1 = round(top), round(top + rise)
        inner = slice(max(r0, 0), max(min(r1 - joint_px, h), 0))
        c.image[inner] = np.clip(row, 0, 255).astype(np.uint8)
        # A lit upper and a shaded lower edge give the courses relief.
        if r1 - r0 > 3 * joint_px + 2 and inner.stop > inner.start:
            for edge, step in ((inner.start, 12), (inner.stop - 1, -18)):
                c.image[edge] = np.clip(np.where(seam[:, None], row, row + step), 0, 255).astype(np.uint8)
        top += rise
        course += 1
    c.add(c.noise(_FINE), (9, 9, 9))
    weather(c)


def weather(c: Canvas, amount: float = 1.0) -> None:
    """Stains and fading at several scales, and streaks that run down."""
    c.add(c.noise(_WEATHER, (0.7, 1, 1, 1)), (9 * amount, 9 * amount, 10 * amount))
    dirt = c.noise((0.15, 0.5, 1.6), (0.6, 1, 1))
    c.blend(np.clip(dirt - 1.3, 0, 1) * np.float32(0.5 * amount), (48, 52, 55))
    light = c.noise((0.12, 0.45, 1.2), (0.7, 1, 1))
    c.blend(np.clip(light - 1.5, 0, 1) * np.float32(0.5 * amount), (205, 212, 215))


def streaks(c: Canvas, amount: float = 14.0) -> None:
    """Rain marks: noise drawn out downwards."""
    h, w = c.shape
    thin = c.rng.standard_normal((max(2, h // 90), max(2, w // 3)), dtype=np.float32)
    field = cv2.resize(thin, (w, h), interpolation=cv2.INTER_CUBIC)
    c.add(np.asarray(field, np.float32), (amount * 0.9, amount * 0.95, amount))


@material
def plaster(c: Canvas, colour: Bgr, roughness: float = 1.0) -> None:
    """Painted plaster with stains, a few cracks and patches; with `roughness` near 0 a blank wall."""

    c.fill(colour)
    c.add(c.noise(_FINE), (7 * roughness,) * 3)
    if roughness < 0.4:
        c.add(c.noise(_WEATHER), (3, 3, 3))
        return
    weather(c, roughness)
    streaks(c, 7 * roughness)
    for _ in range(round(c.width_m * c.height_m * 0.12 * roughness)):
        crack(c)
    for _ in range(round(c.width_m * c.height_m * 0.06 * roughness)):
        x, y = c.rng.uniform(0, c.width_m), c.rng.uniform(0, c.height_m)
        patch(c, x, y, c.rng.uniform(0.15, 0.6))


def crack(c: Canvas) -> None:
    x, y = c.rng.uniform(0, c.width_m), c.rng.uniform(0, c.height_m)
    angle = c.rng.uniform(0, 2 * math.pi)
    points = [(x, y)]
    for _ in range(c.rng.integers(4, 12)):
        angle += c.rng.normal(0, 0.6)
        x, y = x + 0.12 * math.cos(angle), y + 0.12 * math.sin(angle)
        points.append((x, y))
    c.line(points, 0.008, (45, 48, 50))


def patch(c: Canvas, x: float, y: float, radius_m: float) -> None:
    """A ragged spot where another layer shows."""
    angles = np.sort(c.rng.uniform(0, 2 * math.pi, 9))
    reach = radius_m * c.rng.uniform(0.5, 1.0, 9)
    grey = c.rng.uniform(70, 200)
    points = list(zip(x + reach * np.cos(angles), y + reach * np.sin(angles) * 0.7, strict=True))
    c.polygon(points, (grey * 0.93, grey * 0.97, grey))


@material
def cobbles(c: Canvas, size_m: float, colours: Sequence[Bgr], joint: Bgr) -> None:
    """Round stones set without order (a Voronoi pattern)."""

    h, w = c.shape
    step = size_m / c.texel_m
    rows, columns = math.ceil(h / step) + 1, math.ceil(w / step) + 1
    jitter = c.rng.uniform(-0.36, 0.36, (rows, columns, 2))
    r, k = np.mgrid[0:rows, 0:columns]
    seed_rows = np.clip(((r + 0.5 + jitter[..., 0]) * step), 0, h - 1).astype(int).ravel()
    seed_columns = np.clip(((k + (r % 2) * 0.5 + jitter[..., 1]) * step), 0, w - 1).astype(int).ravel()
    seeds = np.full((h, w), 255, np.uint8)
    seeds[seed_rows, seed_columns] = 0
    distance, label = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL)
    palette = np.array(colours, np.float32)
    count = int(label.max()) + 1
    tone = palette[c.rng.integers(len(palette), size=count)] + c.rng.normal(0, 16, (count, 1))
    c.image[:] = np.clip(tone, 0, 255).astype(np.uint8)[label]
    c.blend(np.clip((distance.astype(np.float32) / np.float32(step) - 0.42) * 6, 0, 1), joint)
    c.add(c.noise(_FINE), (9, 9, 9))
    weather(c)


def asphalt(c: Canvas) -> None:
    c.fill((98, 98, 96))
    c.add(c.noise((0.025, 0.04, 0.08), (1, 1, 0.5)), (16, 16, 16))
    weather(c)
    for _ in range(round(c.width_m * c.height_m * 0.04)):
        crack(c)
    litter(c, 1.2)


def litter(c: Canvas, per_m2: float) -> None:
    colours = [(40, 90, 150), (30, 60, 110), (60, 120, 90), (225, 225, 225), (35, 35, 35), (50, 140, 190)]
    for _ in range(round(c.width_m * c.height_m * per_m2)):
        x, y = c.rng.uniform(0, c.width_m), c.rng.uniform(0, c.height_m)
        a, size = c.rng.uniform(0, math.pi), c.rng.uniform(0.02, 0.07)
        along = np.array([math.cos(a), math.sin(a)]) * size
        across = np.array([-along[1], along[0]]) * c.rng.uniform(0.25, 0.8)
        corners = np.array([x, y]) + np.stack([along, across, -along, -across])
        c.polygon([(float(u), float(v)) for u, v in corners], colours[c.rng.integers(len(colours))])


def grass(c: Canvas) -> None:
    c.fill((48, 112, 92))
    c.add(c.noise((0.03, 0.06, 0.12), (1, 1, 0.8)), (10, 20, 14))
    c.add(c.noise((0.3, 0.8, 2.5)), (5, 11, 10))
    bare: Field = c.noise((0.25, 0.8, 2.0))
    c.blend(np.clip(bare - 1.2, 0, 0.8), (84, 112, 134))
    for _ in range(round(c.width_m * c.height_m * 0.8)):
        tone = [(240, 240, 245), (60, 210, 240), (190, 90, 200), (90, 120, 60)][c.rng.integers(4)]
        c.disc(c.rng.uniform(0, c.width_m), c.rng.uniform(0, c.height_m), c.rng.uniform(0.015, 0.04), tone)
    litter(c, 0.6)


def gravel(c: Canvas) -> None:
    c.fill((150, 162, 170))
    c.add(c.noise((0.024, 0.04, 0.07), (1, 1, 1)), (26, 26, 26))
    weather(c, 0.8)
    litter(c, 2.0)


@material
def foliage(c: Canvas, colour: Bgr) -> None:
    c.fill(colour)
    field = c.noise((0.05, 0.09, 0.17, 0.35), (0.8, 1, 1, 0.8))
    c.add(field, (14, 26, 20))
    c.blend(np.clip(-field - 0.8, 0, 0.8), (14, 24, 18))
    c.blend(np.clip(field - 1.4, 0, 0.7), (110, 215, 200))
    for _ in range(round(c.width_m * c.height_m * 8)):
        x, y = c.rng.uniform(0, c.width_m), c.rng.uniform(0, c.height_m)
        grey = c.rng.uniform(0.5, 1.6)
        c.disc(x, y, c.rng.uniform(0.015, 0.05), (colour[0] * grey, colour[1] * grey, colour[2] * grey))


@material
def wood(c: Canvas, colour: Bgr, plank_m: float = 0.14) -> None:
    masonry(plank_m, 1.7, [colour], (colour[0] * 0.4, colour[1] * 0.4, colour[2] * 0.4), 0.006, 12)(c)
    h, w = c.shape
    grain = c.rng.standard_normal((max(2, h // 2), max(2, w // 24)), dtype=np.float32)
    c.add(np.asarray(cv2.resize(grain, (w, h), interpolation=cv2.INTER_CUBIC), np.float32), (6, 8, 9))
    for _ in range(round(c.width_m * c.height_m * 1.5)):
        x, y = c.rng.uniform(0, c.width_m), c.rng.uniform(0, c.height_m)
        c.disc(x, y, c.rng.uniform(0.01, 0.03), (colour[0] * 0.35, colour[1] * 0.35, colour[2] * 0.4))


@material
def panels(c: Canvas, colour: Bgr, width_m: float = 1.2, height_m: float = 0.8) -> None:
    masonry(height_m, width_m, [colour], (40, 40, 40), 0.015, 7)(c)
    streaks(c, 9)


@material
def marble(c: Canvas, colour: Bgr, vein: Bgr) -> None:
    c.fill(colour)
    c.add(c.noise((0.1, 0.3, 0.9)), (8, 8, 8))
    field = np.abs(c.noise((0.15, 0.5, 1.4), (0.5, 1, 1)))
    c.blend(np.clip(0.5 - field * 6, 0, 1), vein)
    field = np.abs(c.noise((0.06, 0.2, 0.5), (0.5, 1, 1)))
    c.blend(np.clip(0.3 - field * 6, 0, 1), vein)


@material
def tiles(c: Canvas, size_m: float, colours: Sequence[Bgr], joint: Bgr, spread: float = 8.0) -> None:
    h, w = c.shape
    column = (np.arange(w) * c.texel_m / size_m).astype(int)
    row = (np.arange(h) * c.texel_m / size_m).astype(int)
    palette = np.array(colours, np.float32)
    shape = (int(row[-1]) + 1, int(column[-1]) + 1)
    tone = palette[c.rng.integers(len(palette), size=shape)] + c.rng.normal(0, spread, (*shape, 1))
    c.image[:] = np.clip(tone, 0, 255).astype(np.uint8)[row[:, None], column[None, :]]
    joint_px = max(1, round(0.01 / c.texel_m))
    for axis, index in ((0, row), (1, column)):
        starts = np.flatnonzero(np.diff(index))
        for k in range(joint_px):
            if axis == 0:
                c.image[np.clip(starts - k, 0, h - 1)] = joint
            else:
                c.image[:, np.clip(starts - k, 0, w - 1)] = joint
    c.add(c.noise(_FINE), (5, 5, 5))
    weather(c, 0.7)


@material
def stripes(c: Canvas, first: Bgr, second: Bgr, width_m: float) -> None:
    for k in range(int(c.width_m / width_m) + 1):
        c.box(width_m * k, 0, width_m * k + width_m, c.height_m, second if k % 2 else first)
    c.add(c.noise((0.05, 0.3, 1.0)), (8, 8, 8))


@material
def carpet(c: Canvas, colour: Bgr) -> None:
    c.fill(colour)
    c.add(c.noise((0.006, 0.012, 0.025, 0.05, 0.1)), (14, 14, 14))
    weather(c, 1.1)
    for _ in range(round(c.width_m * c.height_m * 1.0)):
        patch(c, c.rng.uniform(0, c.width_m), c.rng.uniform(0, c.height_m), c.rng.uniform(0.02, 0.09))


@material
def plain(c: Canvas, colour: Bgr, roughness: float = 6.0) -> None:
    """A painted thing with dents and scratches."""

    c.fill(colour)
    c.add(c.noise((0.007, 0.015, 0.03, 0.08, 0.25, 0.7)), (roughness,) * 3)
    for _ in range(round(c.width_m * c.height_m * 3)):
        x, y = c.rng.uniform(0, c.width_m), c.rng.uniform(0, c.height_m)
        angle, reach = c.rng.uniform(0, math.pi), c.rng.uniform(0.03, 0.15)
        grey = c.rng.uniform(30, 220)
        c.line([(x, y), (x + reach * math.cos(angle), y + reach * math.sin(angle))], 0.006, (grey, grey, grey))
