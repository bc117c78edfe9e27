"""Rendering: where things land in the picture, how textures are filtered, what panes do."""

import numpy as np
import pytest

from groundwalk.geometry.poses import inverse, make_pose, transform
from groundwalk.simulation.canvas import Canvas, Material
from groundwalk.simulation.mesh import build_mesh
from groundwalk.simulation.place import Light
from groundwalk.simulation.render import Renderer, Sky
from groundwalk.simulation.scenes.builder import Builder
from groundwalk.simulation.view import View

FLAT = Light(ambient=1.0, sun=None)
SPOTS = [(0.6, 0.5), (1.1, 1.9), (2.0, 1.2), (2.9, 0.4), (3.4, 2.2), (1.7, 2.6)]


def dots(c: Canvas) -> None:
    c.fill((30, 30, 30))
    for x, y in SPOTS:
        c.disc(x, y, 0.03, (240, 240, 240))


def fine_noise(c: Canvas) -> None:
    c.fill((128, 128, 128))
    c.add(c.noise((0.02, 0.05, 0.2)), (40, 40, 40))


def room(paint: Material, glass: bool = False) -> Builder:
    """A wall of 4 x 3 m in the plane z = -2, seen from +z; with a pane at z = -1."""
    b = Builder("room", (10, 10), 3, FLAT, 0)
    b.wall("wall", (-2, -2), (2, -2), 0, 3, paint)
    if glass:
        b.quad("pane", (-2, 0, -1), (4, 0, 0), (0, 3, 0), fine_noise, glass=True)
    return b


def looking(position: tuple[float, float, float], target: tuple[float, float, float], size: int = 320) -> View:
    """A camera at `position` that looks at `target`, upright."""
    forward = np.subtract(target, position) / np.linalg.norm(np.subtract(target, position))
    right = np.cross(forward, [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    pose = make_pose(np.stack([right, np.cross(forward, right), forward], axis=1), position)
    focal = 0.75 * size
    return View(pose, focal, focal * 1.01, size / 2 + 2.3, size * 0.375 - 1.7, size, size * 3 // 4)


@pytest.mark.parametrize("position", [(0.0, 1.5, 2.0), (2.5, 1.2, 1.2), (-3.0, 2.5, 0.3)])
def test_painted_points_land_where_the_pinhole_camera_puts_them(position: tuple[float, float, float]) -> None:
    mesh = build_mesh(room(dots).place, 0.005, 0)
    view = looking(position, (0.0, 1.5, -2.0), 960)
    image = Renderer(mesh).render(view, Sky(0)).image[..., 1]
    points = np.array([(x - 2, y, -2.0) for x, y in SPOTS])
    cam = transform(inverse(view.world_T_cam), points)
    expected = np.stack([view.fx * cam[:, 0] / cam[:, 2] + view.cx, view.fy * cam[:, 1] / cam[:, 2] + view.cy], axis=1)
    reach = 9
    checked = 0
    for u, v in expected:
        column, row = int(u), int(v)
        if not (reach < column < view.width - reach and reach < row < view.height - reach):
            continue
        part = np.clip(image[row - reach : row + reach, column - reach : column + reach] - 35, 0, None)
        y, x = np.mgrid[row - reach : row + reach, column - reach : column + reach] + 0.5
        found = np.array([(x * part).sum(), (y * part).sum()]) / part.sum()
        # A disc's picture is an ellipse whose centre is off the centre's picture by up to 0.07 here.
        assert np.linalg.norm(found - (u, v)) < 0.12
        checked += 1
    assert checked >= 3


@pytest.mark.parametrize("away", [3.0, 20.0, 60.0])
def test_fine_texture_neither_aliases_nor_shimmers(away: float) -> None:
    """A step of a twentieth of a pixel changes the picture no more than interpolating between its pixels would."""
    renderer = Renderer(build_mesh(room(fine_noise).place, 0.01, 0))
    views = [looking((dx, 1.5, away), (dx, 1.5, -2.0)) for dx in (0.0, 0.05 * (away + 2) / 240, 1.0 * (away + 2) / 240)]
    still, moved, whole = (renderer.render(v, Sky(0)).image[..., 1] for v in views)
    half = max(4, int(240 * 1.2 / (away + 2)))
    window = np.s_[118 - half : 118 + half, 162 - half : 162 + half]
    slope = np.abs(np.diff(still, axis=1))[window].mean()
    assert np.abs(moved - still)[window].mean() < 0.05 * slope * 1.6 + 0.05
    # Moved by a whole pixel, the picture is the same picture one pixel further.
    shifted = np.roll(whole, 1, axis=1)
    assert np.abs(shifted - still)[window].mean() < 0.15 * slope + 0.3


def test_a_pane_dims_what_is_behind_and_adds_what_it_mirrors() -> None:
    view = looking((0.0, 1.5, 2.0), (0.0, 1.5, -2.0))
    clear = Renderer(build_mesh(room(dots).place, 0.01, 0)).render(view, Sky(0))
    glazed = Renderer(build_mesh(room(dots, glass=True).place, 0.01, 0)).render(view, Sky(0))
    bright = clear.image[..., 1] > 200
    assert bright.any()
    assert np.allclose(glazed.depth[bright], clear.depth[bright], atol=1e-3)
    assert np.all(glazed.image[..., 1][bright] < clear.image[..., 1][bright] + 5)
    dark = clear.image[60:180, 100:220, 1] < 40
    assert glazed.image[60:180, 100:220, 1][dark].mean() > clear.image[60:180, 100:220, 1][dark].mean() + 5
