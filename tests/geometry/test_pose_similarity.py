"""The robust similarity of poses: exact without noise, in any gauge, on a line, and with outliers."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.pose_similarity import fit_similar_poses
from groundwalk.geometry.poses import make_pose

GAUGE = Sim3(2.7, Rotation.from_euler("xyz", [0.4, -1.1, 2.0]).as_matrix(), np.array([3.0, -70.0, 1.0]))


def poses(count: int, seed: int = 0, on_a_line: bool = False) -> np.ndarray:
    rng = np.random.default_rng(seed)
    xyz = rng.normal(0, 5, (count, 3)) * ([1, 0, 0] if on_a_line else [1, 1, 1])
    return make_pose(Rotation.random(count, rng=rng).as_matrix(), xyz)


@pytest.mark.parametrize("on_a_line", [False, True])
@pytest.mark.parametrize("outliers", [0, 12])
def test_the_gauge_is_found(on_a_line: bool, outliers: int) -> None:
    b = poses(40, on_a_line=on_a_line)
    a = GAUGE.poses(b)
    a[:outliers, :3, 3] += np.random.default_rng(1).normal(0, 30, (outliers, 3))
    found = fit_similar_poses(a, b)
    assert found.a_S_b.scale == pytest.approx(GAUGE.scale, rel=1e-3 if outliers else 1e-9)
    turn = Rotation.from_matrix(found.a_S_b.rotation @ GAUGE.rotation.T).magnitude()
    assert turn < (2e-3 if outliers else 1e-7)
    assert found.position[outliers:].max() < (0.05 if outliers else 1e-6)
    assert found.position[:outliers].min(initial=9.0) > 1.0


@pytest.mark.parametrize(("height", "turned"), [(1.0, 0.01), (0.05, 0.003)])
def test_sigmas_say_how_far_the_fit_is_off(height: float, turned: float) -> None:
    """Of poses all around, and on one floor with rotations that are better than positions."""
    scales, turns, stated = [], [], []
    rng = np.random.default_rng(99)
    for seed in range(60):
        b = poses(50, seed)
        b[:, 1, 3] *= height
        a = GAUGE.poses(b)
        a[:, :3, 3] += rng.normal(0, 0.2, (50, 3))
        a[:, :3, :3] = Rotation.from_rotvec(rng.normal(0, turned, (50, 3))).as_matrix() @ a[:, :3, :3]
        found = fit_similar_poses(a, b)
        scales.append(found.a_S_b.scale / GAUGE.scale - 1)
        turns.append(Rotation.from_matrix(found.a_S_b.rotation @ GAUGE.rotation.T).as_rotvec())
        stated.append((found.scale_sd, found.turn_sd))
    scale_sd, turn_sd = np.mean(stated, axis=0)
    assert scale_sd == pytest.approx(np.std(scales), rel=0.35)
    assert turn_sd == pytest.approx(np.sqrt(np.mean(np.square(turns))), rel=0.35)


def test_what_determines_nothing_is_refused() -> None:
    with pytest.raises(GeometryError, match="too few"):
        fit_similar_poses(poses(2), poses(2))
    still = poses(9)
    still[:, :3, 3] = [1.0, 2.0, 3.0]
    with pytest.raises(GeometryError, match="one place"):
        fit_similar_poses(still, poses(9))
