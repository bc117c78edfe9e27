"""Which frames share a lens, what is known of it before a model tells, and the lens that mapping starts from, by pairs
of images of made-up points through known lenses."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.geometry.lens import distort
from groundwalk.geometry.poses import make_pose
from groundwalk.sfm.cameras.lenses import PHONE_K1_K2, LensPrior, lenses_of, prior_lenses, started, with_lenses
from groundwalk.sfm.cameras.model_adjustment import known_lens
from groundwalk.sfm.cameras.starts import start_lenses
from groundwalk.sfm.database import create_database, image_id
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import CameraOrigin
from tests.known import cells

FRAMES, POINTS = 8, 300
PHONE = tuple(PHONE_K1_K2.tolist())


def start_of(folder: Path, stated: tuple[float, float] | None, true: tuple[float, float]) -> np.ndarray:
    """k1 and k2 that mapping starts from, of a camera with a lens that walks past points at different depths."""
    rng = np.random.default_rng(0)
    frames = frames_of([[*stated, 0.0, 0.0] if stated else []] * FRAMES)
    lenses = prior_lenses(frames, {"walk": "phone"}, SfmSettings())
    database = folder / "features.db"
    create_database(database, with_lenses(frames, lenses), [f"{i}.jpg" for i in range(FRAMES)])
    xyz = np.column_stack([rng.uniform(-4, 4, POINTS), rng.uniform(-3, 3, POINTS), rng.uniform(3, 6, POINTS)])
    directions = rng.gamma(0.5, 1.0, (POINTS, 128))
    descriptors = (512 * directions / np.linalg.norm(directions, axis=1, keepdims=True)).clip(0, 255).astype(np.uint8)
    turns = Rotation.from_rotvec(rng.normal(0, 0.05, (FRAMES, 3)))
    poses = make_pose(
        turns.as_matrix(), np.column_stack([np.linspace(-1, 1, FRAMES), *rng.normal(0, 0.2, (2, FRAMES))])
    )
    with pycolmap.Database.open(database) as opened:
        for number, pose in enumerate(poses):
            ray = (xyz - pose[:3, 3]) @ pose[:3, :3]
            px = distort(ray[:, :2] / ray[:, 2:], [*true, 0, 0]) * 480 + [320, 240] + rng.normal(0, 0.3, (POINTS, 2))
            seen = ((px > 0) & (px < [640, 480])).all(axis=1)
            opened.write_keypoints(image_id(number), px[seen].astype(np.float32))
            sift = pycolmap.FeatureExtractorType.SIFT
            opened.write_descriptors(image_id(number), pycolmap.FeatureDescriptors(data=descriptors[seen], type=sift))
    pairs = np.array([*pairwise(range(FRAMES))], np.int64)
    (start,) = start_lenses(lambda done, note="": None, database, lenses, pairs, 0)
    prior = started(lenses.priors[0], np.array(start))
    assert (prior.start is not None) == (stated is not None and not np.allclose(start[:2], stated)), "stated ones stay"
    distortion = with_lenses(frames, type(lenses)([prior], lenses.lens))["distortion"]
    assert np.allclose(distortion.iloc[0][:2], start[:2])
    return np.array(start[:2])


@pytest.mark.parametrize("true", [PHONE, (0.04, -0.05), (0.12, -0.25)])
def test_a_phones_lens_starts_from_the_usual_one(tmp_path: Path, true: tuple[float, float]) -> None:
    assert np.allclose(start_of(tmp_path, None, true), PHONE)


def test_a_wide_angle_lens_that_nobody_states_starts_from_one(tmp_path: Path) -> None:
    assert start_of(tmp_path, None, (-0.25, 0.06))[0] < -0.1


@pytest.mark.parametrize("stated", [(0.085, -0.13), (0.05, -0.1)])
def test_a_stated_lens_that_is_about_right_is_started_from(tmp_path: Path, stated: tuple[float, float]) -> None:
    assert np.allclose(start_of(tmp_path, stated, PHONE), stated)


def test_a_stated_lens_that_is_far_off_is_not_started_from(tmp_path: Path) -> None:
    assert np.abs(start_of(tmp_path, (-0.3, 0.4), PHONE) - PHONE).max() < 0.1


def test_a_lens_that_a_map_knows_is_started_from() -> None:
    stated = LensPrior("phone", 2, np.zeros(8), 0.0, np.eye(3), 0.1, CameraOrigin.STATED, np.zeros(2))
    known = known_lens(started(stated, np.ones(8)), np.full(8, 0.1), 0.01, np.array([3.0, -4.0]))
    assert known.start is None and np.all(known.coefficients == 0.1)


def frames_of(distortion: list[list[float]], **columns: Any) -> pd.DataFrame:
    row = {"session_id": "walk", "width": 640, "height": 480, "fx": 480.0, "fy": 480.0, "cx": 320.0, "cy": 240.0}
    frames = pd.DataFrame([row | {"stated_readout_s": np.nan}] * len(distortion)).assign(**columns)
    return frames.assign(distortion=cells(distortion))


def test_a_stated_lens_without_distortion_is_one() -> None:
    known = prior_lenses(frames_of([[]] * 2 + [[0.0] * 4] * 2), {"walk": "phone"}, SfmSettings())
    unstated, stated = (known.priors[known.lens[row]] for row in (0, 2))
    assert (unstated.origin, stated.origin) == ("prior", "stated")
    assert not np.any(stated.coefficients) and np.any(unstated.coefficients)
    assert np.sqrt(np.diag(stated.covariance))[:2].max() < 1e-5 < np.sqrt(np.diag(unstated.covariance))[:2].min()


def test_a_readout_time_by_the_settings_goes_before_the_stated_one() -> None:
    frames = frames_of([[]] * 2, stated_readout_s=0.033)
    (stated,) = prior_lenses(frames, {"walk": "phone"}, SfmSettings()).priors
    (held,) = prior_lenses(frames, {"walk": "phone"}, SfmSettings(readout_s=0.01)).priors
    assert stated.readout_s == stated.stated_readout_s == 0.033
    assert held.readout_s == pytest.approx(0.01) and held.stated_readout_s is None
    assert np.sqrt(held.covariance[2, 2]) < 1e-5 < np.sqrt(stated.covariance[2, 2])


def test_frames_share_a_lens_where_device_size_stated_lens_and_focal_length_are_the_same() -> None:
    frames = frames_of([[]] * 6, session_id=["a", "a", "b", "b", "c", "c"])
    frames.loc[[1, 3], "fx"] = 240.0  # the ultra-wide camera, in the middle of a session
    lens, names = lenses_of(frames, {"a": "phone", "b": "phone", "c": "another phone"})
    stated = frames.assign(stated_readout_s=[0.01, 0.01, 0.02, 0.02, 0.01, 0.01])
    assert len(lenses_of(stated, {"a": "phone", "b": "phone", "c": "another"})[1]) == 5
    assert len(names) == 3 and lens[0] == lens[2] and lens[1] == lens[3] and lens[4] == lens[5]
    assert len(set(lens[[0, 1, 4]])) == 3
    assert "phone, 640x480, focal length 0.38 widths" in names


def test_portrait_and_landscape_images_share_a_lens() -> None:
    frames = frames_of([[]] * 3)
    frames.loc[1, ["width", "height"]] = 480, 640
    frames.loc[2, ["width", "height"]] = 480, 480
    lens, names = lenses_of(frames, {"walk": "phone"})
    assert lens[0] == lens[1] != lens[2] and "phone, 640x480, focal length 0.75 widths" in names
