"""Bounds that follow how far off earlier answers turned out to have been."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.fusion.methods.drift_aware import DriftAware
from groundwalk.fusion.methods.estimator import calibration
from groundwalk.geometry.poses import Array, make_pose
from groundwalk.scoring.errors import within_bounds
from tests.fusion.upright_walks import upright_walk


def inside(alike_s: float) -> Array:
    """Share of positions and rotations within 95 % bounds, (2,), where predictions are wrong alike for so long."""
    within = []
    for seed in range(4):
        t_ns, truth, vio, _ = upright_walk(seed, frames=300)
        rng, error = np.random.default_rng(100 + seed), np.zeros((len(t_ns), 6))
        kept = np.exp(-1 / alike_s)
        for i in range(len(t_ns)):
            error[i] = kept * error[i - 1] + np.sqrt(1 - kept**2) * rng.normal(size=6)
        turn = Rotation.from_rotvec(np.radians(3.0) * error[:, 3:]).as_matrix()
        apr = make_pose(turn @ truth[:, :3, :3], truth[:, :3, 3] + 0.5 * error[:, :3])
        localiser = DriftAware()
        answers = [localiser.step(int(t), v, a) for t, v, a in zip(t_ns, vio, apr, strict=True)]
        fused, covariance = np.array([a.map_T_cam for a in answers]), np.array([a.covariance for a in answers])
        within.append(within_bounds(fused, truth, covariance))
    return np.asarray(np.mean(np.concatenate(within), axis=0))


def test_bounds_hold_however_long_predictions_are_wrong_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    for alike_s in (1.0, 10.0):  # 0.97, 0.91 of the positions
        assert (inside(alike_s) >= 0.85).all()
    with monkeypatch.context() as never:
        never.setattr(calibration, "_AGE_S", 1e9)
        assert inside(5.0)[0] < 0.7  # 0.60
