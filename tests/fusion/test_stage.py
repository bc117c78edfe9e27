"""The stage itself: a scene, and a group whose own predictions replace its members'."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from groundwalk.fusion.definition import STAGE, FuseSettings
from groundwalk.store import DataRoot, StageRun, UserError
from groundwalk.store.schemas import schema
from groundwalk.store.tables import read_table
from tests.fusion.tables import tables


class Inputs(StageRun):
    """A stage run whose inputs are tables in memory: {(stage, scene): table}."""

    tables: dict[tuple[str, str], pd.DataFrame]

    def read(self, stage: str, table: str, scene: str | None = None) -> pd.DataFrame:
        rows = self.tables[stage, scene or self.scene.name]
        return rows[["model"]].drop_duplicates().assign(file="weights.pt") if table == "models" else rows


def stage_run(tmp_path: Path, scene: str, inputs: dict[tuple[str, str], pd.DataFrame]) -> Inputs:
    data = DataRoot(tmp_path)
    config, _ = data.scene(scene)
    work = tmp_path / "work"
    work.mkdir()
    r = Inputs(STAGE, config, "tiny", FuseSettings(), 0, data, True, work)
    r.tables = inputs
    return r


def scene_inputs(
    scene: str, seeds: list[int], models: tuple[str, ...], localisers: tuple[str, ...] = ()
) -> dict[tuple[str, str], pd.DataFrame]:
    """Localisers' predictions are the true poses, but for every fourth frame, which they refuse."""
    frames, truth, predictions = tables(seeds, models)
    # Their files are gone.
    frames = frames.assign(image="gone/" + frames["frame_id"] + ".jpg", gravity_x=0.0, gravity_y=1.0)
    refused = np.arange(len(truth)) % 4 == 0
    poses = [column for column in truth.columns if column.startswith("map_cam")]
    said = truth.assign(
        scene=scene, refusal=np.array(["few_matches" if none else None for none in refused], dtype=object)
    )
    said.loc[refused, poses] = np.nan
    localised = [said.assign(model=model) for model in localisers] or [said[:0].assign(model="")]
    return {
        ("import", scene): frames,
        ("align", scene): truth,
        ("localise", scene): pd.concat(localised),
        ("train", scene): predictions.assign(scene=scene, inference_ms=1.0),
    }


@pytest.fixture
def group(tmp_path: Path) -> Path:
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "Both.toml").write_text('members = ["A", "B"]\nstages = ["train", "fuse"]\n')
    return tmp_path


def test_a_group_uses_its_own_models_and_its_members_others(group: Path) -> None:
    inputs = scene_inputs("A", [1], ("PN", "MS-T")) | scene_inputs("B", [2], ("PN", "MS-T"))
    shared = [inputs["train", scene].query("model == 'MS-T'").assign(map_cam_tx=500.0) for scene in "AB"]
    r = stage_run(group, "Both", inputs | {("train", "Both"): pd.concat(shared)})
    STAGE.run(r)
    errors = read_table(r.work / "errors.parquet", schema("fuse", "errors"))
    assert set(errors["scene"]) == {"A", "B"} and not errors.duplicated(["method", "model", "frame_id"]).any()
    worst = errors.groupby("model")["raw_position_m"].median()
    assert worst["PN"] < 10 and worst["MS-T"] > 100


def test_a_scene_gets_all_tables_structure_localisers_are_fused_and_their_refusals_fail(tmp_path: Path) -> None:
    inputs = scene_inputs("A", [1, 2], ("PN",), ("Map",))
    frames = inputs["import", "A"]
    # A support frame has neither ground truth nor a prediction.
    support = frames.iloc[[0]].assign(frame_id="s1/000900", t_ns=frames["t_ns"].iloc[0] + 1, support=True)
    inputs["import", "A"] = pd.concat([frames, support])
    r = stage_run(tmp_path, "A", inputs)
    STAGE.run(r)
    for table in ("poses", "errors", "signals", "summary", "intervals", "sweep", "sessions", "methods"):
        assert len(read_table(r.work / f"{table}.parquet", schema("fuse", table)))
    assert (r.work / "recording.rrd").is_file() and r.figures["frames"] == 80
    errors = read_table(r.work / "errors.parquet", schema("fuse", "errors"))
    mine = errors[(errors["model"] == "Map") & (errors["method"] == "raw")]
    assert len(mine) == 80 and mine["raw_position_m"].isna().sum() == 20
    assert mine["raw_position_m"].max() < 1e-9
    assert r.figures["predictions_refused"] == 20
    assert r.figures["predictions_not_finite"] == inputs["train", "A"]["map_cam_tx"].isna().sum()
    summary = read_table(r.work / "summary.parquet", schema("fuse", "summary"))
    alone = summary.query("model == 'Map' and method == 'raw' and subset == 'all' and scored == 'method'").iloc[0]
    assert (alone["answered"], alone["frames"], alone["high_pct"]) == (60, 80, 75)
    assert "Map" in set(errors.loc[errors["method"] == "paper_rule", "model"])


def test_a_regressor_and_a_localiser_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="a regressor and a structure localiser are called 'PN'"):
        STAGE.run(stage_run(tmp_path, "A", scene_inputs("A", [1], ("PN",), ("PN",))))
