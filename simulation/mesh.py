"""Paints and lights every surface of a place, and puts the pictures into one atlas."""

import zlib
from collections.abc import Callable, Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.simulation import atlas
from groundwalk.simulation.atlas import TexturedMesh
from groundwalk.simulation.canvas import Canvas
from groundwalk.simulation.place import Crown, Light, Place, Quad, Vec
from groundwalk.simulation.raycast import Caster

Track = Callable[[Iterable[Quad | Crown], str], Iterable[Quad | Crown]]
SPACING_M = 0.15  # between light samples; pictures are finer
_SKY_RAYS = 24
_SKY_REACH_M = 5.0
_LIFT_M = 0.01


def build_mesh(place: Place, texel_m: float, seed: int, track: Track = lambda items, _: items) -> TexturedMesh:
    """Paint and light every surface of a place; texel_m is the texel's size before the
    factors of the place and of each surface."""
    texel_m *= place.texel
    corners = [(q.corner, q.corner + q.right, q.corner + q.right + q.up, q.corner + q.up) for q in place.quads]
    quad_points = np.array(corners)
    first = 4 * np.arange(len(place.quads))[:, None]
    quad_triangles = (first[:, None] + np.array([[[0, 1, 2], [0, 2, 3]]])).reshape(-1, 3)
    crown_points = [crown.triangles_T33.reshape(-1, 3) for crown in place.crowns]
    vertices = np.concatenate([quad_points.reshape(-1, 3), *crown_points])
    loose = np.arange(quad_points.size // 3, len(vertices)).reshape(-1, 3)
    triangles = np.concatenate([quad_triangles, loose])
    glass = np.concatenate([np.repeat([q.glass for q in place.quads], 2), np.zeros(len(loose), bool)])
    # Panes let the light through, so they cast no shadow.
    caster = Caster(vertices, triangles[~glass])

    quads: list[Quad | Crown] = [*place.quads]
    things = [*quads, *place.crowns]
    sizes = [_canvas(thing, texel_m, np.random.default_rng(0)).shape for thing in things]
    origins, (height, width) = atlas.pack(sizes)
    pixels = np.zeros((height, width * 3 // 2, 3), np.uint8)
    a, b, box, tint, surface = [], [], [], [], []
    for i, thing in enumerate(track(things, "painting surfaces")):
        rng = np.random.default_rng([seed, zlib.crc32(place.name.encode()), zlib.crc32(thing.name.encode())])
        canvas = _canvas(thing, texel_m, rng)
        thing.paint(canvas)
        picture, (h, w) = canvas.image, canvas.shape
        if isinstance(thing, Quad):
            if not thing.glass:
                # Display values go with about the square root of light.
                root = np.sqrt(light_on_quad(thing, place.light, caster))
                gain = cv2.resize(root, (w, h), interpolation=cv2.INTER_LINEAR)
                picture = np.clip(picture * gain[..., None], 0, 255).astype(np.uint8)
            maps, count = _quad_map(thing, w, h), 2
            shade = np.ones(2)
        else:
            count = len(thing.triangles_T33)
            maps = _crown_map(thing, texel_m, w, rng)
            shade = _crown_shade(thing, place, caster)
        atlas.put(pixels, origins[i], picture)
        a.append(np.broadcast_to(maps[0], (count, 2, 3)))
        b.append(np.broadcast_to(maps[1], (count, 2)))
        box.append(np.tile([*origins[i], w, h], (count, 1)))
        tint.append(shade)
        surface.append(np.full(count, i))
    atlas.fill_levels(pixels, height, width)
    return TexturedMesh(
        vertices_V3=vertices,
        triangles_T3=triangles,
        texel_a_T23=np.concatenate(a),
        texel_b_T2=np.concatenate(b),
        box_T4=np.concatenate(box).astype(np.float32),
        tint_T=np.concatenate(tint).astype(np.float32),
        surface_T=np.concatenate(surface).astype(np.int32),
        glass_T=glass,
        atlas_shape=np.array([height, width]),
        atlas_HW3=pixels,
    )


def _canvas(thing: Quad | Crown, texel_m: float, rng: np.random.Generator) -> Canvas:
    """What a thing's picture is painted on."""
    if isinstance(thing, Crown):
        return Canvas(thing.picture_m, thing.picture_m, texel_m, rng)
    return Canvas(thing.width_m, thing.height_m, texel_m * thing.texel, rng)


def _quad_map(quad: Quad, width: int, height: int) -> tuple[Vec, Vec]:
    along = quad.right / (quad.right @ quad.right) * width
    down = -quad.up / (quad.up @ quad.up) * height
    a = np.stack([along, down])
    return a, np.array([0.0, float(height)]) - a @ quad.corner


def _crown_map(crown: Crown, texel_m: float, size: int, rng: np.random.Generator) -> tuple[Vec, Vec]:
    """Each facet gets its own piece of the leaves."""
    p = crown.triangles_T33
    first = p[:, 1] - p[:, 0]
    normal = np.cross(first, p[:, 2] - p[:, 0])
    x = first / np.linalg.norm(first, axis=1, keepdims=True)
    y = np.cross(normal, x)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    a = np.stack([x, y], axis=1) / texel_m
    reach = np.einsum("tij,tkj->tki", a, p - p[:, :1])
    low, high = reach.min(axis=1), reach.max(axis=1)
    start = rng.uniform(0, 1, low.shape) * np.maximum(size - (high - low), 0) - low
    return a, start - np.einsum("tij,tj->ti", a, p[:, 0])


def _crown_shade(crown: Crown, place: Place, caster: Caster) -> Vec:
    """Tints (T,)."""
    p = crown.triangles_T33
    normal = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.sqrt(brightness(p.mean(axis=1), normal, place.light, caster))


def light_on_quad(quad: Quad, light: Light, caster: Caster) -> NDArray[np.float32]:
    """Brightness (rows, columns) of a quad's picture, top row first, one sample each SPACING_M or less."""
    rows = max(2, round(quad.height_m / SPACING_M))
    columns = max(2, round(quad.width_m / SPACING_M))
    t = 1 - (np.arange(rows) + 0.5) / rows
    s = (np.arange(columns) + 0.5) / columns
    points = quad.corner + s[None, :, None] * quad.right + t[:, None, None] * quad.up
    normals = np.broadcast_to(quad.normal, (rows * columns, 3))
    return brightness(points.reshape(-1, 3), normals, light, caster).reshape(rows, columns)


def brightness(points_N3: Vec, normals_N3: Vec, light: Light, caster: Caster) -> NDArray[np.float32]:
    """How bright a white surface looks (N,), 1 meaning 'as painted'."""
    start = points_N3 + _LIFT_M * normals_N3
    total = light.ambient * (0.35 + 0.65 * _open_sky(start, normals_N3, caster))
    if light.sun is not None:
        towards = np.array(light.sun) / np.linalg.norm(light.sun)
        facing = np.maximum(normals_N3 @ towards, 0)
        dark = caster.blocked(_rays(start, np.broadcast_to(towards, start.shape)), np.inf)
        total += light.sun_strength * facing * ~dark
    for position, strength in light.lamps:
        way = np.array(position) - start
        distance = np.linalg.norm(way, axis=1)
        facing = np.maximum(np.einsum("ij,ij->i", normals_N3, way) / distance, 0)
        dark = caster.blocked(_rays(start, way), 0.98)
        total += strength * (0.25 + 0.75 * facing) * ~dark / np.maximum(distance, 0.7)
    return total.astype(np.float32)


def _open_sky(start_N3: Vec, normals_N3: Vec, caster: Caster) -> Vec:
    """Share (N,) of the hemisphere over each point without anything near in it (ambient occlusion)."""
    rng = np.random.default_rng(0)
    u, v = (np.arange(_SKY_RAYS) + 0.5) / _SKY_RAYS, (np.arange(_SKY_RAYS) * 0.618034) % 1
    radius, angle = np.sqrt(u), 2 * np.pi * v
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1 - u)], axis=1)
    helper = np.where(np.abs(normals_N3[:, 1:2]) < 0.9, [[0.0, 1.0, 0.0]], [[1.0, 0.0, 0.0]])
    side = np.cross(helper, normals_N3)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(normals_N3, side)
    free = np.zeros(len(start_N3))
    for x, y, z in local:
        # A turn of its own at each point trades bands for faint noise.
        turn = rng.uniform(0, 2 * np.pi, (len(start_N3), 1))
        a, b = x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)
        direction = a * side + b * other + z * normals_N3
        free += ~caster.blocked(_rays(start_N3, direction), _SKY_REACH_M)
    return free / _SKY_RAYS


def _rays(start_N3: Vec, direction_N3: Vec) -> NDArray[np.float32]:
    return np.hstack([start_N3, direction_N3]).astype(np.float32)
