"""Bar: bars and shops around a block of houses, with terraces, umbrellas and parked vans, 55 by 35 m."""

from groundwalk.simulation import details, materials
from groundwalk.simulation.canvas import Canvas
from groundwalk.simulation.place import Light, Place, Xz
from groundwalk.simulation.scenes import parts
from groundwalk.simulation.scenes.builder import Builder
from groundwalk.simulation.scenes.parts import Facade

EXTENT_M = (55.0, 35.0)
_BLOCK = (11.0, 4.5)  # half sizes of the houses in the middle


def build(seed: int) -> Place:
    """The place; streets run around the block in the middle."""
    b = Builder("Bar", EXTENT_M, 14.0, Light(0.68, (0.3, 0.7, -0.6), 0.5), seed)
    b.floor("ground", (-29.5, -19.5), (29.5, 19.5), 0, _ground)
    _houses(b)
    _terraces(b)
    for k, at in enumerate(((-20.5, -13), (-22.5, 12.6), (21.5, -12.8), (22.4, 12.4), (24.3, 1), (-24.4, -2))):
        b.tree(f"tree{k}", at, b.rng.uniform(5, 6.8))
    b.lamp_posts((-9, 13.9), (6.5, 14.2), (-6, -14), (10, -14), (-24, 6), (24, -6.5), (-13.2, 5.4), (13, -5.6))
    for k, (x, z, yaw) in enumerate(((-14.5, 14.9, 2), (15, -15, -2), (24.6, 7.2, 90))):
        parts.car(b, f"van{k}", (x, z), yaw)
    b.benches((-23.6, -7.5, 90), (23.4, -9.8, -60), (1.5, 14.4, 180))
    parts.bins(b, (-18, 14.8), (18.5, 14.6), (-11.5, -14.4))
    parts.kiosk(b, (-21.5, 4.0), 80)
    return b.place


def _ground(c: Canvas) -> None:
    stones = [(112, 120, 134), (96, 104, 118), (130, 136, 146), (84, 92, 110)]
    materials.masonry(0.12, 0.2, stones, (70, 74, 78), 0.014, 14, 0.2)(c)
    # The picture's (0, 0) is the south-west corner, so plan (x, z) is (x + 29.5, 19.5 - z).
    slabs = materials.masonry(0.6, 0.8, [(160, 166, 170), (146, 152, 158)], (96, 98, 100), 0.018, 12, 0.2)
    for low, high in (((2, 2), (57, 5.2)), ((2, 33.8), (57, 37)), ((16.8, 13.2), (42.2, 25.8))):
        c.area([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])], slabs)
    for x in (6.5, 49.0):
        c.area([(x, 6), (x + 4, 6), (x + 4, 33), (x, 33)], materials.asphalt)
        for k in range(9):
            c.box(x + 1.9, 7 + 3 * k, x + 2.05, 8.4 + 3 * k, (225, 228, 230))
    for k in range(14):
        x, y = c.rng.uniform(3, 56), c.rng.uniform(3, 36)
        c.disc(x, y, 0.34, (58, 60, 62))
        c.disc(x, y, 0.28, (112, 114, 116))
        c.text(x - 0.2, y - 0.05, 0.12, f"{k}{details.word(c.rng, 1)}", (40, 40, 40), 0.4)
    materials.litter(c, 0.6)


def _facades() -> dict[str, Facade]:
    plaster = materials.plaster
    return {
        "pub": Facade(parts.BRICK_DARK, 3, shop=True, frame=(40, 60, 110), posters=3),
        "tapas": Facade(plaster((90, 150, 220)), 2, shop=True, posters=3),
        "cafe": Facade(plaster((204, 196, 150)), 3, shop=True),
        "club": Facade(plaster((120, 70, 96)), 2, graffiti=True, posters=5, frame=(40, 40, 44)),
        "brick": Facade(parts.BRICK_RED, 3, shop=True, posters=2),
        "yellow": Facade(parts.BRICK_YELLOW, 3, posters=3, ivy=True),
        "stone": Facade(parts.SANDSTONE, 2, shop=True, posters=2),
        "wood": Facade(parts.TIMBER, 2, shop=True, window_m=(0.9, 1.2)),
        "flats": Facade(plaster((186, 196, 200), 0.7), 4, same=True, posters=1, pitch_m=2.2),
        "blank": Facade(plaster((150, 168, 176), 0.2), 2, pitch_m=6.0, posters=0),
        "rubble": Facade(parts.RUBBLE, 3, window_m=(0.9, 1.2), posters=3),
        "metal": Facade(materials.panels((150, 140, 120)), 3, frame=(60, 60, 60), graffiti=True, posters=2),
        "rose": Facade(plaster((150, 150, 214)), 3, shop=True, window_m=(0.9, 1.5), pitch_m=2.1),
    }


def _houses(b: Builder) -> None:
    f = _facades()

    def row(name: str, left: Xz, right: Xz, kinds: str, widths: list[float], setback_m: float = 0.6) -> None:
        parts.row_of_houses(b, name, left, right, [f[k] for k in kinds.split()], widths, setback_m)

    kinds = "pub flats tapas yellow metal cafe rubble wood"
    row("north", (-27.5, -17.5), (27.5, -17.5), kinds, [7, 8, 7, 6, 7, 7, 6, 7])
    kinds = "rose stone blank club brick flats tapas yellow"
    row("south", (27.5, 17.5), (-27.5, 17.5), kinds, [7, 7, 5, 8, 7, 8, 6, 7])
    row("east", (27.5, -17.5), (27.5, 17.5), "metal rose pub stone rubble", [7, 7, 7, 7, 7])
    row("west", (-27.5, 17.5), (-27.5, -17.5), "cafe brick wood rubble yellow", [7, 8, 6, 7, 7])
    # The block's fronts look outward, so left and right are as seen from the street.
    w, d = _BLOCK
    row("inner.south", (-w, d), (w, d), "tapas pub cafe", [7, 8, 7], 0.0)
    row("inner.north", (w, -d), (-w, -d), "brick club stone", [7, 8, 7], 0.0)
    row("inner.east", (w, d), (w, -d), "yellow", [9], 0.0)
    row("inner.west", (-w, -d), (-w, d), "rose", [9], 0.0)


def _terraces(b: Builder) -> None:
    places = [(-8.5, 7.1), (-6.3, 7.2), (2.2, 7.0), (5.0, 7.3), (-7.0, -7.1), (0.6, -7.2), (7.6, -7.0)]
    places += [(-23.5, 9.6), (23.8, 4.2), (-14.0, -14.4), (2.5, -14.4)]
    for k, at in enumerate(places):
        _table(b, f"table{k}", at, umbrella=k % 2 == 0)

    def menu(c: Canvas) -> None:
        c.fill((32, 36, 34))
        c.text(0.08, c.height_m - 0.25, 0.16, details.word(c.rng), (200, 230, 240), c.width_m - 0.16)
        for i in range(7):
            line = f"{details.word(c.rng)} {c.rng.integers(2, 19)}"
            c.text(0.08, c.height_m - 0.4 - 0.1 * i, 0.06, line, (235, 235, 235), c.width_m - 0.16)

    for k, (x, z, yaw) in enumerate(((-3.0, 7.0, 10), (8.6, 7.2, -20), (-3.6, -7.0, 190), (4.4, -7.1, 170))):
        b.box(f"menu{k}", (x, z), (0.7, 1.15, 0.12), menu, yaw_deg=yaw)


def _table(b: Builder, name: str, at: Xz, umbrella: bool) -> None:
    turn = float(b.rng.uniform(0, 90))
    wood = materials.wood((70, 100, 140))
    b.box(f"{name}.top", at, (0.8, 0.06, 0.8), wood, bottom=0.72, yaw_deg=turn, faces="fblrtu")
    b.box(f"{name}.leg", at, (0.1, 0.72, 0.1), materials.plain((50, 50, 54)), yaw_deg=turn)
    seat = materials.plain(details.bright(b.rng))
    for k, (dx, dz) in enumerate(((0.75, 0.1), (-0.75, -0.1))):
        x, z = at[0] + dx, at[1] + dz
        b.box(f"{name}.chair{k}", (x, z), (0.42, 0.46, 0.42), seat, yaw_deg=turn)
        b.box(f"{name}.back{k}", (x + dx * 0.25, z), (0.06, 0.5, 0.42), seat, bottom=0.46)
    if umbrella:
        tone = details.bright(b.rng)

        def cloth(c: Canvas) -> None:
            c.fill(tone)
            c.box(0, 0, c.width_m, 0.12, (235, 235, 235))
            c.text(0.1, 0.3 * c.height_m, 0.3, details.word(c.rng), details.contrast(tone), c.width_m - 0.2)
            c.add(c.noise((0.04, 0.2, 0.7)), (9, 9, 9))

        b.box(f"{name}.pole", at, (0.06, 1.6, 0.06), materials.plain((180, 185, 188)), bottom=0.78)
        b.box(f"{name}.umbrella", at, (2.0, 0.32, 2.0), cloth, bottom=2.35, yaw_deg=turn, faces="fblrtu", solid=False)
