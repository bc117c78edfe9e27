"""Covariances against Monte Carlo, and quality classes."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from groundwalk.alignment.quality import FrameEvidence, count_grades, grade
from groundwalk.alignment.uncertainty import SharedSd, covariance_in_map, largest_sd, shared_covariance
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import make_pose


def errors(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """(rotation, position) of estimated poses (N, 4, 4) against a true one, (N, 6)."""
    rotation = Rotation.from_matrix(estimated[:, :3, :3] @ true[:3, :3].T).as_rotvec()
    return np.hstack([rotation, estimated[:, :3, 3] - true[:3, 3]])


def test_covariance_of_a_map_pose_is_that_of_samples() -> None:
    rng = np.random.default_rng(0)
    mix = rng.normal(size=(6, 6))
    scales = np.diag([2e-3] * 3 + [1e-2] * 3)
    covariance_sfm = scales @ mix @ mix.T @ scales
    sfm_T_cam = make_pose(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 5, 3))
    map_S_sfm = Sim3(3.1, Rotation.random(rng=rng).as_matrix(), rng.normal(0, 5, 3))
    map_T_cam = map_S_sfm.poses(sfm_T_cam)
    anchor = rng.normal(0, 5, 3)
    shared = SharedSd(scale=0.004, tilt=0.003, camera=0.002)

    n = 40_000
    sample = rng.multivariate_normal(np.zeros(6), covariance_sfm, n)
    rotation = Rotation.from_rotvec(sample[:, :3]).as_matrix() @ sfm_T_cam[:3, :3]
    samples = map_S_sfm.poses(make_pose(rotation, sfm_T_cam[:3, 3] + sample[:, 3:]))
    scale = np.exp(shared.scale * rng.normal(size=n))
    tilt = Rotation.from_rotvec(shared.tilt * rng.normal(size=(n, 3)) * [1, 0, 1]).as_matrix()
    arm = (samples[:, :3, 3] - anchor) * scale[:, None]
    camera = Rotation.from_rotvec(shared.camera * rng.normal(size=(n, 3)) * [1, 1, 0]).as_matrix()
    samples = make_pose(tilt @ samples[:, :3, :3] @ camera, anchor + np.einsum("nij,nj->ni", tilt, arm))
    found = np.cov(errors(samples, map_T_cam).T)

    own = covariance_in_map(covariance_sfm[None], map_S_sfm)
    expected = (own + shared_covariance(map_T_cam[None], anchor, shared))[0]
    sds = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(sds, sds), expected / np.outer(sds, sds), atol=0.03)


def test_largest_sd_looks_along_the_worst_axis() -> None:
    turn = Rotation.from_euler("xyz", [0.3, 1.0, -2.0]).as_matrix()
    covariance = np.zeros((2, 6, 6))
    covariance[0, :3, :3] = turn @ np.diag([1e-4, 4e-4, 9e-4]) @ turn.T
    covariance[0, 3:, 3:] = turn @ np.diag([0.01, 0.04, 0.25]) @ turn.T
    covariance[1] = np.nan
    metres, radians = largest_sd(covariance)
    np.testing.assert_allclose([metres[0], radians[0]], [0.5, 0.03])
    assert np.isnan([metres[1], radians[1]]).all()


def test_a_class_needs_all_of_its_limits_and_says_which_it_lacks() -> None:
    good = FrameEvidence(position_sd_m=0.005, rotation_sd_deg=0.02, observations=400, reprojection_deg=0.05)
    cases: list[tuple[dict[str, Any], str, str]] = [
        ({}, "A", ""),
        ({"position_sd_m": 0.03}, "B", "class B: position uncertain 0.03 m (limit 0.02)"),
        ({"position_sd_m": 0.03, "rotation_sd_deg": 0.42}, "C", "class C: rotation uncertain 0.42 deg (limit 0.3)"),
        ({"observations": 70}, "B", "class B: few points seen 70 (limit 100)"),
        ({"observations": 0}, "C", "class C: few points seen 0 (limit 50)"),
        ({"reprojection_deg": 0.2}, "B", "class B: reprojection 0.2 deg (limit 0.15)"),
        ({"position_sd_m": np.nan, "rotation_sd_deg": np.nan}, "C", "class C: uncertainty unknown"),
        ({"reprojection_deg": np.nan}, "C", "class C: reprojection nan deg (limit 0.3)"),
    ]
    grades = [grade(good._replace(**changes)) for changes, _, _ in cases]
    assert [(g.quality, g.reason) for g in grades] == [(quality, reason) for _, quality, reason in cases]
    assert count_grades(grades[:4] + grades[1:2]) == [
        "1 B: few points seen 70 (limit 100)",
        "2 B: position uncertain 0.03 m (limit 0.02)",
        "1 C: rotation uncertain 0.42 deg (limit 0.3)",
    ]
