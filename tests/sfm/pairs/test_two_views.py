"""The pose near a given one that explains a pair's matches."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array, make_pose, rotation_angle
from groundwalk.sfm.pairs.two_views import fitted_near

_FOCAL_PX = 500.0


def _pair(rng: np.random.Generator, depth: Array) -> tuple[Array, Array, Array]:
    """A relative pose with a translation of length 1, and the rays of 80 points with a little noise."""
    a_T_b = make_pose(Rotation.from_rotvec(rng.uniform(-0.2, 0.2, 3)).as_matrix(), [1.0, *rng.uniform(-0.3, 0.3, 2)])
    a_T_b[:3, 3] /= np.linalg.norm(a_T_b[:3, 3])
    points = np.concatenate([rng.uniform(-2, 2, (80, 2)), depth[:, None]], axis=1)
    in_b = (points - a_T_b[:3, 3]) @ a_T_b[:3, :3]
    noise = rng.normal(0, 0.3 / _FOCAL_PX, (2, 80, 2))
    return a_T_b, points[:, :2] / points[:, 2:] + noise[0], in_b[:, :2] / in_b[:, 2:] + noise[1]


def _drifted(a_T_b: Array, degrees: float, rng: np.random.Generator) -> Array:
    about = rng.normal(size=3)
    turn = Rotation.from_rotvec(np.radians(degrees) * about / np.linalg.norm(about)).as_matrix()
    return make_pose(a_T_b[:3, :3] @ turn, a_T_b[:3, 3])


@settings(max_examples=15)
@given(seed=st.integers(0, 1000), flat=st.booleans())
def test_from_a_drifted_start_the_true_pose_is_found_on_a_plane_too(seed: int, flat: bool) -> None:
    rng = np.random.default_rng(seed)
    a_T_b, ray_a, ray_b = _pair(rng, np.full(80, 4.0) if flat else rng.uniform(3, 7, 80))
    found, error_px = fitted_near(_drifted(a_T_b, 2.0, rng), ray_a, ray_b, _FOCAL_PX, _FOCAL_PX)
    assert np.mean(error_px < 4) > 0.95
    assert np.degrees(rotation_angle(found[:3, :3].T @ a_T_b[:3, :3])) < 1.5


def test_matches_of_another_pose_are_not_explained() -> None:
    rng = np.random.default_rng(0)
    a_T_b, ray_a, ray_b = _pair(rng, rng.uniform(3, 7, 80))
    _, error_px = fitted_near(a_T_b, ray_a, rng.permutation(ray_b), _FOCAL_PX, _FOCAL_PX)
    assert np.mean(error_px < 4) < 0.5
