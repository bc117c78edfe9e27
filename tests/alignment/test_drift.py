"""Drift measures against evo's, the paper's formulas, and drifts that are known."""

from typing import Any

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D
from scipy.spatial.transform import Rotation

from groundwalk.alignment.drift import DriftSamples, drift_table, measure_drift
from groundwalk.geometry.poses import make_pose, yaw_rotation
from groundwalk.scoring.errors import rpe_roe

Paths = tuple[np.ndarray, np.ndarray, np.ndarray]


@pytest.fixture
def paths() -> Paths:
    """Times, ground truth and VIO of a walk of 100 frames."""
    rng = np.random.default_rng(3)
    xyz = np.cumsum(rng.normal(0, 0.6, (100, 3)), axis=0)
    gt = make_pose(Rotation.random(100, rng=rng).as_matrix(), xyz)
    error = Rotation.from_rotvec(rng.normal(0, 0.02, (100, 3))).as_matrix()
    turned = make_pose(Rotation.random(rng=rng).as_matrix(), [1.0, 2, 3])
    vio = turned @ make_pose(error @ gt[:, :3, :3], xyz + np.cumsum(rng.normal(0, 0.02, (100, 3)), axis=0))
    return np.arange(100) * 10**9, gt, vio


def values(found: list[DriftSamples], definition: str, unit: str, interval_unit: str | None = None) -> np.ndarray:
    (samples,) = [
        s for s in found if (s.definition, s.unit) == (definition, unit) and interval_unit in (None, s.interval_unit)
    ]
    return samples.found


def evo_errors(metric: Any, gt: np.ndarray, vio: np.ndarray, align: bool = False, scale: bool = False) -> np.ndarray:
    a, b = PosePath3D(poses_se3=list(gt)), PosePath3D(poses_se3=list(vio))
    if align:
        b.align(a, correct_scale=scale)
    metric.process_data((a, b))
    return np.asarray(metric.error)


def test_measures_agree_with_evo(paths: Paths) -> None:
    t_ns, gt, vio = paths
    found = measure_drift(t_ns, gt, vio)
    part, rotation = evo_metrics.PoseRelation.translation_part, evo_metrics.PoseRelation.rotation_angle_deg
    for relation, name, unit in ((part, "relative_position", "m"), (rotation, "relative_rotation", "deg")):
        expected = evo_errors(evo_metrics.RPE(relation, delta=1, delta_unit=evo_metrics.Unit.frames), gt, vio)
        np.testing.assert_allclose(values(found, name, unit, "pair"), expected, atol=1e-9)
        np.testing.assert_allclose(values(found, name, unit, "s"), expected, atol=1e-9)
    for name, scale in (("ate_se3", False), ("ate_sim3", True)):
        expected = evo_errors(evo_metrics.APE(part), gt, vio, align=True, scale=scale)
        np.testing.assert_allclose(values(found, name, "m"), expected, atol=1e-9)


def test_errors_by_distance_agree_with_evo(paths: Paths) -> None:
    """Steps of a metre, so that a pair five metres apart is the same pair in both definitions."""
    t_ns, gt, vio = paths
    rng = np.random.default_rng(4)
    gt[:, :3, 3] = np.cumsum(np.eye(3)[rng.integers(3, size=len(gt))] * rng.choice([-1, 1], (len(gt), 1)), axis=0)
    found = measure_drift(t_ns, gt, vio)
    part, rotation = evo_metrics.PoseRelation.translation_part, evo_metrics.PoseRelation.rotation_angle_deg
    for relation, name, share in ((part, "distance_position", 100), (rotation, "distance_rotation", 1)):
        for metres in (5.0, 20.0):
            metric = evo_metrics.RPE(
                relation, metres, evo_metrics.Unit.meters, 0.01, all_pairs=True, pairs_from_reference=True
            )
            (samples,) = [s for s in found if (s.definition, s.interval) == (name, metres)]
            np.testing.assert_allclose(samples.found, share * evo_errors(metric, gt, vio) / metres, atol=1e-9)


def test_paper_measures_are_the_papers(paths: Paths) -> None:
    t_ns, gt, vio = paths
    found = measure_drift(t_ns, gt, vio)
    rpe, roe = rpe_roe(gt, vio)
    np.testing.assert_allclose(values(found, "paper_rpe", "m", "pair"), rpe, atol=1e-12)
    np.testing.assert_allclose(values(found, "paper_roe", "deg", "pair"), roe, atol=1e-6)


def test_known_drifts_have_their_size() -> None:
    """Straight on at 1 m/s with a turn of the head; VIO 2 % too long, and turning 3 degrees a minute."""
    seconds = np.arange(121.0)
    gt = make_pose(yaw_rotation(np.sin(seconds / 9)), np.stack([seconds, 0 * seconds, 0.01 * seconds**1.5], axis=1))
    longer = gt.copy()
    longer[:, :3, 3] *= 1.02
    found = measure_drift((seconds * 1e9).astype(np.int64), gt, longer)
    for name, _, interval_unit, unit, samples in found:
        if name == "distance_position" and unit == "%":
            np.testing.assert_allclose(samples, 2, rtol=0.01)
        if name == "paper_rpe" and interval_unit == "s":
            np.testing.assert_allclose(samples, 0.02, rtol=0.05)
    assert values(found, "ate_sim3", "m").max() < 1e-9

    bent = gt.copy()
    bent[:, :3, :3] = yaw_rotation(-np.radians(3 * seconds / 60)) @ gt[:, :3, :3]
    found = measure_drift((seconds * 1e9).astype(np.int64), gt, bent)
    assert values(found, "yaw_rate", "deg/min") == pytest.approx(3, abs=1e-6)
    assert values(found, "paper_roe", "deg", "s").mean() <= 0.05 + 1e-9


def test_the_table_pools_sessions_and_counts_samples(paths: Paths) -> None:
    t_ns, gt, vio = paths
    table = drift_table({"a": measure_drift(t_ns, gt, vio), "b": measure_drift(t_ns[:20], gt[:20], vio[:20])})
    steps = table[(table["definition"] == "paper_rpe") & (table["interval_unit"] == "pair")]
    assert steps.set_index("session_id")["samples"].to_dict() == {"a": 99, "b": 19, "all": 118}
    pooled = steps.set_index("session_id")["mean"]
    assert pooled["all"] == pytest.approx((99 * pooled["a"] + 19 * pooled["b"]) / 118)
    assert table[["mean", "median", "rms", "p95", "max"]].notna().all(axis=None)
