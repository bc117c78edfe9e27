"""The whole pipeline as a user runs it: on a simulated scene, on a group of scenes, and on the real chair."""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path

import pandas as pd
import pytest

from groundwalk.store.settings import STAGES

pytestmark = pytest.mark.slow


def command_of(stage: str, scene: str, data: Path) -> list[str]:
    return [sys.executable, "-m", "groundwalk", stage, "--scene", scene, "--profile", "tiny", "--data", str(data)]


def run(stage: str, scene: str, data: Path) -> str:
    """Run a stage as its own process; what it says on standard error."""
    command = command_of(stage, scene, data)
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, f"{stage}: {done.stderr[-3000:]}"
    return done.stderr


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("data")


def run_all(scene: str, data: Path) -> dict[str, dict]:
    """Run every stage of a scene; the manifests by stage."""
    manifests = {}
    for stage in STAGES:
        run(stage, scene, data)
        manifests[stage] = json.loads((data / "runs/tiny" / scene / stage / "manifest.json").read_text())
    return manifests


@pytest.fixture(scope="module")
def finished(data: Path) -> Callable[[str], dict[str, dict]]:
    """Simulates a scene and runs all its stages, once for all tests; gives the manifests by stage."""

    @cache
    def finish(scene: str) -> dict[str, dict]:
        run("simulate", scene, data)
        return run_all(scene, data)

    return finish


@pytest.mark.parametrize("scene", ["Church", "Square"])
def test_simulated_scene_runs_to_the_end_and_then_has_nothing_to_do(
    scene: str, data: Path, finished: Callable[[str], dict[str, dict]]
) -> None:
    manifests = finished(scene)
    assert all(manifest["simulated"] for manifest in manifests.values())
    folder = data / "runs/tiny" / scene
    for stage in STAGES:
        assert stage == "report" or (folder / stage / "recording.rrd").stat().st_size > 1000
        assert "up to date" in run(stage, scene, data)
    page = (folder / "report" / "page.html").read_text(encoding="utf-8")
    assert "imulated" in page
    truth = pd.read_parquet(folder / "align" / "ground_truth.parquet")
    assert (truth.quality != "none").mean() > 0.5  # walks of ten seconds overlap little


def test_a_group_trains_one_model_for_its_scenes(data: Path, finished: Callable[[str], dict[str, dict]]) -> None:
    for scene in ("Church", "Square"):
        finished(scene)
    (data / "scenes").mkdir(exist_ok=True)
    (data / "scenes" / "two.toml").write_text(
        'environment = "outdoor"\nmembers = ["Church", "Square"]\nstages = ["train", "fuse", "report"]\n'
    )
    for stage in ("train", "fuse", "report"):
        run(stage, "two", data)
    predictions = pd.read_parquet(data / "runs/tiny/two/train/predictions.parquet")
    assert set(predictions.model) == {"MS-T"}
    assert set(predictions.scene) == {"Church", "Square"}
    errors = pd.read_parquet(data / "runs/tiny/two/fuse/errors.parquet")
    assert set(errors.model) == {"PN", "MS-T", "Map", "HLoc"}
    assert set(errors.scene) == {"Church", "Square"}


def test_real_chair(data: Path, shared_captures: Path) -> None:
    (data / "captures").mkdir(exist_ok=True)
    (data / "captures" / "chair").symlink_to(shared_captures / "chair")
    manifests = run_all("chair", data)
    assert not any(manifest["simulated"] for manifest in manifests.values())
    images = pd.read_parquet(data / "runs/tiny/chair/sfm/images.parquet")
    assert len(images) == 24 and images.registered.all()
    sessions = pd.read_parquet(data / "runs/tiny/chair/align/sessions.parquet")
    assert sessions.sim3_position_rms_m.max() <= 0.010
    assert sessions.sim3_rotation_median_deg.max() <= 1.5
    assert "means nothing" in (data / "runs/tiny/chair/report/page.html").read_text(encoding="utf-8")


def test_a_capture_is_judged(data: Path, tmp_path: Path, finished: Callable[[str], dict[str, dict]]) -> None:
    """From a folder to page and verdict, and again where nothing is left to do."""
    finished("Church")
    command = [sys.executable, "-m", "groundwalk", "judge", str(data / "captures" / "Church"), "--out", str(tmp_path)]
    for _ in range(2):
        done = subprocess.run(command, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr[-3000:]
        verdict = json.loads((tmp_path / "verdict.json").read_text())
        assert verdict["verdict"] == "accepted" and verdict["captures"] == "simulated"
        assert str(tmp_path / "page.html") in done.stdout
    assert done.stderr.count("up to date") == 4


def parquet_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """The tables of an artefact without what is measured in seconds, which no run repeats."""
    timed = ["inference_ms", "cpu_ms", "seconds", "train_seconds", "build_cpu_seconds"]
    return {
        path.stem: pd.read_parquet(path).drop(columns=timed, errors="ignore")
        for path in sorted(folder.glob("*.parquet"))
    }


@pytest.mark.parametrize("stage", STAGES)
def test_killed_stage_ends_in_the_same_tables(
    stage: str, data: Path, finished: Callable[[str], dict[str, dict]], tmp_path: Path
) -> None:
    scene = "Church"
    seconds = finished(scene)[stage]["total_seconds"]
    # The stage under test runs again beside links to what it reads.
    (tmp_path / "captures").mkdir()
    (tmp_path / "captures" / scene).symlink_to(data / "captures" / scene)
    (tmp_path / "runs/tiny" / scene).mkdir(parents=True)
    for other in STAGES:
        if other != stage:
            (tmp_path / "runs/tiny" / scene / other).symlink_to(data / "runs/tiny" / scene / other)
    process = subprocess.Popen(command_of(stage, scene, tmp_path), stderr=subprocess.DEVNULL)
    partial = tmp_path / "runs/tiny" / scene / f".{stage}.partial"
    while not partial.is_dir() and process.poll() is None:
        time.sleep(0.02)
    time.sleep(0.5 * seconds)
    process.kill()
    process.wait()
    assert not (tmp_path / "runs/tiny" / scene / stage).exists(), "the kill came too late to test anything"
    run(stage, scene, tmp_path)
    expected, found = (
        parquet_tables(data / "runs/tiny" / scene / stage),
        parquet_tables(tmp_path / "runs/tiny" / scene / stage),
    )
    assert expected.keys() == found.keys()
    for name in expected:
        pd.testing.assert_frame_equal(found[name], expected[name], check_exact=True, obj=f"{stage}.{name}")
