"""Paints and lights every surface of a place, and puts the pictures into one atlas."""

import zlib
from collections.abc import Callable, Iterable

import cv2
import numpy as np

from groundwalk.simulation import atlas
from groundwalk.simulation.canvas import Canvas
from groundwalk.simulation.lighting import brightness, light_on_quad
from groundwalk.simulation.place import Crown, Place, Quad, Vec
from groundwalk.simulation.raycast import Caster
from groundwalk.simulation.textured_mesh import TexturedMesh

Track = Callable[[Iterable[Quad | Crown], str], Iterable[Quad | Crown]]


def build_mesh(place: Place, texel_m: float, seed: int, track: Track = lambda items, _: items) -> TexturedMesh:
    """Paint and light every surface of a place; texel_m is the texel's size before the
    factors of the place and of each surface."""
    texel_m *= place.texel
    quad_points = np.array(
        [[q.corner, q.corner + q.right, q.corner + q.right + q.up, q.corner + q.up] for q in place.quads]
    )
    first = 4 * np.arange(len(place.quads))[:, None]
    quad_triangles = (first[:, None] + np.array([[[0, 1, 2], [0, 2, 3]]])).reshape(-1, 3)
    crown_points = [crown.triangles_T33.reshape(-1, 3) for crown in place.crowns]
    vertices = np.concatenate([quad_points.reshape(-1, 3), *crown_points])
    loose = np.arange(quad_points.size // 3, len(vertices)).reshape(-1, 3)
    triangles = np.concatenate([quad_triangles, loose])
    glass = np.repeat(
        [q.glass for q in place.quads] + [False] * len(place.crowns),
        [2] * len(place.quads) + [len(c.triangles_T33) for c in place.crowns],
    )
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
