"""Where focal lengths that EXIF states, or nothing does, give way to what the images say."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest

from groundwalk.sfm.cameras.starts import sample_unstated
from groundwalk.sfm.database import Workspace
from groundwalk.sfm.scene_input import with_focal_lengths
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.files import write_json


@pytest.mark.parametrize(
    ("photos", "stated_sd", "found_px", "used_px", "is_told"),
    [
        (5, 0.05, 1050.0, 1050.0, False),
        (5, 0.05, 1250.0, 1250.0, True),
        (1, 0.05, 1250.0, 1000.0, False),  # one of a facade is off by that
        (1, 0.05, 2000.0, 2000.0, True),  # cropped
        (1, 0.5, 1250.0, 1250.0, False),
    ],
)
def test_images_beat_exif_where_they_are_many_or_far_off_it(
    tmp_path: Path, photos: int, stated_sd: float, found_px: float, used_px: float, is_told: bool
) -> None:
    frame = {"session_id": "s", "width": 1200, "height": 900, "fx": 1000.0, "fy": 1000.0, "focal_sd": stated_sd}
    write_json(tmp_path / "focal_lengths.json", {"s": found_px})  # as an earlier, killed run left it
    said: list[str] = []
    run: Any = SimpleNamespace(settings=SfmSettings(), say=said.append)
    work = Workspace(tmp_path, [f"{n}.jpg" for n in range(photos)], tmp_path, {})
    used = with_focal_lengths(run, pd.DataFrame([frame] * photos), work)
    assert used[["fx", "fy"]].to_numpy() == pytest.approx(used_px)
    assert any("EXIF states" in line for line in said) == is_told


@pytest.mark.parametrize(
    ("images", "sampled"), [([100], [30]), ([100, 100, 100], [10, 10, 10]), ([200, 3], [27, 3]), ([20, 5], [20, 5])]
)
def test_each_of_several_videos_has_a_part_in_what_tells_their_focal_lengths(
    images: list[int], sampled: list[int]
) -> None:
    session = np.repeat(np.arange(len(images)), images)
    frames = pd.DataFrame({"session_id": session.astype(str), "width": 1920, "height": 1080, "focal_sd": 0.5})
    rows = sample_unstated(frames)
    assert np.bincount(session[rows]).tolist() == sampled
    for one in np.unique(session):
        assert (np.diff(rows[session[rows] == one]) == 1).all()
