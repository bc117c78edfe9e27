"""Pictures of a place: one ray a pixel and more at edges, textures filtered to the size of each pixel's footprint."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.simulation import atlas
from groundwalk.simulation.atlas import TexturedMesh
from groundwalk.simulation.raycast import NOTHING, Caster
from groundwalk.simulation.view import F32, Rendering, View, turned

_MAX_TAPS = 8
_BLUR_PER_TAP = 1.4  # a tap covers this much of the footprint's length in units of its width
_PANES = 3  # glass layers followed
_GLASS_TINT = np.array([0.90, 0.93, 0.87], np.float32)
_MAP_COLUMNS = 2048
_ZENITH, _HORIZON, _CLOUD = (np.array(bgr, np.float32) for bgr in ((235, 190, 150), (240, 232, 225), (244, 244, 244)))
_DEPTH_EDGE = 0.06


class Sky:
    """A gradient with soft clouds that drift: nothing sharp enough to be taken for a landmark."""

    def __init__(self, seed: int, clock_s: float = 0.0) -> None:
        rng = np.random.default_rng(seed)
        rows, columns = 128, 512
        field = np.zeros((rows, columns), np.float32)
        for size, gain in ((6, 1.0), (12, 0.6), (24, 0.3)):
            grid = rng.standard_normal((size // 2, size), dtype=np.float32)
            wide = cv2.resize(np.hstack([grid, grid, grid]), (3 * columns, rows), interpolation=cv2.INTER_CUBIC)
            field += np.float32(gain) * wide[:, columns : 2 * columns]
        up = np.linspace(1, 0, rows, dtype=np.float32)[:, None, None] ** 0.6
        colour = up * _ZENITH + (1 - up) * _HORIZON
        cloud = np.clip(0.35 + 0.3 * field, 0, 0.8)[..., None]
        self._map = ((1 - cloud) * colour + cloud * _CLOUD).astype(np.float32)
        self._turn = 0.0008 * clock_s

    def colour(self, directions_N3: F32) -> F32:
        """BGR (N, 3) of the sky along world directions of any length."""
        d = directions_N3 / np.linalg.norm(directions_N3, axis=1, keepdims=True)
        rows, columns = self._map.shape[:2]
        x = (np.arctan2(d[:, 2], d[:, 0]) / (2 * np.pi) + self._turn) % 1 * columns
        y = (1 - np.clip(d[:, 1], 0, 1)) * (rows - 1)
        return _lookup(self._map, x.astype(np.float32), y.astype(np.float32), cv2.BORDER_WRAP)


class Renderer:
    def __init__(self, mesh: TexturedMesh) -> None:
        self._mesh = mesh
        self._caster = Caster(mesh.vertices_V3, mesh.triangles_T3)
        self._normals = mesh.normals_T3
        self._points = mesh.vertices_V3[mesh.triangles_T3[:, 0]]
        self._atlas = np.asarray(mesh.atlas_HW3)
        self._offsets = atlas.level_offsets(*mesh.atlas_shape)

    def render(self, view: View, sky: Sky, samples: int = 2) -> Rendering:
        """A picture with `samples` x `samples` rays where surfaces meet, one ray and a filtered texture elsewhere."""
        h, w = view.height, view.width
        look = _Look(view, self._mesh, self._normals, self._points)
        x, y = np.meshgrid(np.arange(w, dtype=np.float32) + 0.5, np.arange(h, dtype=np.float32) + 0.5)
        colour, depth, surface = self._trace(look, x.ravel(), y.ravel(), sky)
        image = colour.reshape(h, w, 3)
        if samples > 1:
            edge = np.flatnonzero(_edges(surface.reshape(h, w), depth.reshape(h, w)))
            steps = ((np.arange(samples) + 0.5) / samples - 0.5).astype(np.float32)
            dx, dy = (d.ravel() for d in np.meshgrid(steps, steps))
            at_x, at_y = x.ravel()[edge, None] + dx, y.ravel()[edge, None] + dy
            fine = self._trace(look, at_x.ravel(), at_y.ravel(), sky)[0]
            image.reshape(-1, 3)[edge] = fine.reshape(len(edge), samples * samples, 3).mean(axis=1)
        return Rendering(image, depth.reshape(h, w))

    def _trace(self, look: "_Look", x: F32, y: F32, sky: Sky) -> tuple[F32, F32, NDArray[np.int64]]:
        """Colour (N, 3), depth (N,) and surface (N,) that the image points (x, y) see."""
        sight = look.sight(x, y)
        rays = look.rays(sight)
        triangle, depth = self._caster.cast(rays)
        surface = self._surfaces(triangle)
        colour = np.zeros((len(x), 3), np.float32)
        panes = np.flatnonzero(self._is_glass(triangle))
        weight = np.ones((len(x), 3), np.float32) if len(panes) else None
        for _ in range(_PANES):
            if not len(panes) or weight is None:
                break
            mirrored, fraction = self._reflection(rays[panes], triangle[panes], depth[panes], look, sky)
            colour[panes] += weight[panes] * fraction[:, None] * mirrored
            weight[panes] *= (1 - fraction)[:, None] * _GLASS_TINT
            onward = rays[panes].copy()
            step = depth[panes] + 1e-3
            onward[:, :3] += onward[:, 3:] * step[:, None]
            behind, further = self._caster.cast(onward)
            triangle[panes], depth[panes] = behind, further + step
            surface[panes] = surface[panes] * 4099 + self._surfaces(behind)
            panes = panes[self._is_glass(behind)]
        seen = triangle != NOTHING
        final = np.empty((len(x), 3), np.float32)
        final[seen] = self._shade(look, sight.hits(depth, np.flatnonzero(seen)), triangle[seen])
        final[~seen] = sky.colour(rays[~seen, 3:])
        return (final if weight is None else colour + weight * final), depth, surface

    def _is_glass(self, triangle: NDArray[np.int64]) -> NDArray[np.bool_]:
        return (triangle != NOTHING) & self._mesh.glass_T[triangle]

    def _surfaces(self, triangle: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.where(triangle == NOTHING, -1, self._mesh.surface_T[triangle]).astype(np.int64)

    def _shade(self, look: "_Look", sight: "_Sight", triangle: NDArray[np.int64]) -> F32:
        """Texture colours, filtered over each pixel's footprint: an ellipse of texels, walked along its length."""
        u, v, long_u, long_v, long, short = look.footprint(sight, triangle)
        taps = np.clip(long / np.maximum(short, 0.7) / _BLUR_PER_TAP, 1, _MAX_TAPS)
        exponent = np.ceil(np.log2(taps) - 0.25).astype(np.int8)
        size = np.maximum(short, long / np.exp2(exponent) / np.float32(_BLUR_PER_TAP))
        level = np.clip(np.log2(np.maximum(size, 1e-6)) + 0.15, 0, atlas.LEVELS - 1.001).astype(np.float32)
        box = self._mesh.box_T4[triangle]
        colour = np.empty((len(triangle), 3), np.float32)
        for e in range(int(np.log2(_MAX_TAPS)) + 1):
            group = np.flatnonzero(exponent == e)
            if not len(group):
                continue
            n = 1 << e
            total = np.zeros((len(group), 3), np.float32)
            for k in range(n):
                along = np.float32((k + 0.5) / n - 0.5)
                at_u = u[group] + along * long_u[group]
                at_v = v[group] + along * long_v[group]
                total += self._texel(box[group], at_u, at_v, level[group])
            colour[group] = total / n
        return colour * self._mesh.tint_T[triangle, None]

    def _texel(self, box_N4: F32, u: F32, v: F32, level: F32) -> F32:
        """Atlas colours at picture texels (u, v), interpolated between texels and between the two nearest levels."""
        u = box_N4[:, 0] + np.clip(u, 0, box_N4[:, 2])
        v = box_N4[:, 1] + np.clip(v, 0, box_N4[:, 3])
        fine = level.astype(np.int32)
        fraction = (level - fine)[:, None]
        return (1 - fraction) * self._level(u, v, fine) + fraction * self._level(u, v, fine + 1)

    def _level(self, u: F32, v: F32, level: NDArray[np.int32]) -> F32:
        scale = np.exp2(-level).astype(np.float32)
        offset = self._offsets[level]
        half = np.float32(0.5)
        return _lookup(self._atlas, u * scale + offset[:, 0] - half, v * scale + offset[:, 1] - half)

    def _reflection(
        self, rays_N6: F32, pane: NDArray[np.int64], distance: F32, look: "_Look", sky: Sky
    ) -> tuple[F32, F32]:
        """What panes mirror (N, 3), and the mirrored fraction (N,) by Schlick's formula for two surfaces of glass."""
        normal = self._normals[pane].astype(np.float32)
        direction = rays_N6[:, 3:]
        length = np.linalg.norm(direction, axis=1)
        cosine = np.einsum("ij,ij->i", direction, normal) / length
        fraction = 0.08 + 0.92 * (1 - np.abs(cosine)) ** 5
        out = np.empty_like(rays_N6)
        out[:, 3:] = direction - 2 * (cosine * length)[:, None] * normal
        out[:, :3] = rays_N6[:, :3] + distance[:, None] * direction + 1e-3 * out[:, 3:]
        triangle, further = self._caster.cast(out)
        seen = (triangle != NOTHING) & ~self._is_glass(triangle)
        triangle, colour = triangle[seen], sky.colour(out[:, 3:])
        point = out[seen, :3] + further[seen, None] * out[seen, 3:]
        a = self._mesh.texel_a_T23[triangle].astype(np.float32)
        texel = np.einsum("nij,nj->ni", a, point) + self._mesh.texel_b_T2[triangle].astype(np.float32)
        across = (distance + further)[seen] / np.float32(look.focal) * 1.5
        size = across * np.linalg.norm(a[:, 0], axis=1)
        level = np.clip(np.log2(np.maximum(size, 1e-6)), 0, atlas.LEVELS - 1.001).astype(np.float32)
        tint = self._mesh.tint_T[triangle, None]
        colour[seen] = tint * self._texel(self._mesh.box_T4[triangle], texel[:, 0], texel[:, 1], level)
        return colour, fraction.astype(np.float32)


@dataclass(frozen=True)
class _Sight:
    """Rays (x, y, 1) of N image points in the camera of their row, the derivative xx, xy, yy of (x, y) by the distorted
    point, and with a shutter the same rays in the camera of the middle row: direction and start, three arrays each."""

    x: F32
    y: F32
    derivative: tuple[F32, ...] = ()
    direction: tuple[F32, ...] = ()
    start: tuple[F32, ...] = ()

    def hits(self, depth: F32, which: NDArray[np.intp]) -> "_Sight":
        """The camera of the middle row looking at what was met at `depth` (N,), at the points `which` of them."""
        x, y = self.x, self.y
        if self.direction:
            near = np.float32(1) / depth
            x, y, z = (d + s * near for d, s in zip(self.direction, self.start, strict=True))
            x, y = x / z, y / z
        return _Sight(x[which], y[which], tuple(v[which] for v in self.derivative))


class _Look:
    """One view's rays, and its map from image points to texels: on each triangle's plane, a homography."""

    def __init__(self, view: View, mesh: TexturedMesh, normals_T3: Array, points_T3: Array) -> None:
        self._view = view
        self.focal = view.fx
        self._origin, self._rotation = view.world_T_cam[:3, 3], view.world_T_cam[:3, :3]
        normal = normals_T3 @ self._rotation
        distance = np.einsum("ij,ij->i", normals_T3, points_T3 - self._origin)
        # On the plane n.p = d the ray (x, y, 1) ends at d / n.(x, y, 1), where the picture's texel is a.p + b.
        a = mesh.texel_a_T23 @ self._rotation
        b = mesh.texel_b_T2 + mesh.texel_a_T23 @ self._origin
        above = a * distance[:, None, None] + b[..., None] * normal[:, None, :]
        self._homography_T9 = np.hstack([above.reshape(-1, 6), normal]).astype(np.float32)

    def sight(self, x: F32, y: F32) -> _Sight:
        """What the image points (x, y) look along."""
        v = self._view
        at_x, at_y = v.points(x, y)
        derivative: tuple[F32, ...] = ()
        if not v.lens.is_pinhole:
            at_x, at_y, derivative = v.lens.undistort(at_x, at_y)
        if v.shutter is None:
            return _Sight(at_x, at_y, derivative)
        turn, shift = v.shutter.motion(y / np.float32(v.height) - np.float32(0.5))
        return _Sight(at_x, at_y, derivative, turned(turn, at_x, at_y), tuple(shift))

    def rays(self, sight: _Sight) -> F32:
        """World rays (N, 6) whose direction has depth 1, so that distances are depths."""
        rays = np.empty((len(sight.x), 6), np.float32)
        rays[:, :3] = self._origin
        x, y, z = sight.direction or (sight.x, sight.y, np.float32(1))
        for k, r in enumerate(self._rotation.astype(np.float32)):
            rays[:, 3 + k] = r[0] * x + r[1] * y + r[2] * z
            if sight.start:
                rays[:, k] += r[0] * sight.start[0] + r[1] * sight.start[1] + r[2] * sight.start[2]
        return rays

    def footprint(self, sight: _Sight, triangle: NDArray[np.int64]) -> tuple[F32, F32, F32, F32, F32, F32]:
        """Texel (u, v) under each point, its pixel's footprint there as long axis (u, v), and both axes' lengths."""
        x, y = sight.x, sight.y
        h = np.ascontiguousarray(self._homography_T9[triangle].T)
        inverse = 1 / (h[6] * x + h[7] * y + h[8])
        u = (h[0] * x + h[1] * y + h[2]) * inverse
        v = (h[3] * x + h[4] * y + h[5]) * inverse
        step_x, step_y = inverse / np.float32(self._view.fx), inverse / np.float32(self._view.fy)
        ux, vx = (h[0] - u * h[6]) * step_x, (h[3] - v * h[6]) * step_x
        uy, vy = (h[1] - u * h[7]) * step_y, (h[4] - v * h[7]) * step_y
        if sight.derivative:
            xx, xy, yy = sight.derivative
            aspect = np.float32(self._view.fy / self._view.fx)
            ux, uy = ux * xx + uy * xy * aspect, ux * xy / aspect + uy * yy
            vx, vy = vx * xx + vy * xy * aspect, vx * xy / aspect + vy * yy
        # Singular values of the 2x2 Jacobian, and where the longer one points.
        xx, yy, xy = ux * ux + vx * vx, uy * uy + vy * vy, ux * uy + vx * vy
        gap = np.sqrt((xx - yy) ** 2 / 4 + xy * xy)
        long = np.sqrt((xx + yy) / 2 + gap)
        short = np.abs(ux * vy - uy * vx) / np.maximum(long, 1e-9)
        angle = np.arctan2(2 * xy, xx - yy) / 2
        c, s = np.cos(angle), np.sin(angle)
        return u, v, ux * c + uy * s, vx * c + vy * s, long, short


def _edges(surface: NDArray[np.int64], depth: F32) -> NDArray[np.bool_]:
    """Pixels beside a neighbour on another surface, or across a jump in depth."""
    edge = np.zeros(surface.shape, bool)
    near = np.where(np.isfinite(depth), depth, 1e4)
    for f, s in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        apart = (surface[f] != surface[s]) | (np.abs(near[f] - near[s]) > _DEPTH_EDGE * np.minimum(near[f], near[s]))
        edge[f] |= apart
        edge[s] |= apart
    return edge


def _lookup(image: NDArray, x: F32, y: F32, border: int = cv2.BORDER_REPLICATE) -> F32:
    """Bilinear samples (N, 3) of an image at points whose pixel centres are whole numbers."""
    if not len(x):
        return np.empty((0, 3), np.float32)
    # In rows, as cv2 limits the sides of a map and is slow on narrow ones.
    columns = min(_MAP_COLUMNS, len(x))
    spare = -len(x) % columns
    x, y = (np.pad(v, (0, spare)).reshape(-1, columns) for v in (x, y))
    sampled = np.asarray(cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=border), np.float32)
    return sampled.reshape(-1, 3)[: x.size - spare]
