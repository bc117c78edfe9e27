"""Errors against evo, and what the paper's definitions do and don't see."""

from typing import Any

import numpy as np
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PosePath3D
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from groundwalk.alignment.quality import CLASS_A, CLASS_B
from groundwalk.geometry.poses import make_pose
from groundwalk.scoring.errors import (
    ACCURACY_LEVELS,
    accuracy_shares,
    position_error,
    relative_error,
    rotation_error_deg,
    rpe_roe,
    sure_enough,
)

seeds = st.integers(0, 2**32 - 1)


def walk(seed: int, count: int = 12) -> np.ndarray:
    rng = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(np.cumsum(rng.normal(scale=0.2, size=(count, 3)), axis=0)).as_matrix()
    return make_pose(rotation, np.cumsum(rng.normal(size=(count, 3)), axis=0))


def evo_error(metric: evo_metrics.PE, true: np.ndarray, estimated: np.ndarray) -> np.ndarray:
    metric.process_data((PosePath3D(poses_se3=list(true)), PosePath3D(poses_se3=list(estimated))))
    return metric.error


@given(seeds)
def test_absolute_errors_agree_with_evo(seed: int) -> None:
    true, estimated = walk(seed), walk(seed + 1)
    relation = evo_metrics.PoseRelation
    assert np.allclose(
        position_error(estimated, true),
        evo_error(evo_metrics.APE(relation.translation_part), true, estimated),
        atol=1e-9,
    )
    assert np.allclose(
        rotation_error_deg(estimated, true),
        evo_error(evo_metrics.APE(relation.rotation_angle_deg), true, estimated),
        atol=1e-9,
    )


@given(seeds)
def test_relative_errors_agree_with_evo(seed: int) -> None:
    true, estimated = walk(seed), walk(seed + 1)
    metres, degrees = relative_error(true, estimated)
    relation, unit = evo_metrics.PoseRelation, evo_metrics.Unit.frames
    evo_metres = evo_error(evo_metrics.RPE(relation.translation_part, 1, unit, all_pairs=True), true, estimated)
    evo_degrees = evo_error(evo_metrics.RPE(relation.rotation_angle_deg, 1, unit, all_pairs=True), true, estimated)
    assert np.allclose(metres, evo_metres, atol=1e-9)
    assert np.allclose(degrees, evo_degrees, atol=1e-9)


@given(seeds)
def test_relative_errors_do_not_see_the_frame(seed: int) -> None:
    path, other = walk(seed), walk(seed + 1)
    moved = walk(seed + 2)[3] @ path
    assert np.allclose(rpe_roe(moved, other), rpe_roe(path, other), atol=1e-5)
    assert np.allclose(relative_error(moved, other), relative_error(path, other), atol=1e-9)


def test_missing_frames_count_as_failed() -> None:
    position, rotation = np.array([0.1, 0.4, np.nan, 9]), np.array([1.0, 1, np.nan, 1])
    assert accuracy_shares(position, rotation) == {"high": 0.25, "medium": 0.5, "low": 0.5}
    assert np.isnan(accuracy_shares([], [])["low"])


def test_classes_that_levels_count_promise_every_level_with_95_percent() -> None:
    """By the limits of align's classes: 2.8 sigma of A and B lie within the strictest level; C has no limits."""
    bound = np.sqrt(chi2.ppf(0.95, 3))
    strictest = np.min(list(ACCURACY_LEVELS.values()), axis=0)
    for limits in (CLASS_A, CLASS_B):
        assert bound * limits.position_sd_m <= strictest[0] and bound * limits.rotation_sd_deg <= strictest[1]
    stated: list[Any] = ["A", "B", "C", "none", None, np.nan]
    assert list(sure_enough(stated)) == [True, True, False, False, True, True]
