"""What a place looks like at another hour, in the evening and in another month: light, sky, leaves, ground, things.

Walls stay. What is moved or new stands off the course, so that the walks are those by day, pose by pose.
"""

import math
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from groundwalk.simulation import materials
from groundwalk.simulation.canvas import Canvas, Material
from groundwalk.simulation.place import Crown, Light, Movable, Place, Quad, Route, SkyLook, Vec
from groundwalk.simulation.walks import MARGIN_M, beside_course
from groundwalk.store.choices import Appearance

MOVED_FRACTION = 0.2  # of the movable things: moved, removed and new ones in turn
_WARM, _LOW_SUN, _DUSK = (0.58, 0.84, 1.0), (0.45, 0.72, 1.0), (1.0, 0.88, 0.78)
_EVENING_SKY = SkyLook((110, 72, 52), (96, 132, 190), (104, 100, 118), 0.3)
_OVERCAST_SKY = SkyLook((206, 204, 200), (226, 225, 223), (216, 215, 214), 0.6)
_LANTERN, _LANTERN_GLOW, _WINDOWS = 1.9, 1.3, 1.9
_NEAR_M, _FAR_M, _GAP_M = 1.5, 8.0, 0.25
_FLOOR_M = 2.0  # things and feet less far apart in height are on one floor
_TRIES = 200


def seen_as(appearance: Appearance, place: Place, route: Route, seed: int) -> Place:
    """The place as it appears then; itself where that's the same. Its obstacles stay those by day: what walkers keep
    off."""
    if appearance == Appearance.SAME:
        return place
    return _PLACES[appearance](place, route, seed)


def _other_hour(place: Place, route: Route, seed: int) -> Place:
    """The sun elsewhere; in rooms every second lamp is off and less comes in from outside."""
    light = place.light
    if light.sun is not None:
        turned = replace(light, sun=_sun(light.sun, 130, 33), sun_bgr=(0.86, 0.95, 1.0))
        return _copy(place, light=turned)
    lamps = light.lamps[::2] if len(light.lamps) > 1 else light.lamps
    return _copy(place, light=replace(light, ambient=0.8 * light.ambient, lamps=lamps, exposure=1.5))


def _evening(place: Place, route: Route, seed: int) -> Place:
    """A low sun and street lamps, lit windows, long exposures; in rooms lamps alone."""
    light = place.light
    if light.sun is None:
        lamps = replace(light, ambient=0.3 * light.ambient, lamp_bgr=_WARM, exposure=5.0)
        return _copy(place, light=lamps)
    low = Light(
        ambient=0.2,
        sun=_sun(light.sun, -110, 8),
        sun_strength=0.3,
        lamps=tuple((at, _LANTERN) for at in place.lanterns.values()),
        ambient_bgr=_DUSK,
        sun_bgr=_LOW_SUN,
        lamp_bgr=_WARM,
        exposure=24.0,
        windows=_WINDOWS,
    )
    quads = [replace(q, glow=_LANTERN_GLOW) if q.name.rpartition(".")[0] in place.lanterns else q for q in place.quads]
    return replace(_copy(place, light=low), quads=quads, sky=_EVENING_SKY)


def _other_month(place: Place, route: Route, seed: int) -> Place:
    """Overcast, leaves turned and thinner, the ground wet and littered, things moved; in rooms no sky and no ground."""
    light = replace(place.light, exposure=2.0)
    changed = _copy(place, light=replace(light, ambient=0.9 * light.ambient))
    if place.light.sun is not None:
        changed = replace(_copy(place, light=replace(light, ambient=0.95, sun=None)), sky=_OVERCAST_SKY)
        changed.quads = [replace(q, paint=_autumn_ground(q.paint)) if _is_ground(q) else q for q in changed.quads]
    changed.crowns = [_autumn(crown) for crown in changed.crowns]
    rng = np.random.default_rng([seed, zlib.crc32(f"{place.name}/other month".encode())])
    _rearrange(changed, route, rng)
    return changed


_PLACES: dict[Appearance, Callable[[Place, Route, int], Place]] = {
    Appearance.OTHER_HOUR: _other_hour,
    Appearance.EVENING: _evening,
    Appearance.OTHER_MONTH: _other_month,
}


def _copy(place: Place, light: Light) -> Place:
    """The place in another light, with lists of its own."""
    return replace(place, light=light, quads=[*place.quads], crowns=[*place.crowns], obstacles=[*place.obstacles])


def _sun(sun: tuple[float, float, float], turn_deg: float, elevation_deg: float) -> tuple[float, float, float]:
    """Where the sun is, turned about the vertical, at an elevation."""
    azimuth, up = math.atan2(sun[2], sun[0]) + math.radians(turn_deg), math.radians(elevation_deg)
    return math.cos(up) * math.cos(azimuth), math.sin(up), math.cos(up) * math.sin(azimuth)


def _is_ground(quad: Quad) -> bool:
    return bool(quad.normal[1] > 0.999 and quad.corner[1] == 0)


def _autumn_ground(paint: Material) -> Material:
    """The same ground, wet and brown in patches, under more leaves."""

    def painted(c: Canvas) -> None:
        paint(c)
        wet = np.clip(0.5 + 0.45 * c.noise((1.2, 4.0, 9.0)), 0, 1)[..., None]
        c.image[:] = c.image * (1 - wet * np.array([0.5, 0.42, 0.34], np.float32))
        materials.litter(c, 4.0)

    return painted


def _autumn(crown: Crown) -> Crown:
    """The crown with turned leaves, fewer of them."""

    def painted(c: Canvas) -> None:
        crown.paint(c)
        grey = c.image.mean(axis=2, keepdims=True)
        c.image[:] = np.clip(grey * np.array([0.45, 0.95, 1.55], np.float32), 0, 255)

    middle = crown.triangles_T33.reshape(-1, 3).mean(axis=0)
    # Another name paints other leaves.
    return Crown(f"{crown.name}.autumn", middle + 0.88 * (crown.triangles_T33 - middle), painted, crown.picture_m)


@dataclass(frozen=True)
class _Thing:
    """What a movable thing is made of, its upright box, and the middle of its foot."""

    quads: list[Quad]
    crowns: list[Crown]
    low: Vec
    high: Vec

    @property
    def foot(self) -> Vec:
        middle: Vec = (self.low + self.high) / 2
        return np.array([middle[0], self.low[1], middle[2]])

    def moved(self, to: Vec, yaw: float, suffix: str = "") -> "_Thing":
        """The thing with its foot at `to`, turned about the vertical by `yaw`, rad; another name paints it anew."""
        c, s = math.cos(yaw), math.sin(yaw)
        turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        foot = self.foot
        quads = [
            replace(
                q,
                name=q.name + suffix,
                corner=turn @ (q.corner - foot) + to,
                right=turn @ q.right,
                up=turn @ q.up,
            )
            for q in self.quads
        ]
        crowns = [
            replace(k, name=k.name + suffix, triangles_T33=(k.triangles_T33 - foot) @ turn.T + to) for k in self.crowns
        ]
        return _thing(quads, crowns)


def _thing(quads: list[Quad], crowns: list[Crown]) -> _Thing:
    corners = [q.corner + i * q.right + j * q.up for q in quads for i in (0, 1) for j in (0, 1)]
    points = np.concatenate([np.array(corners).reshape(-1, 3), *(k.triangles_T33.reshape(-1, 3) for k in crowns)])
    return _Thing(quads, crowns, points.min(axis=0), points.max(axis=0))


def _rearrange(place: Place, route: Route, rng: np.random.Generator) -> None:
    """Move, take away and add things in turn, a MOVED_FRACTION of them in all."""
    count = math.ceil(MOVED_FRACTION * len(place.movables))
    chosen = [place.movables[k] for k in rng.permutation(len(place.movables))[:count]]
    feet = beside_course(route)
    occupied = [(o.low, o.high) for o in place.obstacles]
    removed: list[Movable] = []
    added: list[_Thing] = []
    for number, item in enumerate(chosen):
        thing = _thing(place.quads[item.quads], place.crowns[item.crowns])
        kind = ("moved", "new", "removed")[number % 3]
        if kind != "new":
            removed.append(item)
        spot = None if kind == "removed" else _free_spot(thing, place, feet, occupied, rng)
        if spot is not None:
            new = thing.moved(*spot, suffix=".new" if kind == "new" else "")
            added.append(new)
            occupied.append((new.low, new.high))
    gone = {id(part) for item in removed for part in (*place.quads[item.quads], *place.crowns[item.crowns])}
    place.quads = [q for q in place.quads if id(q) not in gone] + [q for thing in added for q in thing.quads]
    place.crowns = [k for k in place.crowns if id(k) not in gone] + [k for thing in added for k in thing.crowns]


def _free_spot(
    thing: _Thing, place: Place, feet: Vec, occupied: list[tuple[Vec, Vec]], rng: np.random.Generator
) -> tuple[Vec, float] | None:
    """Where the thing can stand on its floor, off the course and clear of everything, and turned how; None where
    nowhere near."""
    for _ in range(_TRIES):
        away, angle, yaw = rng.uniform(_NEAR_M, _FAR_M), rng.uniform(0, 2 * math.pi), rng.uniform(0, 2 * math.pi)
        to = thing.foot + away * np.array([math.cos(angle), 0, math.sin(angle)])
        there = thing.moved(to, yaw)
        low, high = there.low - _GAP_M, there.high + _GAP_M
        inside = (there.low >= place.low)[[0, 2]].all() and (there.high <= place.high)[[0, 2]].all()
        hits = any((low < h).all() and (high > o).all() for o, h in occupied)
        level = feet[np.abs(feet[:, 1] - thing.low[1]) < _FLOOR_M]
        gap = np.maximum(np.maximum(there.low - level, level - there.high), 0)[:, [0, 2]]
        near = len(level) > 0 and float(np.linalg.norm(gap, axis=1).min()) < 2 * MARGIN_M
        if inside and not hits and not near:
            return to, yaw
    return None
