"""Lens and readout time from pairs of images: matches of made-up cameras through known lenses."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.lens import distort, rational_of_fisheye
from groundwalk.geometry.poses import Array, make_pose, relative
from groundwalk.sfm.cameras import calibration
from groundwalk.sfm.cameras.calibration import CalibratedLens, estimated_lens, lenses_of, prior_lenses
from groundwalk.sfm.cameras.lens_from_pairs import EXACT_INFORMATION, PairMatches, estimate_lens, sampson_of
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import CameraOrigin

_PAIRS, _POINTS = 40, 120
_FOCAL_PX, _NOISE_PX = 480.0, 0.3
# A phone's main lens with k3; an equidistant fisheye lens up to 55 degrees from its axis.
_LENSES = {
    "k3": np.array([0.09, -0.12, 0.001, -0.001, 0.3, 0, 0, 0]),
    "fisheye": rational_of_fisheye([0.0, 0.0, 0.0, 0.0], 0.96, 1e-4),
}


def _matches(lens: Array, seed: int, extent: float, readout_s: float = 0.0) -> PairMatches:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(rng.normal(0, 0.15, (2 * _PAIRS, 3))).as_matrix()
    pose = make_pose(turn, rng.normal(0, 0.6, (2 * _PAIRS, 3)))
    a_T_b = relative(pose[::2], pose[1::2])
    a_T_b[:, :3, 3] /= np.linalg.norm(a_T_b[:, :3, 3], axis=1, keepdims=True)
    depth = rng.uniform(3, 6, (_PAIRS, _POINTS, 1))
    xyz_a = depth * np.concatenate([rng.uniform(-extent, extent, (_PAIRS, _POINTS, 2)), np.ones_like(depth)], axis=2)
    xyz_b = np.einsum("pji,pmj->pmi", a_T_b[:, :3, :3], xyz_a - a_T_b[:, None, :3, 3])
    ideal_b = xyz_b[..., :2] / xyz_b[..., 2:]
    there = ((np.abs(ideal_b) < extent).all(axis=2) & (xyz_b[..., 2] > 1)).ravel()
    ideal = [at.reshape(-1, 2)[there] for at in (xyz_a[..., :2] / xyz_a[..., 2:], ideal_b)]
    pair = np.repeat(np.arange(_PAIRS), _POINTS)[there]
    rows, twists = np.zeros((2, len(pair))), np.zeros((2, _PAIRS, 6))
    if readout_s:
        twists[..., :3] = rng.normal(0, 0.4, (2, _PAIRS, 3))
        rows = np.clip([at[:, 1] / (2 * extent) for at in ideal], -0.5, 0.5)
    seen = []
    for at, row, twist in zip(ideal, rows, twists, strict=True):
        turn = Rotation.from_rotvec(-readout_s * row[:, None] * twist[pair, :3])
        ray = turn.apply(np.column_stack([at, np.ones(len(at))]))
        seen.append(distort(ray[:, :2] / ray[:, 2:], lens) + rng.normal(0, _NOISE_PX / _FOCAL_PX, at.shape))
    focal_px, ends = np.full((len(pair), 2), _FOCAL_PX), np.arange(2 * _PAIRS).reshape(-1, 2)
    xy, row, twist = (np.stack(list(parts), axis=1) for parts in (seen, rows, twists))
    return PairMatches(pair, xy, row, focal_px, a_T_b, twist, ends, lens[2:])


@pytest.mark.parametrize("name", _LENSES)
def test_k1_and_k2_are_estimated_beside_the_coefficients_that_stay(name: str) -> None:
    lens = _LENSES[name]
    matches = _matches(lens, 0, 1.0 if name == "fisheye" else 0.6)
    start = np.array([lens[0] + 0.02, lens[1] - 0.03, 0.0])
    estimate = estimate_lens(matches, start, np.diag(np.array([0.1, 0.2, 1e-6]) ** -2.0))
    sd = np.sqrt(np.diag(estimate.covariance))
    assert (sd[:2] < 0.02).all()
    assert (np.abs(estimate.parameters[:2] - lens[:2]) < 4 * sd[:2]).all()


def test_poses_converge_with_a_lens_that_is_held() -> None:
    """They move on while the lens has come to rest from the first step on."""
    matches = _matches(_LENSES["k3"], 0, 0.6)
    off = Rotation.from_rotvec(np.random.default_rng(1).normal(0, 0.9, (_PAIRS, 3))).as_matrix()
    start = matches.a_T_b.copy()
    start[:, :3] = off @ start[:, :3]
    held = estimate_lens(
        replace(matches, a_T_b=start), np.array([*_LENSES["k3"][:2], 0.0]), EXACT_INFORMATION * np.eye(3)
    )
    residual = sampson_of(matches, held.a_T_b, held.parameters)
    medians = pd.Series(np.abs(residual)).groupby(matches.pair).median()
    assert np.mean(medians < _NOISE_PX) > 0.9


@pytest.mark.parametrize("seed", range(2))
def test_round_an_object_features_that_slide_with_the_view_deny_no_stated_lens(seed: int) -> None:
    """Each pair can be fitted a little better by another lens, as its errors are its own."""
    rng, lens = np.random.default_rng(seed), np.array([0.008, 0, -0.004, -0.016, 0, 0, 0, 0])
    around = np.linspace(0, 2 * np.pi, 2 * _PAIRS, endpoint=False)
    pose = np.tile(np.eye(4), (len(around), 1, 1))
    pose[:, :3, :3] = Rotation.from_euler("y", around[:, None]).as_matrix()
    pose[:, :3, 3] = -4 * pose[:, :3, 2]
    ends = np.array([(k, (k + rng.integers(1, 6)) % len(around)) for k in range(0, len(around), 2)])
    direction = rng.normal(size=(_PAIRS, _POINTS, 3)) * [1, 1.6, 1]
    xyz = direction / np.linalg.norm(direction, axis=2, keepdims=True) * rng.uniform(0.6, 1.2, (_PAIRS, _POINTS, 1))
    seen, ahead = [], []
    for side in (0, 1):
        T = pose[ends[:, side]]
        p = np.einsum("pji,pmj->pmi", T[:, :3, :3], xyz - T[:, None, :3, 3])
        slide_px = rng.normal(0, 0.5, (_PAIRS, 2, 3))
        shift = np.einsum("pij,pmj->pmi", slide_px, xyz)
        noise = rng.normal(0, _NOISE_PX, shift.shape)
        seen.append(
            distort((p[..., :2] / p[..., 2:]).reshape(-1, 2), lens) + (shift + noise).reshape(-1, 2) / _FOCAL_PX
        )
        ahead.append(p[..., 2].ravel() < 4)
    both = ahead[0] & ahead[1]
    pair, a_T_b = np.repeat(np.arange(_PAIRS), _POINTS)[both], relative(pose[ends[:, 0]], pose[ends[:, 1]])
    a_T_b[:, :3, 3] /= np.linalg.norm(a_T_b[:, :3, 3], axis=1, keepdims=True)
    rows, focal_px = np.zeros((len(pair), 2)), np.full((len(pair), 2), _FOCAL_PX)
    twist = np.zeros((_PAIRS, 2, 6))
    matches = PairMatches(pair, np.stack(seen, axis=1)[both], rows, focal_px, a_T_b, twist, ends, lens[2:])
    frames = _frames((0.0, 0.0), len(around))
    frames["distortion"] = pd.Series([lens[:4].tolist()] * len(around))
    prior = prior_lenses(frames, {"walk": "phone"}, SfmSettings()).lenses[0]
    kept = estimated_lens(prior, matches, frames, seed)
    assert not kept.stated_is_wrong
    assert np.allclose(kept.coefficients[:2], lens[:2], atol=0.02)


@pytest.mark.parametrize("stated", [(-0.6, 0.0), (0.3, -1.0)])
def test_a_stated_lens_that_folds_back_within_the_image_leaves_finite_residuals(stated: tuple[float, float]) -> None:
    matches = _matches(np.array([0.09, -0.12, 0, 0, 0, 0, 0, 0]), 0, 0.6)
    estimate = estimate_lens(matches, np.array([*stated, 0.0]), np.diag([1e12, 1e12, 1e12]))
    assert np.allclose(estimate.parameters[:2], stated, atol=1e-3)
    residual = sampson_of(matches, estimate.a_T_b, estimate.parameters)
    assert np.isfinite(residual).all() and np.median(np.abs(residual)) > 5 * _NOISE_PX


@pytest.mark.parametrize("k1", [-0.3, 1.0])
def test_errors_are_those_of_the_captured_image_however_much_the_lens_shrinks_or_stretches_it(k1: float) -> None:
    """Taken in the image without its lens they would reward one that makes it smaller."""
    matches = _matches(np.array([k1, 0, 0, 0, 0, 0, 0, 0]), 0, 0.6)
    residual = sampson_of(matches, matches.a_T_b, np.array([k1, 0.0, 0.0]))
    assert np.std(residual) == pytest.approx(_NOISE_PX, rel=0.05)


@pytest.mark.parametrize(("lens", "seed"), [((0.0, 0.0), 0), ((0.0, 0.0), 5), ((0.09, -0.12), 0)])
def test_where_nothing_is_stated_images_say_whether_there_is_distortion(lens: tuple[float, float], seed: int) -> None:
    """With no distortion, a stated pinhole fits held-out matches as well as the estimate: which one does better is
    chance, and must not decide for what phones usually have."""
    estimated = _estimated((0.0, 0.0), lens, seed)
    sd = np.sqrt(np.diag(estimated.covariance))[:2]
    assert estimated.origin == CameraOrigin.ESTIMATED and (sd < 0.02).all()
    assert (np.abs(np.array(estimated.coefficients[:2]) - lens) < 4 * sd).all()
    assert np.allclose(estimated.coefficients[2:], 0) and not estimated.stated_is_wrong


def test_a_stated_lens_is_kept_or_named_wrong() -> None:
    true = (0.09, -0.12)
    near = (0.085, -0.115)  # not so far off that pairs could deny it
    right = _estimated(near, true, 0)
    assert np.allclose(right.coefficients[:2], near, atol=1e-4) and not right.stated_is_wrong
    assert right.origin == CameraOrigin.STATED and np.sqrt(np.diag(right.prior_covariance))[:2].max() < 1e-5
    # The inverse convention, and a lens of another phone.
    for stated in ((-0.09, 0.12), (0.2, -0.4)):
        wrong = _estimated(stated, true, 0)
        assert wrong.stated_is_wrong and wrong.origin == CameraOrigin.ESTIMATED
        assert np.allclose(wrong.coefficients[:2], true, atol=0.02)
        assert wrong.held_out_px is not None and wrong.held_out_prior_px is not None
        assert wrong.held_out_px < 0.98 * wrong.held_out_prior_px


def test_a_stated_lens_that_held_out_pairs_do_not_deny_beyond_chance_stays_in_the_model_too(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(calibration, "_MIN_GAIN_SIGMAS", 1e6)
    kept = _estimated((0.2, -0.4), (0.09, -0.12), 0)
    assert kept.stated_is_undecided and not kept.stated_is_wrong and kept.origin == CameraOrigin.STATED
    assert np.allclose(kept.coefficients[:2], (0.2, -0.4), atol=1e-4)
    assert np.sqrt(np.diag(kept.prior_covariance))[:2].max() < 1e-5 and kept.prior_k3_sd < 1e-5


@pytest.mark.parametrize(("pairs", "is_wrong"), [(_PAIRS, True), (8, False)])
def test_few_held_out_pairs_deny_no_stated_lens(pairs: int, is_wrong: bool) -> None:
    """Two gains that are alike by chance say nothing of their scatter."""
    matches = _matches(np.array([0.09, -0.12, 0, 0, 0, 0, 0, 0]), 0, 0.6).of_pairs(np.arange(_PAIRS) < pairs)
    prior = prior_lenses(_frames((0.2, -0.4), 2 * _PAIRS), {"walk": "phone"}, SfmSettings()).lenses[0]
    estimated = estimated_lens(prior, matches, _frames((0.2, -0.4), 2 * _PAIRS), 0)
    assert estimated.stated_is_wrong == is_wrong and estimated.stated_is_undecided != is_wrong


@pytest.mark.parametrize(("true", "is_wrong"), [((0.09, -0.12), True), ((0.0, 0.0), False)])
def test_a_pinhole_that_settings_hold_stays_and_is_named_where_images_have_a_lens(
    true: tuple[float, float], is_wrong: bool
) -> None:
    held = _estimated((0.0, 0.0), true, 0, SfmSettings(lens="stated"))
    assert held.origin == CameraOrigin.STATED and np.allclose(held.coefficients, 0, atol=1e-6)
    assert held.stated_is_wrong == is_wrong


@pytest.mark.parametrize(("stated_s", "is_wrong"), [(0.02, False), (0.033, True), (0.0, True)])
def test_a_stated_readout_time_is_kept_or_named_wrong(stated_s: float, is_wrong: bool) -> None:
    lens = (0.09, -0.12)
    estimated = _estimated((0.0, 0.0), lens, 0, readout_s=0.02, stated_readout_s=stated_s)
    assert estimated.stated_readout_s == stated_s and estimated.stated_readout_is_wrong == is_wrong
    assert estimated.readout_s == pytest.approx(0.02, abs=0.003)
    prior_sd_s = np.sqrt(estimated.prior_covariance[2][2])
    assert prior_sd_s > 0.01 if is_wrong else prior_sd_s < 0.002
    assert np.allclose(estimated.coefficients[:2], lens, atol=0.02) and estimated.origin == CameraOrigin.ESTIMATED


def test_a_readout_time_by_the_settings_goes_before_the_stated_one() -> None:
    settings = SfmSettings(readout_s=0.01)
    held = _estimated((0.0, 0.0), (0.09, -0.12), 0, settings, readout_s=0.02, stated_readout_s=0.033)
    assert held.readout_s == pytest.approx(0.01, abs=1e-5)
    assert held.stated_readout_s is None and not held.stated_readout_is_wrong


def test_a_stated_lens_without_distortion_is_one() -> None:
    frames = _frames((0.0, 0.0), 4)
    frames["distortion"] = pd.Series([[]] * 2 + [[0.0] * 4] * 2)
    prior = prior_lenses(frames, {"walk": "phone"}, SfmSettings())
    unstated, stated = (prior.lenses[prior.lens[row]] for row in (0, 2))
    assert (unstated.origin, stated.origin) == ("prior", "stated")
    assert not np.any(stated.coefficients) and np.any(unstated.coefficients)


def test_frames_share_a_lens_where_device_size_stated_lens_and_focal_length_are_the_same() -> None:
    frames = _frames((0.0, 0.0), 6)
    frames["session_id"] = ["a", "a", "b", "b", "c", "c"]
    frames.loc[[1, 3], "fx"] = 240.0  # the ultra-wide camera, in the middle of a session
    lens, names = lenses_of(frames, {"a": "phone", "b": "phone", "c": "another phone"})
    stated = frames.assign(stated_readout_s=[0.01, 0.01, 0.02, 0.02, 0.01, 0.01])
    assert len(lenses_of(stated, {"a": "phone", "b": "phone", "c": "another"})[1]) == 5
    assert len(names) == 3 and lens[0] == lens[2] and lens[1] == lens[3] and lens[4] == lens[5]
    assert len(set(lens[[0, 1, 4]])) == 3
    assert "phone, 640x480, focal length 0.38 widths" in names


def _estimated(
    stated: tuple[float, float],
    true: tuple[float, float],
    seed: int,
    settings: SfmSettings | None = None,
    readout_s: float = 0.0,
    stated_readout_s: float = np.nan,
) -> CalibratedLens:
    matches = _matches(np.array([*true, 0, 0, 0, 0, 0, 0]), seed, 0.6, readout_s)
    frames = _frames(stated, 2 * _PAIRS).assign(stated_readout_s=stated_readout_s)
    prior = prior_lenses(frames, {"walk": "phone"}, settings or SfmSettings()).lenses[0]
    return estimated_lens(prior, matches, frames, seed)


def _frames(stated: tuple[float, float], count: int) -> pd.DataFrame:
    row = {"session_id": "walk", "width": 640, "height": 480, "fx": _FOCAL_PX, "fy": _FOCAL_PX, "cx": 320.0}
    row |= {"cy": 240.0, "stated_readout_s": np.nan} | {f"vio_cam_{name}": np.nan for name in ("tx", "ty", "tz")}
    row |= {f"vio_cam_q{name}": float(name == "w") for name in "xyzw"}
    frames = pd.DataFrame([row] * count)
    frames["distortion"] = pd.Series([[*stated, 0.0, 0.0] if any(stated) else []] * count)
    return frames
