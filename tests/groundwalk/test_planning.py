"""What runs would take, by finished runs that are made up."""

import re
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from typer.testing import CliRunner

from groundwalk.pipeline import Step, steps
from groundwalk.planning import app, estimates
from groundwalk.store import DataRoot, UserError
from groundwalk.store.cores import machine
from groundwalk.store.files import write_json

GPU, CPU = "NVIDIA H200, trained in bfloat16", "x86_64 CPU, 2 threads, trained in float32"


def finish(data: DataRoot, profile: str, scene: str, stage: str, total_s: float, **more: Any) -> Path:
    """A finished stage of so many seconds."""
    folder = data.run(profile, scene, stage)
    folder.mkdir(parents=True)
    made = {"total_seconds": total_s, "peak_memory_mib": 500, "machine": machine(), "seconds": {}}
    write_json(folder / "manifest.json", made | {"inputs": {f"{scene}/import": {}}} | more)
    return folder


def finish_import(data: DataRoot, profile: str, scene: str, frames: int) -> None:
    folder = finish(data, profile, scene, "import", frames / 10, inputs={})
    pd.DataFrame({"frame_id": range(frames)}).to_parquet(folder / "frames.parquet")


def finish_train(data: DataRoot, profile: str, scene: str, device: str, *models: tuple[str, int, float]) -> None:
    """Images of 32 px, and each model's epochs and seconds; a second for all else."""
    slowest = max(seconds for _, _, seconds in models)
    folder = finish(data, profile, scene, "train", slowest + 1, seconds={"train": slowest})
    cards = pd.DataFrame(models, columns=["model", "epochs", "train_seconds"])
    cards.assign(crop_px=32, width_px=32, device=device).to_parquet(folder / "models.parquet")


def test_times_and_disk_grow_with_frames_and_come_from_the_profile_where_it_was_run(tmp_path: Path) -> None:
    data = DataRoot(tmp_path)
    for profile, scene, frames, seconds in (("tiny", "a", 50, 20), ("tiny", "b", 150, 100), ("demo", "a", 100, 900)):
        finish_import(data, profile, scene, frames)
        (finish(data, profile, scene, "sfm", seconds) / "database").write_bytes(bytes(frames << 20))
    finish_import(data, "tiny", "killed", 1000)
    finish(data, "tiny", "killed", "sfm", 1, resumed=True)  # the last part alone was timed
    planned = [("tiny", step) for step in (Step("import", "a"), Step("sfm", "a"), Step("sfm", "b"), Step("align", "a"))]
    rows = {row.stage: row for row in estimates(planned, data)}
    assert rows["import"].minutes == pytest.approx(5 / 60) and rows["import"].runs == 1
    sfm = rows["sfm"]
    assert (sfm.runs, sfm.frames, sfm.peak_mib) == (2, 200, 500) and sfm.minutes == pytest.approx(2)
    assert sfm.disk_gib == pytest.approx(200 / 1024, rel=0.01)
    assert sfm.by == f"2 of profile tiny, 200 frames, {machine()}"
    assert rows["align"].minutes is None and rows["align"].by == "not measured"
    # A profile that wasn't run goes by another one, which is named: the one of which there are most runs.
    (other,) = estimates([("standard", Step("sfm", "b"))], data)
    assert "2 of profile tiny" in other.by and other.minutes == pytest.approx(1.5)


def test_training_grows_with_epochs_and_pixels_and_is_gpu_time_on_a_gpu_alone(tmp_path: Path) -> None:
    data, train = DataRoot(tmp_path), [("tiny", Step("train", "a"))]
    finish_import(data, "tiny", "a", 100)
    finish_train(data, "demo", "a", CPU, ("PN", 4, 40.0), ("MS-T", 4, 80.0))
    finish_import(data, "demo", "a", 50)
    (row,) = estimates(train, data)
    # Two epochs of twice as many frames are as much; the slowest model counts, and all else doubles.
    assert row.minutes == pytest.approx((80 + 2) / 60) and row.gpu_hours is None
    finish_train(data, "paper", "a", GPU, ("PN", 300, 900.0), ("MS-T", 600, 1800.0))
    finish_import(data, "paper", "a", 100)
    (row,) = estimates(train, data)
    assert row.gpu_hours == pytest.approx((6 + 1) / 3600) and row.by.endswith("NVIDIA H200")
    (data.root / "profiles").mkdir()
    (data.root / "profiles" / "mine.toml").write_text('[train]\nmodels = ["PN-Lite"]\n')
    (row,) = estimates([("mine", Step("train", "a"))], data)
    assert row.minutes is None


def test_the_papers_scenes_have_the_frames_that_would_be_simulated(tmp_path: Path) -> None:
    data = DataRoot(tmp_path)
    finish_import(data, "tiny", "Church", 30)
    finish_train(data, "tiny", "Church", CPU, ("MS-T", 2, 5.0))
    rows = {row.stage: row for row in estimates([("paper", step) for step in steps(data, "paper", "paper")], data)}
    assert rows["import"].runs == 6 and (rows["train"].frames or 0) > 3 * (1643 + 853)
    said = CliRunner().invoke(app, ["--data", str(tmp_path)], catch_exceptions=False).output
    assert "(2) 1 of profile tiny, 30 frames" in said and "The sums lack paper/simulate, paper/sfm" in said


def test_a_capture_must_be_imported_to_be_counted_and_no_run_is_a_refusal(tmp_path: Path) -> None:
    (table := tmp_path / "scenes.csv").write_text("scene,until\nmine,import\n")
    arguments = [str(table), "--profile", "tiny", "--data", str(tmp_path)]
    with pytest.raises(UserError, match=r"no finished run[\s\S]*groundwalk run"):
        CliRunner().invoke(app, arguments, catch_exceptions=False)
    finish_import(DataRoot(tmp_path), "tiny", "other", 10)
    said = CliRunner().invoke(app, arguments, catch_exceptions=False).output
    assert "import first, to count: mine" in said and re.search("sum( +–){4}", said)


def test_captures_that_a_table_names_are_not_those_of_earlier_runs_until_they_are_imported(tmp_path: Path) -> None:
    """The column was ignored: a real church was planned as the simulated one."""
    data, walks = DataRoot(tmp_path / "data"), tmp_path / "walks"
    (walks / "church").mkdir(parents=True)
    finish_import(data, "tiny", "Library", 10)
    (table := tmp_path / "scenes.csv").write_text(
        "scene,captures,until\nChurch,walks/church,import\nLibrary,s3://walks/library,import\n"
    )

    def said() -> str:
        arguments = [str(table), "--profile", "tiny", "--data", str(data.root)]
        return CliRunner().invoke(app, arguments, catch_exceptions=False).output

    assert "import first, to count: Church, Library" in said() and "simulate" not in said()
    assert not data.captures("Church").exists() and not (data.root / "downloads").exists()
    for scene, folder in (("Church", walks / "church"), ("Library", data.root / "downloads" / "Library")):
        folder.mkdir(parents=True, exist_ok=True)
        (folder / "walk.mp4").touch()
        data.captures(scene).parent.mkdir(exist_ok=True)
        data.captures(scene).symlink_to(folder)
    finish_import(data, "tiny", "Church", 30)
    assert re.search("tiny +import +.1. +2 +40", said())
