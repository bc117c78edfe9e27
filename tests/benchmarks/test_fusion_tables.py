"""The tables that the fusion leaderboard reads."""

from pathlib import Path

import pandas as pd
import pytest

from benchmarks.fusion_tables import write_trained
from groundwalk.artefacts import UserError


def test_a_scene_is_written_for_each_seed_that_the_named_models_were_trained_with(
    trained_wall: Path, tmp_path: Path
) -> None:
    trained = tmp_path / "trained"
    trained.mkdir()
    for folder in ("PN-0", "PN-3", "PN-Lite-0"):
        (trained / folder).symlink_to(trained_wall)
    assert write_trained(tmp_path / "out", trained, ["PN"]) == ["Wall seed 0", "Wall seed 3"]
    predictions = pd.read_parquet(tmp_path / "out" / "Wall seed 3" / "predictions.parquet")
    frames = pd.read_parquet(tmp_path / "out" / "Wall seed 3" / "frames.parquet")
    assert set(predictions["model"]) == {"PN"} and set(predictions["frame_id"]) <= set(frames["frame_id"])
    with pytest.raises(UserError, match="nothing was trained there"):
        write_trained(tmp_path / "out", trained, ["PN", "MS-T"])
