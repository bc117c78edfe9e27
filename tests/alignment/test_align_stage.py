"""The stage from import's and SfM's artefacts to its own, and the check against true poses."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

from alignment.__main__ import app
from alignment.check_truth import compare_with_truth
from alignment.stage import STAGE
from artefacts import DataRoot, execute
from artefacts.schemas import schema, stage_tables
from artefacts.stage import load_manifest, write_json
from artefacts.tables import pose_frame, read_table, write_table
from geometry.poses import make_pose, yaw_rotation


def write_artefact(data: DataRoot, stage: str, tables: dict[str, pd.DataFrame]) -> None:
    folder = data.run("tiny", "Place", stage)
    folder.mkdir(parents=True)
    for name, table in tables.items():
        write_table(folder / f"{name}.parquet", table, schema(stage, name))
    write_json(folder / "manifest.json", {"outputs": {}, "simulated": True})


def filled(table: pd.DataFrame, stage: str, name: str, **values) -> pd.DataFrame:
    """The table with the columns that the schema asks for; those that this stage doesn't read get a plain value."""
    plain = {"float64": 0.5, "int64": 1, "string": "", "bool": False, "list<float64>": [], "list<string>": []}
    missing = {c.name: c for c in schema(stage, name).columns if c.name not in table}
    extra = {k: values.get(k, plain[c.dtype]) for k, c in missing.items()}
    return table.assign(**{k: [v] * len(table) if isinstance(v, list) else v for k, v in extra.items()})


@pytest.fixture
def data(walks, tmp_path: Path) -> DataRoot:
    """Artefacts of two synthetic walks, and their true poses."""
    scene = walks.make(sessions=2, frames=20, sfm_m=0.005, sfm_deg=0.02, drift_m=0.005)
    root = DataRoot(tmp_path)
    frames = filled(scene.frames, "import", "frames", width=1920, height=1440, cx=960.0, cy=720.0, fy=1400.0)
    names = pd.DataFrame({"session_id": list(scene.recordings), "recording": list(scene.recordings)})
    jumps = scene.jumps.assign(dt_s=0.1, splits=False).astype({"t_ns": "int64", "splits": bool})
    write_artefact(
        root,
        "import",
        {"frames": frames, "sessions": filled(names, "import", "sessions"), "jumps": jumps},
    )
    points = pd.DataFrame(np.random.default_rng(0).normal(size=(50, 3)), columns=["x", "y", "z"])
    write_artefact(
        root,
        "sfm",
        {"images": filled(scene.images, "sfm", "images"), "points": filled(points, "sfm", "points", r=200)},
    )
    truth = pd.concat([scene.frames[["session_id", "t_ns"]], pose_frame("map_cam", scene.true_T_cam)], axis=1)
    root.captures("Place").mkdir(parents=True)
    write_table(root.captures("Place") / "true_poses.parquet", truth, schema("simulate", "true_poses"))
    return root


def test_the_stage_writes_what_its_schemas_say(data: DataRoot) -> None:
    folder = execute(STAGE, "Place", "tiny", data)
    tables = {t.name: read_table(folder / f"{t.name}.parquet", t) for t in stage_tables("align")}
    assert len(tables["ground_truth"]) == 40 and len(tables["residuals"]) == 40
    assert set(tables["drift"]["session_id"]) == {"walk0", "walk1", "all"}
    assert (folder / "recording.rrd").stat().st_size > 10_000
    figures = load_manifest(folder)["figures"]
    assert figures["registered"] == 40 and figures["checks_failed"] == 0
    before = (folder / "ground_truth.parquet").read_bytes()
    execute(STAGE, "Place", "tiny", data, force=True)
    assert (folder / "ground_truth.parquet").read_bytes() == before
    json.dumps(figures, allow_nan=False)


def test_check_truth_prints_its_targets_and_says_what_is_missed(data: DataRoot) -> None:
    execute(STAGE, "Place", "tiny", data)
    arguments = ["check-truth", "--scene", "Place", "--profile", "tiny", "--data", str(data.root)]
    good = CliRunner().invoke(app, arguments)
    assert good.exit_code == 0, good.output
    assert good.output.count("ok") == 7 and "metric scale error" in good.output

    path = data.run("tiny", "Place", "align") / "ground_truth.parquet"
    gt = read_table(path, schema("align", "ground_truth"))
    gt["map_cam_tx"] *= 1.02
    gt[["map_cam_ty", "map_cam_tz"]] *= 1.02
    write_table(path, gt, schema("align", "ground_truth"))
    bad = CliRunner().invoke(app, arguments)
    assert bad.exit_code == 1 and bad.output.count("missed") == 1


def test_truth_is_compared_up_to_heading_and_origin_only() -> None:
    rng = np.random.default_rng(2)
    true = make_pose(yaw_rotation(rng.normal(size=50)), rng.normal(0, 10, (50, 3)))
    moved = make_pose(yaw_rotation(2.0), [5.0, -3, 1]) @ true
    found = {t.name: t.found for t in compare_with_truth(moved, true, 100)}
    assert found.pop("frames with ground truth") == 50
    assert max(found.values()) < 1e-5
    tilted = (
        make_pose([[1, 0, 0], [0, np.cos(0.01), -np.sin(0.01)], [0, np.sin(0.01), np.cos(0.01)]], [0, 0, 0]) @ moved
    )
    tilted[:, :3, 3] *= 0.99
    found = {t.name: t.found for t in compare_with_truth(tilted, true, 50)}
    assert found["vertical error"] == pytest.approx(np.degrees(0.01), abs=1e-6)
    assert found["metric scale error"] == pytest.approx(1.0, abs=1e-6)
    assert found["position error, median"] < 1e-6
