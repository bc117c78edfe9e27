"""Light that falls on surfaces: sky and sun, or lamps, with their shadows; worked out once, baked into the pictures."""

import numpy as np
from numpy.typing import NDArray

from groundwalk.simulation.place import Light, Quad, Vec
from groundwalk.simulation.raycast import Caster

SPACING_M = 0.15  # between light samples; pictures are finer
_SKY_RAYS = 24
_SKY_REACH_M = 5.0
_LIFT_M = 0.01


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
