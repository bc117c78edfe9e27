"""Properties of rigid transforms, with scipy as the oracle."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from groundwalk.geometry import GeometryError
from groundwalk.geometry.poses import (
    canonical_quaternion,
    interpolate,
    inverse,
    make_pose,
    nearest_rotation,
    pose_from_tq,
    quaternion_angle,
    relative,
    rigidity_error,
    rotation_angle,
    tq_from_pose,
    transform,
)

seeds = st.integers(0, 2**32 - 1)


def random_poses(seed: int, count: int = 5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return make_pose(Rotation.random(count, rng=rng).as_matrix(), rng.normal(scale=10, size=(count, 3)))


@given(seeds)
def test_pose_survives_translation_and_quaternion(seed: int) -> None:
    world_T_cam = random_poses(seed)
    t, q = tq_from_pose(world_T_cam)
    assert np.all(q[:, 3] >= 0)
    assert np.allclose(np.linalg.norm(q, axis=1), 1, atol=1e-12)
    assert np.allclose(pose_from_tq(t, q), world_T_cam, atol=1e-12)
    assert np.allclose(pose_from_tq(t, -q), world_T_cam, atol=1e-12)


@given(seeds)
def test_relative_composes_and_inverts(seed: int) -> None:
    world_T_a, world_T_b = random_poses(seed, 2)
    assert np.allclose(world_T_a @ relative(world_T_a, world_T_b), world_T_b, atol=1e-10)
    assert np.allclose(inverse(world_T_a) @ world_T_a, np.eye(4), atol=1e-10)
    point = np.array([1.0, 2.0, 3.0])
    assert np.allclose(transform(world_T_a, point), (world_T_a @ [1, 2, 3, 1])[:3])


@given(st.floats(1e-9, np.pi), seeds)
def test_rotation_angle_is_exact_for_small_and_large_angles(angle: float, seed: int) -> None:
    axis = np.random.default_rng(seed).normal(size=3)
    rotation = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
    assert rotation_angle(rotation.as_matrix()) == pytest.approx(angle, rel=1e-6, abs=1e-15)
    quaternion = canonical_quaternion(rotation.as_quat())
    assert quaternion_angle(quaternion, [0, 0, 0, 1]) == pytest.approx(angle, abs=1e-7)


@pytest.mark.parametrize("quaternion", [[1.0, 0, 0, 0], [-1.0, 0, 0, 0], [0, -1.0, 0, 0], [0, 0, -0.6, 0.0]])
def test_half_turns_have_one_form(quaternion: list[float]) -> None:
    canonical = canonical_quaternion(quaternion)
    assert np.array_equal(canonical, canonical_quaternion(-np.array(quaternion)))
    assert canonical.max() == 1.0


@pytest.mark.parametrize("bad", [[0.0, 0, 0, 0], [np.nan, 0, 0, 1]])
def test_no_rotation_is_an_error(bad: list[float]) -> None:
    with pytest.raises(GeometryError, match="quaternion"):
        canonical_quaternion(bad)


@given(seeds)
def test_nearest_rotation_undoes_noise_and_never_mirrors(seed: int) -> None:
    rng = np.random.default_rng(seed)
    rotation = Rotation.random(rng=rng).as_matrix()
    assert np.allclose(nearest_rotation(1.7 * rotation), rotation, atol=1e-10)
    assert np.linalg.det(nearest_rotation(rng.normal(size=(3, 3)))) == pytest.approx(1)


def test_rigidity_error_finds_what_is_not_a_pose() -> None:
    good = random_poses(1, 1)[0]
    mirrored, scaled, nan, projective = good.copy(), good.copy(), good.copy(), good.copy()
    mirrored[:3, 0] *= -1
    scaled[:3, :3] *= 1.1
    nan[0, 3] = np.nan
    projective[3, 0] = 0.5
    errors = rigidity_error(np.stack([good, mirrored, scaled, nan, projective]))
    assert errors[0] < 1e-12
    assert np.all(errors[1:] > 0.1)


@given(seeds)
def test_interpolation_agrees_with_slerp_and_hits_its_poses(seed: int) -> None:
    rng = np.random.default_rng(seed)
    t_ns = 10**15 + np.cumsum(rng.integers(10**7, 10**9, size=6))
    poses = random_poses(seed, 6)
    assert np.allclose(interpolate(t_ns, poses, t_ns), poses, atol=1e-9)
    query = rng.integers(t_ns[0], t_ns[-1], size=4)
    expected = Slerp((t_ns - t_ns[0]) * 1e-9, Rotation.from_matrix(poses[:, :3, :3]))((query - t_ns[0]) * 1e-9)
    assert np.allclose(interpolate(t_ns, poses, query)[:, :3, :3], expected.as_matrix(), atol=1e-9)
    with pytest.raises(GeometryError, match="outside"):
        interpolate(t_ns, poses, [t_ns[-1] + 1])
