"""Which frames share a lens, and what is known of it before a model tells."""

from typing import Any

import numpy as np
import pandas as pd
import pytest

from groundwalk.sfm.cameras.lenses import lenses_of, prior_lenses
from groundwalk.sfm.settings import SfmSettings
from tests.known import cells


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
