"""Lens, rolling shutter and focus: where features of a known room come out, against OpenCV's and COLMAP's camera."""

from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest

from groundwalk.geometry.poses import interpolate, inverse, transform
from groundwalk.simulation.camera import FOCAL
from groundwalk.simulation.canvas import Canvas
from groundwalk.simulation.mesh import build_mesh
from groundwalk.simulation.place import Light, Route, SceneryPlan
from groundwalk.simulation.render import Renderer, Sky
from groundwalk.simulation.scenes.builder import Builder
from groundwalk.simulation.session import SessionOutline, SimulatedSession, plan_session
from groundwalk.simulation.settings import SimulateSettings
from groundwalk.simulation.view import RadialDistortion

_COEFFICIENTS = [(0.092, -0.125), (0.16, -0.40), (-0.2, 0.05), (0.177, -0.55, 0.53), (0.1, -0.15, -0.15)]
LENSES = [RadialDistortion(*k) for k in _COEFFICIENTS]
WIDTH, HEIGHT = 640, 480
F, CX, CY = FOCAL * WIDTH, 322.5, 230.8
SQUARE_M = 0.25
HALF_M = 3.0


def pixels() -> np.ndarray:
    """Image points (N, 2) all over the picture, corners included."""
    x, y = np.meshgrid(np.linspace(0, WIDTH, 81), np.linspace(0, HEIGHT, 61))
    return np.stack([x.ravel(), y.ravel()], axis=1)


def coefficients(lens: RadialDistortion) -> np.ndarray:
    """OpenCV's k1, k2, p1, p2, k3."""
    return np.array([lens.k1, lens.k2, 0.0, 0.0, lens.k3])


def rays_of(lens: RadialDistortion, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays (N, 2) by the lens's own inverse, and which of them the polynomial describes."""
    x, y = (((points - (CX, CY)) / F).T).astype(np.float32)
    ray_x, ray_y, _ = lens.undistort(x, y)
    rays = np.stack([ray_x, ray_y], axis=1).astype(float)
    return rays, np.linalg.norm(rays, axis=1) < lens.last_radius


@pytest.mark.parametrize("lens", LENSES, ids=str)
def test_rays_come_back_to_their_pixels_in_colmaps_and_opencvs_camera(lens: RadialDistortion) -> None:
    points = pixels()
    rays, described = rays_of(lens, points)
    assert described.mean() > 0.98
    homogeneous = np.column_stack([rays, np.ones(len(rays))])
    colmap = pycolmap.Camera(
        model="FULL_OPENCV", width=WIDTH, height=HEIGHT, params=[F, F, CX, CY, *coefficients(lens), 0.0, 0.0, 0.0]
    )
    matrix = np.array([[F, 0, CX], [0, F, CY], [0, 0, 1]])
    opencv = cv2.projectPoints(homogeneous, np.zeros(3), np.zeros(3), matrix, coefficients(lens))[0]
    assert np.abs(np.asarray(colmap.img_from_cam(homogeneous)) - points)[described].max() < 1e-4
    assert np.abs(opencv[:, 0] - points)[described].max() < 1e-4
    # Beyond the fold the picture goes on without a jump, by the lens's own formula.
    radius = np.linalg.norm(rays, axis=1, keepdims=True)
    again = rays * lens.image_radius(radius) / radius
    assert np.abs(F * again + (CX, CY) - points).max() < 1e-4


def checkers(c: Canvas) -> None:
    c.fill((60, 60, 60))
    columns, rows = round(c.width_m / SQUARE_M), round(c.height_m / SQUARE_M)
    for i, j in product(range(columns), range(rows)):
        if (i + j) % 2:
            x, y = i * SQUARE_M, j * SQUARE_M
            c.box(x, y, x + SQUARE_M, y + SQUARE_M, (200, 200, 200))


@cache
def room() -> tuple[SceneryPlan, Renderer, np.ndarray]:
    """A room of checkered walls with a course through it, its renderer, and the corners of all squares (N, 3)."""
    b = Builder("room", (2 * HALF_M, 2 * HALF_M), 3, Light(ambient=1.0, sun=None), 0)
    h = HALF_M
    ends = [((-h, -h), (h, -h)), ((h, -h), (h, h)), ((h, h), (-h, h)), ((-h, h), (-h, -h))]
    corners = []
    for k, (left, right) in enumerate(ends):
        b.wall(f"wall{k}", left, right, 0, 3, checkers)
        along = (np.array(right) - left) / (2 * h)
        for i, j in product(range(1, round(2 * h / SQUARE_M)), range(1, round(3 / SQUARE_M))):
            x, z = left + along * i * SQUARE_M
            corners.append((x, j * SQUARE_M, z))
    course = Route([(1.5, 1.5, 0), (1.5, -1.5, 0), (-1.5, -1.5, 0), (-1.5, 1.5, 0)], spread_m=0.2, turn_deg_s=60)
    return SceneryPlan(b.place, course), Renderer(build_mesh(b.place, 0.005, 0)), np.array(corners)


def walked(folder: Path, **settings: Any) -> tuple[SimulatedSession, SimulateSettings]:
    """A session through the room with 60 poses and 2 images a second."""
    scenery, renderer, _ = room()
    chosen = SimulateSettings.model_validate({"rate_hz": 60.0, "image_hz": 2.0, "supersampling": 3, **settings})
    plan = SessionOutline("walk", 12, 0.0, 0.1, 1000.0)
    return plan_session(plan, scenery, chosen, True, renderer, folder, 3), chosen


def predicted(session: SimulatedSession, i: int, corners: np.ndarray) -> np.ndarray:
    """Where OpenCV's camera puts the corners (N, 2) in picture i: at each row the pose between the true poses."""
    truth, phone = session.truth, session.truth.phone
    fx, fy, cx, cy = truth.intrinsics_N4[i]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    distortion = coefficients(phone.lens)
    near = slice(max(i - 4, 0), i + 5)
    points = np.full((len(corners), 2), np.nan)
    ahead = np.flatnonzero(transform(inverse(truth.world_T_cam[i]), corners)[:, 2] > 0.3)
    row = np.full(len(ahead), HEIGHT / 2)
    for _ in range(8):
        t_ns = session.t_ns[i] + np.round((row / HEIGHT - 0.5) * phone.readout_s * 1e9).astype(np.int64)
        world_T_row = interpolate(session.t_ns[near], truth.world_T_cam[near], t_ns)
        cam = np.einsum("nji,nj->ni", world_T_row[:, :3, :3], corners[ahead] - world_T_row[:, :3, 3])
        points[ahead] = cv2.projectPoints(cam, np.zeros(3), np.zeros(3), matrix, distortion)[0][:, 0]
        row = np.clip(points[ahead, 1], 0, HEIGHT)
    # Outside the picture the polynomial may fold back into it.
    sight = np.linalg.norm(cam[:, :2] / cam[:, 2:], axis=1)
    points[ahead[sight > min(phone.lens.last_radius, 1.0)]] = np.nan
    return points


def offsets(session: SimulatedSession, settings: SimulateSettings) -> tuple[np.ndarray, np.ndarray]:
    """Predicted corners (N, 2) and found minus predicted ones, pixels, over all sharp pictures of the session."""
    _, renderer, corners = room()
    at, found = [], []
    for k, i in enumerate(session.frames.image_indices):
        if not 5 <= i < len(session.t_ns) - 5:
            continue
        shot = session.shots[k]
        sharp: np.ndarray = renderer.render(shot.view, Sky(0), settings.supersampling).image[..., 1]
        # Single precision and blurred: on sharp edges the corner finder leans towards pixel centres.
        sharp = cv2.GaussianBlur(sharp, (0, 0), 1.0)
        expected = predicted(session, i, corners)
        apart = np.linalg.norm(expected[:, None] - expected[None], axis=-1) + 1e9 * np.eye(len(expected))
        inside = ((expected > 20) & (expected < (WIDTH - 20, HEIGHT - 20))).all(axis=1)
        clear = inside & (np.nan_to_num(apart, nan=1e9).min(axis=1) > 18)
        start = (expected[clear, None] - 0.5).astype(np.float32)
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
        seen = cv2.cornerSubPix(sharp, start.copy(), (5, 5), (-1, -1), stop)
        at.append(expected[clear])
        found.append((seen - start)[:, 0])
    return np.concatenate(at), np.concatenate(found)


CAMERAS: dict[str, dict[str, Any]] = {
    "lens with k3": {"lens": [0.177, -0.55, 0.53]},
    "all": {"lens": [0.092, -0.125, 0], "readout_s": 0.02, "focus_breathing": 0.005, "time_offset_s": 0.006},
}


@pytest.mark.parametrize("name", [pytest.param("lens with k3", marks=pytest.mark.slow), "all"])
def test_corners_are_rendered_where_opencv_predicts_them(name: str, tmp_path: Path) -> None:
    at, off = offsets(*walked(tmp_path, **CAMERAS[name]))
    assert len(off) > 1000
    # Filtered textures let a corner be located to about 0.05 px, a pinhole's too.
    length = np.linalg.norm(off, axis=1)
    assert np.median(length) < 0.06
    assert np.percentile(length, 95) < 0.12
    # What lens and shutter would do wrong is systematic over the picture.
    cell = (at[:, 0] * 4 // WIDTH + 4 * (at[:, 1] * 4 // HEIGHT)).astype(int)
    for k in range(16):
        assert np.abs(off[cell == k].mean(axis=0)).max() < 0.03
