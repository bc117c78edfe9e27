"""The offset of time stamps from turns: pairs of a phone that turns, with VIO that is a little off."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.poses import Array, make_pose, relative
from groundwalk.sfm.cameras.lens_from_pairs import LensEstimate, PairMatches
from groundwalk.sfm.cameras.time_offset import TimeOffset, estimate_time_offset

_FRAMES, _POINTS = 40, 60
_FOCAL_PX, _NOISE_PX = 480.0, 0.3
_IMAGE_SD, _VIO_SD = 3e-4, 1e-3


def _turned(t_s: np.ndarray, seed: int) -> Array:
    """A hand's rotations (N, 3, 3) at times (N,)."""
    phase = np.random.default_rng(seed).uniform(0, 6, (3, 3))
    angles = sum(
        a * np.sin(w * t_s[:, None] + p) for a, w, p in zip((0.5, 0.15, 0.04), (0.7, 2.1, 5.0), phase, strict=True)
    )
    return Rotation.from_rotvec(angles).as_matrix()


def _estimated(
    offset_s: float, seed: int, still: bool = False, drift_sd: float = 0.0, denied: bool = False
) -> TimeOffset | None:
    """The estimate for frames whose middle rows are `offset_s` before their time stamps, by VIO that drifts a step; by
    held-out pairs they aren't where that is `denied`."""
    rng = np.random.default_rng(seed)
    stamp_s = np.linspace(0.0, 0.5 * (_FRAMES - 1), _FRAMES)
    places = make_pose(np.eye(3), rng.normal(0, 0.6, (_FRAMES, 3)))
    true, by_vio = places.copy(), places.copy()
    if not still:
        true[:, :3, :3], by_vio[:, :3, :3] = _turned(stamp_s - offset_s, seed), _turned(stamp_s, seed)
    noise = Rotation.from_rotvec(rng.normal(0, _VIO_SD, (_FRAMES, 3))).as_matrix()
    by_vio[:, :3, :3] = by_vio[:, :3, :3] @ noise
    drift = Rotation.from_rotvec(np.cumsum(rng.normal(0, 1, (_FRAMES, 3)), axis=0) * [0, drift_sd, 0]).as_matrix()
    by_vio[:, :3, :3] = drift @ by_vio[:, :3, :3]
    step = 0.01
    before, after = _turned(stamp_s - step, seed), _turned(stamp_s + step, seed)
    angular = Rotation.from_matrix(np.swapaxes(before, 1, 2) @ after).as_rotvec() / (2 * step)
    twist = np.concatenate([0 * angular if still else angular, np.zeros((_FRAMES, 3))], axis=1)
    ends = np.array([(a, a + k) for a in range(_FRAMES) for k in (1, 2, 3) if a + k < _FRAMES])
    a, b = ends.T
    a_T_b = relative(true[a], true[b])
    xyz_a = rng.uniform([-2, -2, 3], [2, 2, 6], (len(ends), _POINTS, 3))
    xyz_b = np.einsum("pji,pmj->pmi", a_T_b[:, :3, :3], xyz_a - a_T_b[:, None, :3, 3])
    ahead = (xyz_b[..., 2] > 1).ravel()
    xy = [(p[..., :2] / p[..., 2:]).reshape(-1, 2)[ahead] for p in (xyz_a, xyz_b)]
    xy = [at + rng.normal(0, _NOISE_PX / _FOCAL_PX, at.shape) for at in xy]
    pair = np.repeat(np.arange(len(ends)), _POINTS)[ahead]
    row, focal_px, xy_M22 = np.zeros((len(pair), 2)), np.full((len(pair), 2), _FOCAL_PX), np.stack(xy, axis=1)
    matches = PairMatches(pair, xy_M22, row, focal_px, a_T_b, twist[ends], ends, np.zeros(6))
    fitted = a_T_b.copy()
    fitted[:, :3, :3] = fitted[:, :3, :3] @ Rotation.from_rotvec(rng.normal(0, _IMAGE_SD, (len(ends), 3))).as_matrix()
    is_held_out = rng.random(len(ends)) < 0.25
    estimate = LensEstimate(np.zeros(3), np.eye(3), fitted)
    vio_a_R_b = relative(by_vio[a], by_vio[b])[:, :3, :3]
    vio_a_R_b[0] = np.nan
    if denied:
        vio_a_R_b[is_held_out] = a_T_b[is_held_out, :3, :3]
    return estimate_time_offset(estimate, matches, is_held_out, vio_a_R_b)


@pytest.mark.parametrize("offset_s", [-0.02, 0.008, 0.03])
def test_the_offset_is_found_within_its_bounds_and_accepted(offset_s: float) -> None:
    found = _estimated(offset_s, 1)
    assert found is not None and found.accepted
    assert abs(found.offset_s - offset_s) < max(3 * found.sd_s, 0.03 * abs(offset_s))
    assert found.sd_s < 0.003


@pytest.mark.parametrize("drift_sd", [0.0, 0.03])
def test_its_standard_error_is_honest(drift_sd: float) -> None:
    found = [_estimated(0.0, seed, drift_sd=drift_sd) for seed in range(60)]
    ratio = [one.offset_s / one.sd_s for one in found if one is not None]
    assert len(ratio) == 60 and 0.7 < np.sqrt(np.mean(np.square(ratio))) < 1.5


def test_a_phone_that_does_not_turn_tells_nothing_beyond_the_prior() -> None:
    found = _estimated(0.02, 1, still=True)
    assert found is not None and abs(found.offset_s) < 1e-6 and found.sd_s == pytest.approx(0.03, rel=0.01)


def test_an_offset_that_held_out_matches_contradict_is_not_accepted() -> None:
    found = _estimated(0.02, 1, denied=True)
    assert found is not None and abs(found.offset_s) > 0.01 and not found.accepted
