"""Stated lenses and readout times against a model's images: cameras round some points, seen through a known lens."""

from itertools import combinations

import numpy as np
import pandas as pd
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from groundwalk.geometry.lens import distort
from groundwalk.geometry.poses import Array, inverse, make_pose
from groundwalk.geometry.shutter import readout_lines
from groundwalk.sfm.cameras.lenses import LensPrior, SceneLenses
from groundwalk.sfm.cameras.model_adjustment import CameraLog, Held
from groundwalk.sfm.cameras.motion import Motion
from groundwalk.sfm.database import image_id
from groundwalk.sfm.mapping import stated as module
from groundwalk.sfm.mapping.held_out import Matches
from groundwalk.sfm.mapping.stated import StatedCheck, check_stated
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import CameraOrigin

FRAMES, POINTS, NOISE_PX = 12, 500, 0.3
FOCAL_PX, WIDTH, HEIGHT = 480.0, 640, 480
PHONE = (0.09, -0.12)
INTRINSICS = np.array([FOCAL_PX, FOCAL_PX, WIDTH / 2, HEIGHT / 2])


def checked(
    stated: tuple[float, float],
    true: tuple[float, float],
    settings: SfmSettings | None = None,
    readout_s: float = 0.0,
    stated_readout_s: float | None = None,
    slide_px: float = 0.0,
) -> tuple[LensPrior, StatedCheck]:
    """What a model says of a stated lens: features off by NOISE_PX, and by so much more that slides with the view."""
    rng = np.random.default_rng(0)
    angle = np.linspace(-0.6, 0.6, FRAMES)
    turn = Rotation.from_euler("yx", np.column_stack([angle, rng.normal(0, 0.1, FRAMES)]))
    sfm_T_cam = make_pose(turn.as_matrix(), turn.apply([0.0, 0.0, -4.0]) + rng.normal(0, 0.3, (FRAMES, 3)))
    angular = rng.normal(0, 0.5, (FRAMES, 3)) * bool(readout_s)
    xyz = rng.uniform(-1.6, 1.6, (POINTS, 3)) * [1, 1, 0.7]
    line = readout_lines(np.full(FRAMES, "top"), np.full(FRAMES, WIDTH), np.full(FRAMES, HEIGHT))
    seen = np.stack([project(xyz, T, true, w, readout_s) for T, w in zip(sfm_T_cam, angular, strict=True)])
    slide = np.einsum("fij,pj->fpi", rng.normal(0, slide_px, (FRAMES, 2, 3)), xyz)
    seen += rng.normal(0, NOISE_PX, seen.shape) + slide
    inside: NDArray[np.bool_] = np.all((seen > 0) & (seen < [WIDTH, HEIGHT]), axis=2)
    held_out = rng.random(POINTS) < 0.1

    model = pycolmap.Reconstruction()
    for row in range(FRAMES):
        number = image_id(row)
        camera = pycolmap.Camera(camera_id=number, model="OPENCV", width=WIDTH, height=HEIGHT)
        camera.params = [*INTRINSICS, *stated, 0, 0]
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=f"{row}.jpg", keypoints=seen[row], camera_id=number, image_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(inverse(sfm_T_cam[row])[:3]))
    for point in np.flatnonzero(~held_out & (inside.sum(axis=0) > 2)).tolist():
        track = [pycolmap.TrackElement(image_id(row), point) for row in np.flatnonzero(inside[:, point]).tolist()]
        model.add_point3D(xyz[point], pycolmap.Track(track))
    pairs = [(a, b, np.flatnonzero(inside[a] & inside[b])) for a, b in combinations(range(FRAMES), 2)]
    ends = np.concatenate([np.tile([a, b], (len(both), 1)) for a, b, both in pairs])
    xy_a, xy_b = (np.concatenate([seen[pair[side]][pair[2]] for pair in pairs]) for side in (0, 1))
    matches = Matches(ends, xy_a, xy_b, np.concatenate([held_out[both] for _, _, both in pairs]))

    covariance = np.diag([1e-6, 1e-6, 0.001 if stated_readout_s is not None else 1e-6]) ** 2
    coefficients = np.array([*stated, 0, 0, 0, 0, 0, 0], float)
    start_s = stated_readout_s or 0.0
    prior = LensPrior(
        *("phone", FRAMES, coefficients, start_s, covariance, 1e-6, CameraOrigin.STATED, coefficients[:2]),
        stated_readout_s=stated_readout_s,
    )
    log = CameraLog(
        np.tile(INTRINSICS, (FRAMES, 1)),
        line,
        np.full(FRAMES, "walk"),
        np.arange(FRAMES, dtype=float),
        sfm_T_cam,
        np.zeros(FRAMES),
        SceneLenses([prior], np.zeros(FRAMES, np.int64)),
        motion := Motion(angular, np.full(FRAMES, 0.005), np.zeros((FRAMES, 3)), np.ones(FRAMES, bool)),
        lambda offset_s: motion,
    )
    decided, (check,) = check_stated(model, matches, list(seen), log, settings or SfmSettings(), Held())
    assert model.num_reg_frames() == FRAMES and np.allclose(model.cameras[1].params[4:6], stated), "it stays as it is"
    return decided.lenses.priors[0], check


def project(xyz: Array, sfm_T_cam: Array, lens: tuple[float, float], angular: Array, readout_s: float) -> Array:
    """Pixels (P, 2) of a rolling shutter, whose row's time is found by going round twice."""
    in_camera = (xyz - sfm_T_cam[:3, 3]) @ sfm_T_cam[:3, :3]
    tau = np.zeros(len(xyz))
    for _ in range(3):
        ray = Rotation.from_rotvec(-tau[:, None] * angular).apply(in_camera)
        px = distort(ray[:, :2] / ray[:, 2:], [*lens, 0, 0]) * INTRINSICS[:2] + INTRINSICS[2:]
        tau = readout_s * (px[:, 1] / HEIGHT - 0.5)
    return px


@pytest.mark.parametrize("stated", [(0.085, -0.115), PHONE])
def test_a_stated_lens_that_images_do_not_deny_is_held(stated: tuple[float, float]) -> None:
    prior, check = checked(stated, PHONE)
    assert not check.distortion_is_wrong and not check.distortion_is_undecided
    assert prior.origin == CameraOrigin.STATED and np.allclose(prior.coefficients[:2], stated)
    assert np.sqrt(np.diag(prior.covariance))[:2].max() < 1e-5


@pytest.mark.parametrize("stated", [(-0.09, 0.12), (0.2, -0.4), (0.0, 0.0), (0.3, -1.0)])
def test_the_inverse_convention_or_another_phones_lens_is_named_and_estimated(stated: tuple[float, float]) -> None:
    prior, check = checked(stated, PHONE)
    assert check.distortion_is_wrong and check.held_out_free_px < 0.9 * check.held_out_stated_px
    assert prior.origin == CameraOrigin.ESTIMATED and np.sqrt(np.diag(prior.covariance))[:2].min() > 0.05


def test_few_held_out_pairs_deny_no_stated_lens() -> None:
    """Two gains that are alike by chance say nothing of their scatter."""
    before, after = (
        pd.Series(errors, pd.MultiIndex.from_tuples([(0, 1), (1, 2)], names=["a", "b"]))
        for errors in ([0.5, 0.7], [0.3, 0.4])
    )
    assert not module._is_better(before, after) and not module._is_better(before[:1], after[:1])


def test_features_that_slide_with_the_view_deny_no_stated_lens() -> None:
    prior, check = checked((0.008, 0.0), (0.008, 0.0), slide_px=0.5)
    assert not check.distortion_is_wrong and prior.origin == CameraOrigin.STATED


def test_a_lens_that_held_out_matches_do_not_deny_beyond_chance_stays_and_counts_as_uncertain(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(module, "_MIN_GAIN_SIGMAS", 1e6)
    prior, check = checked((0.2, -0.4), PHONE)
    assert check.distortion_is_undecided and prior.is_undecided and prior.origin == CameraOrigin.STATED


@pytest.mark.parametrize(("true", "is_wrong"), [(PHONE, True), ((0.0, 0.0), False)])
def test_a_pinhole_that_settings_hold_stays_and_is_named_where_images_have_a_lens(
    true: tuple[float, float], is_wrong: bool
) -> None:
    prior, check = checked((0.0, 0.0), true, SfmSettings(lens="stated"))
    assert check.distortion_is_wrong == is_wrong
    assert prior.origin == CameraOrigin.STATED and np.sqrt(np.diag(prior.covariance))[:2].max() < 1e-5


@pytest.mark.parametrize(("stated_s", "is_wrong"), [(0.02, False), (0.033, True), (0.0, True)])
def test_a_stated_readout_time_is_kept_or_named_wrong(stated_s: float, is_wrong: bool) -> None:
    prior, check = checked(PHONE, PHONE, readout_s=0.02, stated_readout_s=stated_s)
    assert check.readout_is_wrong == is_wrong and not check.distortion_is_wrong
    sd_s = np.sqrt(prior.covariance[2, 2])
    assert sd_s > 0.01 if is_wrong else sd_s < 0.002
