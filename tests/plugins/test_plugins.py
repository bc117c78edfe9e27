"""Packages that add to groundwalk: installed, found by their entry points, and run from import to report and export."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from groundwalk.geometry.poses import make_pose, tq_from_pose
from tests.sfm import textured_room as made

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
COLUMNS = "t_s,image,fx,fy,cx,cy,tx,ty,tz,qx,qy,qz,qw"


def installed(name: str, folder: Path) -> Path:
    """The distribution of that name, built outside the tree and installed into `folder`."""
    source = folder.with_name(f"{folder.name}-source")
    shutil.copytree(HERE / name, source, ignore=shutil.ignore_patterns("__pycache__"))
    options = ["--quiet", "--disable-pip-version-check", "--no-index", "--no-deps", "--no-build-isolation"]
    command = [sys.executable, "-m", "pip", "install", *options, "--target", str(folder), str(source)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture(scope="module")
def packages(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Folders with one working and one broken package."""
    return [installed(name, tmp_path_factory.mktemp("packages") / name) for name in ("example", "broken")]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data folder with two walks in the example package's capture format; one row of them is spoilt."""
    folder = tmp_path_factory.mktemp("data")
    textures = [
        made._texture(float(np.linalg.norm(u)), float(np.linalg.norm(v)), seed)
        for seed, (_, u, v) in enumerate(made._WALLS)
    ]
    vio_T_room = make_pose(np.diag([-1.0, 1.0, -1.0]), [5.0, 0.0, 1.0])
    for session, (count, height_m, distance_m) in {"train": (14, 1.5, 2.6), "test": (10, 1.2, 2.2)}.items():
        walk = folder / "captures" / "Room" / session
        walk.mkdir(parents=True)
        poses = made._walk(count, height_m, distance_m)
        position, quaternion = tq_from_pose(vio_T_room @ poses)
        rows = [COLUMNS]
        for i, pose in enumerate(poses):
            cv2.imwrite(str(walk / f"{i}.jpg"), made._photograph(textures, pose))
            camera = [made.FOCAL_PX, made.FOCAL_PX, made.SIZE_PX[0] / 2, made.SIZE_PX[1] / 2]
            rows.append(",".join(map(str, [100 + i, f"{i}.jpg", *camera, *position[i], *quaternion[i]])))
        rows.append("soon" + rows[-1][3:])
        (walk / "walk.csv").write_text("\n".join(rows) + "\n")
    return folder


def run(packages: list[Path], data: Path, stage: str, *arguments: str, status: int = 0) -> str:
    """Run a stage, or a command of its, or all stages, as a user does; what it says, with its words one space apart."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *map(str, packages)])}
    module = ["groundwalk", "run"] if stage == "all" else [f"groundwalk.{stage}"]
    command = [sys.executable, "-m", *module, *arguments, "--scene", "Room", "--profile", "tiny", "--data", str(data)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, cwd=data)
    assert done.returncode == status, done.stderr[-3000:]
    return " ".join(done.stderr.split())


def configure(data: Path, text: str) -> None:
    (data / "scenes").mkdir(exist_ok=True)
    (data / "scenes" / "Room.toml").write_text(text)


def table(data: Path, stage: str, name: str) -> pd.DataFrame:
    return pd.read_parquet(data / "runs/tiny/Room" / stage / f"{name}.parquet")


EXAMPLE = """
environment = "indoor"

[split]
train = ["train"]
test = ["test"]

[sfm]
retry = false

[localise]
models = ["Map"]

[train]
models = ["mean_colour"]

[train.regressors.mean_colour]
epochs = 2
batch = 4
cells = 3

[fuse]
methods = ["raw", "keep_first"]

[fuse.options.keep_first]
predictions = 2
"""


@pytest.fixture(scope="module")
def finished(packages: list[Path], room: Path) -> tuple[Path, str]:
    """The data folder after all stages with the working package alone, and what they said."""
    configure(room, EXAMPLE)
    return room, run(packages[:1], room, "all")


@pytest.fixture
def data(finished: tuple[Path, str], tmp_path: Path) -> Path:
    """A copy of that data folder."""
    return shutil.copytree(finished[0], tmp_path / "data", symlinks=True)


def test_formats_of_packages_are_used_and_broken_ones_named(packages: list[Path], room: Path, tmp_path: Path) -> None:
    data = shutil.copytree(room, tmp_path / "data", symlinks=True)
    configure(data, EXAMPLE)
    said = run(packages, data, "capture_import")
    assert set(table(data, "import", "sessions")["format"]) == {"walk_csv"}
    assert "package groundwalk-broken 0.3, entry point groundwalk.formats: fails_to_detect" in said
    assert "RuntimeError: no idea" in said


@pytest.mark.slow
def test_a_package_runs_from_import_to_report(packages: list[Path], data: Path, finished: tuple[Path, str]) -> None:
    assert "warning" not in finished[1]

    sessions, rejects = table(data, "import", "sessions"), table(data, "import", "rejects")
    assert set(sessions["format"]) == {"walk_csv"}
    assert rejects["reason"].tolist() == ["t_s is no number"] * 2

    card = table(data, "train", "models").iloc[0]
    assert (card["model"], card["label"], card["weights"]) == ("mean_colour", "mean colour", "scratch")
    assert json.loads(card["config"])["cells"] == 3 and card["parameters"] == 3 * 9 * 8 + 8
    predictions = table(data, "train", "predictions")
    assert len(predictions) == 24 and np.array(predictions["covariance"].tolist()).shape == (24, 36)
    assert table(data, "train", "history")["sx"].isna().all()

    methods = table(data, "fuse", "methods").set_index("method")
    assert methods["label"].to_dict() == {"raw": "predictor alone", "keep_first": "first"}
    assert json.loads(methods["options"]["keep_first"]) == {"predictions": 2}
    poses = table(data, "fuse", "poses").query("method == 'keep_first' and model == 'mean_colour'").sort_values("t_ns")
    alignment = poses[[c for c in poses.columns if c.startswith("map_vio_")]].to_numpy()
    assert len(alignment) == 10 and np.ptp(alignment[1:], axis=0).max() < 1e-12  # kept from the second on

    page = (data / "runs/tiny/Room/report/page.html").read_text()
    assert "mean colour+first" in page and "mean colour, alone" in page
    cells = table(data, "report", "cells")
    assert set(cells.loc[cells["table"] == "IV", "method"]) == {"raw", "keep_first"}
    manifest = json.loads((data / "runs/tiny/Room/train/manifest.json").read_text())
    assert manifest["plugins"] == {"mean_colour": "groundwalk-example 1.0"}

    out = data / "exported"
    run(packages[:1], data, "export", "--format", "poses_csv", "--out", str(out))
    written = pd.read_csv(out / "poses.csv")
    truth = table(data, "align", "ground_truth").set_index("frame_id").loc[written["frame_id"]]
    assert len(written) > 20
    assert written["tx"].to_numpy() == pytest.approx(truth["map_cam_tx"].to_numpy())
    assert all((out / image).is_file() for image in written["image"])


@pytest.mark.slow
def test_a_broken_package_is_named_and_the_rest_goes_on(packages: list[Path], data: Path) -> None:
    train = 'models = ["mean_colour", "wrong_shape", "no_module", "fails_in_training"]'
    methods = 'methods = ["raw", "keep_first", "wrong_covariance"]'
    text = EXAMPLE.replace('models = ["mean_colour"]', train).replace('methods = ["raw", "keep_first"]', methods)
    text += "\n[train.regressors.fails_in_training]\nbatch = 4\n"
    configure(data, text)
    said = {stage: run(packages, data, stage) for stage in ("training", "fusion")}

    def named(stage: str, point: str, reason: str) -> None:
        assert f"package groundwalk-broken 0.3, entry point {point}" in said[stage]
        assert reason in said[stage]

    point = "groundwalk.regressors:"
    named("training", f"{point} no_module", "it can't be imported")
    named("training", f"{point} wrong_shape", "forward's position_B3 is of shape (2, 2), not (2, 3) for 2 images")
    named("training", f"{point} fails_in_training", "the batch is too large for me")
    named("fusion", "groundwalk.fusion_methods: wrong_covariance", "covariance for frame 0 has shape (3, 3)")

    assert set(table(data, "train", "models")["model"]) == {"mean_colour"}
    assert set(table(data, "fuse", "methods")["method"]) == {"raw", "keep_first"}
    figures = json.loads((data / "runs/tiny/Room/train/manifest.json").read_text())["figures"]
    assert len([name for name in figures if name.startswith("left out: ")]) == 3


@pytest.mark.parametrize("file", sorted(HERE.glob("example/**/*.*")), ids=lambda file: file.name)
def test_the_guides_show_the_files_as_they_are(file: Path) -> None:
    if file.suffix not in (".py", ".toml") or file.name == "__init__.py":
        pytest.skip("not shown")
    language = {".py": "python", ".toml": "toml"}[file.suffix]
    shown = f"`{file.relative_to(ROOT)}`:\n\n```{language}\n{file.read_text()}```\n"
    guides = [page.name for page in (ROOT / "docs" / "how-to").glob("*.md") if shown in page.read_text()]
    assert len(guides) == 1, f"no guide shows {file.relative_to(ROOT)} as it is"
