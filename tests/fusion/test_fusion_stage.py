"""The stage itself: a scene, and a group whose own predictions replace its members'."""

import json

import pandas as pd
import pytest
from tables import tables

from groundwalk.artefacts import DataRoot, StageRun
from groundwalk.artefacts.schemas import schema
from groundwalk.artefacts.tables import read_table
from groundwalk.fusion.stage import STAGE, FuseSettings


class Inputs(StageRun):
    """A stage run whose inputs are tables in memory: {(stage, scene): table}."""

    tables: dict

    def read(self, stage, table, scene=None):
        rows = self.tables[stage, scene or self.scene.name]
        return rows[["model"]].drop_duplicates().assign(file="weights.pt") if table == "models" else rows


def stage_run(tmp_path, scene, inputs):
    data = DataRoot(tmp_path)
    config, _ = data.scene(scene)
    work = tmp_path / "work"
    work.mkdir()
    r = Inputs(STAGE, config, "tiny", FuseSettings(), 0, data, True, work)
    r.tables = inputs
    return r


def scene_inputs(scene, seeds, models):
    frames, truth, predictions = tables(seeds, models)
    return {
        ("import", scene): frames,
        ("align", scene): truth,
        ("train", scene): predictions.assign(scene=scene, inference_ms=1.0),
    }


@pytest.fixture
def group(tmp_path):
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "Both.toml").write_text('members = ["A", "B"]\nstages = ["train", "fuse"]\n')
    return tmp_path


def test_a_scene_gets_all_tables_and_a_recording(tmp_path):
    inputs = scene_inputs("A", [1, 2], ("PN",))
    frames = inputs["import", "A"]
    # A support frame has neither ground truth nor a prediction.
    support = frames.iloc[[0]].assign(frame_id="s1/000900", t_ns=frames["t_ns"].iloc[0] + 1, support=True)
    inputs["import", "A"] = pd.concat([frames, support])
    r = stage_run(tmp_path, "A", inputs)
    STAGE.run(r)
    for table in ("poses", "errors", "signals", "summary", "intervals", "sweep", "sessions", "methods"):
        assert len(read_table(r.work / f"{table}.parquet", schema("fuse", table)))
    assert (r.work / "recording.rrd").is_file()
    assert json.loads(json.dumps(r.figures))["frames"] == 80


def test_a_group_uses_its_own_models_and_its_members_others(group):
    inputs = scene_inputs("A", [1], ("PN", "MS-T")) | scene_inputs("B", [2], ("PN", "MS-T"))
    shared = [inputs["train", scene].query("model == 'MS-T'").assign(map_cam_tx=500.0) for scene in "AB"]
    r = stage_run(group, "Both", inputs | {("train", "Both"): pd.concat(shared)})
    STAGE.run(r)
    errors = read_table(r.work / "errors.parquet", schema("fuse", "errors"))
    assert set(errors["scene"]) == {"A", "B"} and not errors.duplicated(["method", "model", "frame_id"]).any()
    worst = errors.groupby("model")["apr_position_m"].median()
    assert worst["PN"] < 10 and worst["MS-T"] > 100
