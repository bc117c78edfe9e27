"""The stage from import's and SfM's artefacts to its own, and the check against true poses."""

import json
import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from rerun.chunk import RrdReader
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from typer.testing import CliRunner

from groundwalk.alignment.__main__ import app
from groundwalk.alignment.check_truth import compare_with_bounds
from groundwalk.alignment.definition import STAGE
from groundwalk.alignment.uncertainty import SharedSd, shared_covariance
from groundwalk.geometry.poses import make_pose, yaw_rotation
from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.manifests import load_manifest
from groundwalk.store.schemas import schema, stage_tables
from groundwalk.store.tables import pose_columns, read_table
from tests.known import put, table_of


@pytest.fixture(scope="module")
def aligned(data_of_module: DataRoot) -> DataRoot:
    """The scene Place with import, sfm and align done, for tests that leave it as it is."""
    execute(STAGE, "Place", "tiny", data_of_module)
    return data_of_module


def test_the_stage_writes_what_its_schemas_say(aligned: DataRoot) -> None:
    folder = aligned.run("tiny", "Place", "align")
    tables = {t.name: read_table(folder / f"{t.name}.parquet", t) for t in stage_tables("align")}
    assert len(tables["ground_truth"]) == 40 and len(tables["residuals"]) == 40
    assert set(tables["drift"]["session_id"]) == {"walk0", "walk1", "all"}
    _check_recording(folder / "recording.rrd", tables["ground_truth"])
    assert (folder / "checks.png").read_bytes().startswith(b"\x89PNG")
    figures = load_manifest(folder)["figures"]
    assert figures["registered"] == 40 and figures["checks_failed"] == 0
    before = (folder / "ground_truth.parquet").read_bytes()
    execute(STAGE, "Place", "tiny", aligned, force=True)
    assert (folder / "ground_truth.parquet").read_bytes() == before
    json.dumps(figures, allow_nan=False)


def _check_recording(path: Path, gt: pd.DataFrame) -> None:
    """Each walk's path in ground truth, and the bounds of its positions, lie where the table has them."""
    logged: dict[str, list[tuple[str, list]]] = {}
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        columns = zip(batch.schema.names, (column.to_pylist() for column in batch.columns), strict=True)
        # A path's columns may come in one chunk or in several.
        logged.setdefault(str(chunk.entity_path), []).extend(columns)

    def value(path: str, column: str) -> list:
        return next(values[0] for name, values in logged[path] if name.endswith(column))

    assert {"/map/points/model_0", "/map/vio/walk0/path", "/residuals/position_m/walk1"} <= logged.keys()
    for walk, of_walk in gt.groupby("session_id"):
        (strip,) = value(f"/map/ground_truth/{walk}/path", ":strips")
        np.testing.assert_allclose(strip, of_walk[["map_cam_tx", "map_cam_ty", "map_cam_tz"]], atol=1e-5)
    position = np.stack(list(gt["covariance"])).reshape(-1, 6, 6)[:, 3:, 3:]
    half_sizes = np.sort(value("/map/ground_truth/bounds_95_times_10", ":half_sizes"), axis=1)
    np.testing.assert_allclose(
        half_sizes, 10 * np.sqrt(chi2.ppf(0.95, 3) * np.linalg.eigvalsh(position)), rtol=1e-3, atol=1e-6
    )


def test_a_refused_run_says_where_its_plot_is(data: DataRoot) -> None:
    images, poses = table_of(data, "Place", "sfm", "images"), pose_columns("sfm_cam")
    # All steps in another order than VIO's.
    images[poses] = images[poses].to_numpy()[np.random.default_rng(1).permutation(len(images))]
    put(data, "Place", "sfm", "images", images)
    with pytest.raises(UserError, match="images and poses mismatched") as error:
        execute(STAGE, "Place", "tiny", data)
    plot = Path(str(error.value.details["do"]).removeprefix("look at ").split(";")[0])
    assert plot.name == "checks.png" and plot.read_bytes().startswith(b"\x89PNG")
    checks = read_table(plot.with_name("checks.parquet"), schema("align", "checks"))
    assert "images and poses mismatched" in set(checks["cause"])
    assert not (data.run("tiny", "Place", "align") / "manifest.json").exists()


def test_check_truth_prints_its_targets_and_says_what_is_missed(aligned: DataRoot, tmp_path: Path) -> None:
    shutil.copytree(aligned.root, tmp_path / "data")
    data = DataRoot(tmp_path / "data")
    arguments = ["check-truth", "--scene", "Place", "--profile", "tiny", "--data", str(data.root)]
    good = CliRunner().invoke(app, arguments)
    assert good.exit_code == 0, good.output
    assert good.output.count("ok") == 11 and "metric scale error" in good.output

    gt = table_of(data, "Place", "align", "ground_truth")
    gt[["map_cam_tx", "map_cam_ty", "map_cam_tz"]] *= 1.02
    put(data, "Place", "align", "ground_truth", gt)
    bad = CliRunner().invoke(app, arguments)
    # A map 2 % too large misses the target for scale, and its own 95 % bounds.
    assert bad.exit_code == 1 and bad.output.count("missed") == 2


def test_bounds_hold_where_the_covariance_is_honest_and_only_there() -> None:
    """Errors drawn from the stated covariance, and of twice its size."""
    rng = np.random.default_rng(4)
    true = make_pose(Rotation.random(2000, rng=rng).as_matrix(), rng.normal(0, 10, (2000, 3)))
    mix = rng.normal(size=(2000, 6, 6)) * np.repeat([1e-3, 1e-2], 3)[:, None]
    own = mix @ np.swapaxes(mix, 1, 2)
    shared = SharedSd(0.002, 0.001, 0.003)
    covariance = own + shared_covariance(true, true[:, :3, 3].mean(axis=0), shared)
    for times, low, high in ((1.0, 93.5, 96.5), (2.0, 40.0, 65.0)):
        error = times * np.einsum("nij,nj->ni", mix, rng.normal(size=(2000, 6)))
        rotation = Rotation.from_rotvec(error[:, :3]).as_matrix() @ true[:, :3, :3]
        # What all cameras share is no error of any one of them.
        rotation = rotation @ Rotation.from_rotvec([0.004, -0.003, 0.0]).as_matrix()
        estimated = make_pose(rotation, true[:, :3, 3] + error[:, 3:])
        # Origin and heading are free, and turn the axes that the covariance is given in.
        turn = yaw_rotation(1.0)
        moved = make_pose(turn, [3.0, 0, 1]) @ estimated
        both = np.kron(np.eye(2), turn)
        targets = {t.name: t for t in compare_with_bounds(moved, true, both @ covariance @ both.T, shared)}
        for name in ("position", "rotation"):
            target = targets[f"{name} within 95 % bounds, SfM's part"]
            assert low < target.value < high
            assert target.is_met == (times == 1.0)
