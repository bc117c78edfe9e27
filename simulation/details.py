"""What people put on walls: windows, doors, signs, posters, pictures, shelves of books, graffiti."""

import math
from collections.abc import Sequence

import numpy as np

from groundwalk.simulation.canvas import Bgr, Canvas, material, vary

# fmt: off
_SYLLABLES = [
    "ba", "be", "bo", "ca", "co", "da", "de", "do", "fa", "fi", "ga", "go", "ha", "ho", "ja", "ka", "ki",
    "la", "le", "lo", "ma", "mi", "mo", "na", "ne", "no", "pa", "pe", "po", "ra", "re", "ro", "sa", "se",
    "so", "ta", "to", "va", "vi", "wa", "ya", "zo", "an", "en", "in", "or", "ul", "er", "os",
]
# fmt: on
_BRIGHT: tuple[Bgr, ...] = (
    (40, 40, 190),
    (160, 70, 30),
    (50, 130, 40),
    (30, 160, 220),
    (140, 40, 120),
    (170, 150, 30),
    (25, 25, 28),
    (235, 235, 230),
    (20, 90, 200),
)


def word(rng: np.random.Generator, syllables: int = 3) -> str:
    """A name nobody owns."""
    return "".join(_SYLLABLES[i] for i in rng.integers(len(_SYLLABLES), size=syllables)).capitalize()


def bright(rng: np.random.Generator) -> Bgr:
    """One of a few strong colours."""
    return _BRIGHT[rng.integers(len(_BRIGHT))]


def contrast(colour: Bgr) -> Bgr:
    """Black or white, whichever stands out."""
    return (20, 20, 20) if sum(colour) > 330 else (240, 240, 240)


def window(c: Canvas, x: float, y: float, w: float, h: float, frame: Bgr, same: bool = False) -> None:
    """A window with its lower left corner at (x, y): sill, frame, panes, what is behind them.

    `same` leaves chance out: every such window looks like every other one.
    """
    rng = np.random.default_rng(7) if same else c.rng
    t = 0.07
    c.box(x - 0.12, y - 0.12, x + w + 0.12, y, (150, 155, 160))
    c.box(x - 0.02, y, x + w + 0.02, y + h + 0.02, (60, 60, 60))
    c.box(x, y, x + w, y + h, frame)
    dark = rng.uniform(25, 75)
    c.box(x + t, y + t, x + w - t, y + h - t, (dark * 1.2, dark * 1.05, dark))
    sky = rng.uniform(90, 170)
    slope = rng.uniform(0.2, 0.8)
    mirrored = [(x + t, y + h - t), (x + w - t, y + h - t), (x + w - t, y + h * slope), (x + t, y + h * (1.1 - slope))]
    c.polygon(mirrored, (sky * 1.1, sky, sky * 0.9))
    curtain = vary((190, 200, 210), rng, 25)
    width_fraction = rng.uniform(0.05, 0.4)
    if rng.random() < 0.7:
        c.box(x + t, y + t, x + t + width_fraction * w, y + h - t, curtain)
        for k in range(4):
            fold = x + t + width_fraction * w * (k + rng.uniform(0.2, 0.8)) / 4
            c.line([(fold, y + t), (fold, y + h - t)], 0.02, (120, 125, 130))
    if rng.random() < 0.5:
        c.box(x + w - t - width_fraction * w * 0.8, y + t, x + w - t, y + h - t, curtain)
    if rng.random() < 0.4:
        blind = y + h * rng.uniform(0.4, 0.8)
        for k in range(int((y + h - t - blind) / 0.08)):
            c.box(x + t, blind + 0.08 * k, x + w - t, blind + 0.08 * k + 0.05, (205, 210, 215))
    if rng.random() < 0.45:
        pot = x + w * rng.uniform(0.2, 0.8)
        c.box(pot - 0.09, y + t, pot + 0.09, y + t + 0.15, (60, 80, 160))
        for _ in range(14):
            leaf = rng.normal(0, 0.09, 2)
            c.disc(pot + leaf[0], y + t + 0.25 + leaf[1], 0.045, vary((60, 130, 70), rng, 25))
    c.box(x + w / 2 - t / 2, y, x + w / 2 + t / 2, y + h, frame)
    if h > 1.0:
        c.box(x, y + h * 0.62 - t / 2, x + w, y + h * 0.62 + t / 2, frame)


def arched_window(c: Canvas, x: float, y: float, w: float, h: float) -> None:
    arch = [(x, y), (x + w, y), (x + w, y + h * 0.65), (x + w * 0.85, y + h * 0.87), (x + w / 2, y + h)]
    arch += [(x + w * 0.15, y + h * 0.87), (x, y + h * 0.65)]
    middle = np.array([x + w / 2, y + h / 2])

    def scaled(factor: float) -> list[tuple[float, float]]:
        return [(float(p[0]), float(p[1])) for p in middle + (np.array(arch) - middle) * factor]

    c.polygon(scaled(1.16), (170, 178, 182))
    c.polygon(scaled(1.04), (90, 95, 100))
    c.polygon(scaled(0.97), (50, 42, 40))
    inside = [(u, v) for u in np.arange(x + 0.06, x + w - 0.1, 0.2) for v in np.arange(y + 0.08, y + h * 0.62, 0.24)]
    for u, v in inside:
        tone = vary(bright(c.rng), c.rng, 30)
        c.box(u, v, u + 0.17, v + 0.2, (tone[0] * 0.7, tone[1] * 0.7, tone[2] * 0.7))
    for radius, n in ((0.3, 9), (0.14, 5)):
        for k in range(n):
            a = 2 * math.pi * k / n
            centre = (x + w / 2 + radius * w * math.cos(a), y + h * 0.74 + radius * w * math.sin(a) * 0.8)
            c.disc(*centre, 0.07 * w, vary(bright(c.rng), c.rng, 30))


def door(c: Canvas, x: float, w: float, h: float, colour: Bgr) -> None:
    """A panelled door standing on the canvas's lower edge, with a step, a handle and a letter box."""
    c.box(x - 0.14, 0, x + w + 0.14, h + 0.16, (165, 170, 172))
    c.box(x - 0.03, 0.0, x + w + 0.03, h + 0.04, (50, 50, 50))
    c.box(x, 0.06, x + w, h, colour)
    shade = (colour[0] * 0.55, colour[1] * 0.55, colour[2] * 0.55)
    rows = int(c.rng.integers(2, 5))
    for column in range(2):
        for row in range(rows):
            u = x + w * (0.08 + 0.46 * column)
            v = 0.15 + (h - 0.25) * row / rows
            c.box(u, v, u + 0.38 * w, v + (h - 0.25) / rows * 0.8, shade)
            c.box(u + 0.03, v, u + 0.38 * w, v + (h - 0.25) / rows * 0.8 - 0.03, vary(colour, c.rng, 8))
    c.disc(x + 0.9 * w, 1.05, 0.045, (40, 190, 210))
    c.box(x + 0.3 * w, 1.15, x + 0.7 * w, 1.22, (60, 170, 190))
    c.text(x + 0.4 * w, h - 0.22, 0.14, str(c.rng.integers(1, 199)), (230, 230, 230), 0.5 * w)


def shop_sign(c: Canvas, x: float, y: float, w: float, h: float) -> None:
    ground = bright(c.rng)
    ink = contrast(ground)
    c.box(x - 0.03, y - 0.03, x + w + 0.03, y + h + 0.03, (50, 50, 50))
    c.box(x, y, x + w, y + h, ground)
    c.text(x + 0.06 * w, y + 0.36 * h, 0.48 * h, f"{word(c.rng)} {word(c.rng, 2)}", ink, 0.75 * w)
    c.text(x + 0.08 * w, y + 0.1 * h, 0.14 * h, " ".join(word(c.rng, 2) for _ in range(4)), ink, 0.75 * w)
    emblem(c, x + 0.9 * w, y + h / 2, 0.36 * h)


def emblem(c: Canvas, x: float, y: float, radius_m: float) -> None:
    c.disc(x, y, radius_m, bright(c.rng))
    n = int(c.rng.integers(3, 8))
    reach = radius_m * np.where(np.arange(2 * n) % 2, 0.4, 0.9)
    angle = np.arange(2 * n) * math.pi / n + c.rng.uniform(0, 1)
    c.polygon(list(zip(x + reach * np.cos(angle), y + reach * np.sin(angle), strict=True)), bright(c.rng))


def poster(c: Canvas, x: float, y: float, w: float, h: float) -> None:
    ground = bright(c.rng)
    ink = contrast(ground)
    c.box(x - 0.02, y - 0.02, x + w + 0.02, y + h + 0.02, (225, 228, 230))
    c.box(x, y, x + w, y + h, ground)
    for _ in range(int(c.rng.integers(2, 6))):
        u, v = x + w * c.rng.uniform(0.15, 0.85), y + h * c.rng.uniform(0.3, 0.75)
        size = min(w, h) * c.rng.uniform(0.08, 0.25)
        if c.rng.random() < 0.5:
            c.disc(u, v, size, bright(c.rng))
        else:
            angle = np.sort(c.rng.uniform(0, 2 * math.pi, 4))
            c.polygon(list(zip(u + size * np.cos(angle), v + size * np.sin(angle), strict=True)), bright(c.rng))
    c.text(x + 0.08 * w, y + 0.83 * h, 0.1 * h, word(c.rng), ink, 0.84 * w)
    for k in range(4):
        c.text(x + 0.08 * w, y + h * (0.2 - 0.05 * k), 0.03 * h, " ".join(word(c.rng) for _ in range(4)), ink, 0.84 * w)


def notice(c: Canvas, x: float, y: float, w: float, h: float) -> None:
    c.box(x, y, x + w, y + h, vary((232, 236, 238), c.rng, 10))
    rows = max(3, int(h / 0.04))
    for k in range(rows):
        v = y + h * (k + 0.5) / (rows + 0.5)
        ragged = w * c.rng.uniform(0.35, 0.85)
        c.box(x + 0.08 * w, v, x + 0.08 * w + ragged, v + h / rows * 0.4, (70, 70, 70))
    if c.rng.random() < 0.5:
        c.box(x + 0.1 * w, y + 0.72 * h, x + 0.6 * w, y + 0.92 * h, bright(c.rng))
    c.disc(x + w / 2, y + h - 0.02, 0.012, (30, 30, 200))


def picture(c: Canvas, x: float, y: float, w: float, h: float) -> None:
    c.box(x - 0.06, y - 0.06, x + w + 0.06, y + h + 0.06, vary((40, 70, 100), c.rng, 25))

    def paint(p: Canvas) -> None:
        p.fill(vary((200, 170, 120), p.rng, 30))
        for k in range(int(p.rng.integers(2, 5))):
            u = np.linspace(0, w, 9)
            v = h * (0.75 - 0.16 * k) + p.rng.normal(0, 0.06 * h, 9)
            ridge = [(0.0, 0.0), *zip(u, v, strict=True), (w, 0.0)]
            p.polygon([(float(a), float(b)) for a, b in ridge], vary((70, 110, 90), p.rng, 45))
        for _ in range(25):
            across, upward = p.rng.uniform(0, w, 2), p.rng.uniform(0, h, 2)
            x0, y0 = float(across[0]), float(upward[0])
            ends = [(x0, y0), (x0 + float(np.diff(across)[0]) * 0.2, y0 + float(np.diff(upward)[0]) * 0.2)]
            p.line(ends, 0.02, vary(bright(p.rng), p.rng, 20))
        p.add(p.noise((0.04, 0.1, 0.3)), (9, 9, 9))

    c.inset(x, y, x + w, y + h, paint)


def graffiti(c: Canvas, x: float, y: float, w: float, h: float) -> None:
    for _ in range(5):
        u, v = x + w * c.rng.uniform(0.15, 0.85), y + h * c.rng.uniform(0.25, 0.75)
        c.disc(u, v, h * c.rng.uniform(0.15, 0.35), bright(c.rng))
    text, ink = word(c.rng), bright(c.rng)
    c.text(x + 0.02, y + 0.28 * h, 0.55 * h, text, contrast(ink), w)
    c.text(x, y + 0.3 * h, 0.5 * h, text, ink, w)
    for _ in range(4):
        across = x + w * c.rng.uniform(0, 1, 6)
        upward = y + h * c.rng.uniform(0, 1, 6)
        c.line(list(zip(across[:3], upward[:3], strict=True)), 0.03, bright(c.rng))


def books(c: Canvas, x: float, y: float, w: float, h: float) -> None:
    c.box(x, y, x + w, y + h, (30, 32, 36))
    u = x
    while u < x + w - 0.02:
        width = min(c.rng.uniform(0.018, 0.075), x + w - u)
        tall = h * c.rng.uniform(0.62, 0.96)
        colour = vary(bright(c.rng), c.rng, 25)
        if c.rng.random() > 0.06:
            c.box(u, y, u + width * 0.94, y + tall, colour)
            c.box(u, y + tall * 0.7, u + width * 0.94, y + tall * c.rng.uniform(0.74, 0.86), contrast(colour))
            c.box(u, y + tall * 0.12, u + width * 0.94, y + tall * 0.16, vary(colour, c.rng, 60))
        u += width


@material
def bookcase(c: Canvas, colour: Bgr, shelf_m: float = 0.36) -> None:
    c.fill(colour)
    y = 0.08
    while y + shelf_m - 0.04 < c.height_m:
        books(c, 0.03, y, c.width_m - 0.06, shelf_m - 0.04)
        y += shelf_m
    c.add(c.noise((0.05, 0.3)), (4, 4, 4))


def ivy(c: Canvas, x: float, y: float, w: float, h: float) -> None:
    count = round(60.0 * w * h)
    u = x + w * c.rng.uniform(0, 1, count)
    v = y + h * c.rng.beta(1, 2, count)
    for a, b in zip(u, v, strict=True):
        c.disc(float(a), float(b), c.rng.uniform(0.03, 0.08), vary((45, 105, 60), c.rng, 28))


def number_board(c: Canvas, labels: Sequence[str]) -> None:
    c.fill((110, 60, 25))
    n = len(labels)
    for k, label in enumerate(labels):
        y = c.height_m * (n - k - 0.7) / n
        c.text(0.12 * c.width_m, y, 0.45 * c.height_m / n, label, (240, 240, 240), 0.7 * c.width_m)
        x, r = 0.9 * c.width_m, 0.15 * c.height_m / n
        c.polygon([(x - r, y), (x + r, y + r), (x - r, y + 2 * r)], (240, 240, 240))
