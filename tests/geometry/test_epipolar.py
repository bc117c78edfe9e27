"""Sampson's distance against its formula, written out."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from groundwalk.geometry.epipolar import sampson_px
from groundwalk.geometry.poses import Array, inverse, make_pose, transform

_MATCHES = 40


def _scene(rng: np.random.Generator) -> tuple[Array, Array, Array, Array, Array]:
    """A relative pose for each match, rays of the same points in both cameras, and focal lengths of two axes."""
    a_T_b = make_pose(Rotation.from_rotvec(rng.uniform(-0.3, 0.3, 3)).as_matrix(), rng.uniform(-1, 1, 3))
    points_a = rng.uniform([-1, -1, 3], [1, 1, 8], (_MATCHES, 3))
    points_b = transform(inverse(a_T_b), points_a)
    focal_a, focal_b = rng.uniform(300, 900, (2, _MATCHES, 2))
    rays = points_a / points_a[:, 2:], points_b / points_b[:, 2:]
    return np.tile(a_T_b, (_MATCHES, 1, 1)), *rays, focal_a, focal_b


@settings(max_examples=25)
@given(seed=st.integers(0, 10_000))
def test_it_is_the_formula_in_pixels(seed: int) -> None:
    """Hartley and Zisserman's eq. 11.9 with the fundamental matrix of two cameras with their corner at (0, 0)."""
    rng = np.random.default_rng(seed)
    a_T_b, ray_a, ray_b, focal_a, focal_b = _scene(rng)
    ray_b[:, :2] += rng.normal(0, 0.01, (_MATCHES, 2))
    found = sampson_px(a_T_b, ray_a, ray_b, focal_a, focal_b)
    for m in range(_MATCHES):
        k_a, k_b = np.diag([*focal_a[m], 1.0]), np.diag([*focal_b[m], 1.0])
        x, y, z = a_T_b[m, :3, 3]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        f = np.linalg.inv(k_a).T @ cross @ a_T_b[m, :3, :3] @ np.linalg.inv(k_b)
        p_a, p_b = k_a @ ray_a[m], k_b @ ray_b[m]
        u, v = f @ p_b, f.T @ p_a
        expected = abs(p_a @ f @ p_b) / np.sqrt(u[0] ** 2 + u[1] ** 2 + v[0] ** 2 + v[1] ** 2)
        assert found[m] == pytest.approx(expected)


def test_a_pose_without_translation_has_no_constraint() -> None:
    ray = np.array([[0.1, 0.2, 1.0]])
    focal = np.full((1, 2), 500.0)
    assert np.isnan(sampson_px(np.eye(4)[None], ray, ray, focal, focal)).all()
