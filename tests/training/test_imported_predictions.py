"""Predictions of regressors that were trained elsewhere, out of a file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.manifests import load_manifest
from groundwalk.training.definition import STAGE

MakeScene = Callable[..., Path]
SETTINGS = ["models=[]", "resize=40", "crop=32", "device=cpu", 'predictions="mine.parquet"']


def written(data: Path, **changes: Any) -> pd.DataFrame:
    """Two regressors' predictions of every frame with ground truth: that truth, quaternions of length 2."""
    truth = pd.read_parquet(data / "runs/tiny/Wall/align/ground_truth.parquet")
    poses = [c for c in truth.columns if c.startswith("map_cam_")]
    rows = truth.loc[truth["map_cam_tx"].notna(), ["frame_id", *poses]]
    rows = pd.concat([rows.assign(model="ours"), rows.assign(model="theirs")], ignore_index=True)
    rows[poses[3:]] *= 2
    rows = rows.assign(**changes)
    rows.to_parquet(data / "mine.parquet")
    return rows


def run(data: Path, *more: str) -> Path:
    return execute(STAGE, "Wall", "tiny", DataRoot(data), [*SETTINGS, *more])


def test_a_file_is_as_many_regressors_as_it_names(make_scene: MakeScene) -> None:
    data = make_scene()
    rows = written(data)
    folder = run(data)
    predictions, cards = (pd.read_parquet(folder / f"{name}.parquet") for name in ("predictions", "models"))
    assert cards["model"].tolist() == ["ours", "theirs"] and cards["parameters"].isna().all()
    assert cards["weights"].str.startswith("predictions imported from mine.parquet, sha256 ").all()
    assert len(predictions) == len(rows) == 2 * 13
    assert set(predictions["split"]) == {"train", "val", "test"} and predictions["inference_ms"].isna().all()
    lengths = np.linalg.norm(predictions[[f"map_cam_q{a}" for a in "xyzw"]], axis=1)
    assert lengths == pytest.approx(1)
    figures = load_manifest(folder)["figures"]
    assert figures["ours Wall test median position_m"] == pytest.approx(0, abs=1e-9)
    assert (folder / "recording.rrd").is_file() and not len(pd.read_parquet(folder / "history.parquet"))


def test_rows_that_cannot_be_used_are_counted(make_scene: MakeScene, capsys: pytest.CaptureFixture[str]) -> None:
    data = make_scene()
    rows = written(data)
    rows.loc[0, "frame_id"] = "walk/777777"
    rows.loc[[1, 2], "map_cam_ty"] = [np.nan, np.inf]
    rows.to_parquet(data / "mine.parquet")
    folder = run(data)
    assert pd.read_parquet(folder / "predictions.parquet")["model"].value_counts().to_dict() == {
        "theirs": 13,
        "ours": 10,
    }
    figures = load_manifest(folder)["figures"]
    assert figures["ours predictions left out: unknown"] == 1
    assert figures["ours predictions left out: not_finite"] == 2
    said = capsys.readouterr().err
    assert "1 predictions are of frames that this scene doesn't have" in said
    assert "2 predictions have no finite pose" in said


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda rows: rows.drop(columns="map_cam_qw"), r"lacks something[\s\S]*no map_cam_qw"),
        (lambda rows: rows.iloc[:0], r"lacks something[\s\S]*no rows"),
        (lambda rows: pd.concat([rows, rows.iloc[:1]]), r"have a frame twice[\s\S]*walk/000000"),
        (lambda rows: rows.assign(map_cam_qx=90.0), r"no quaternions[\s\S]*lengths up to 90"),
        (lambda rows: rows.assign(map_cam_tx="far"), r"no numbers[\s\S]*map_cam_tx"),
        (lambda rows: rows.assign(frame_id="elsewhere/000001").iloc[[0, 13]], r"no prediction of ours is of a frame"),
        (lambda rows: rows.assign(model="../up"), r"name can't be used[\s\S]*\.\./up"),
    ],
)
def test_what_a_file_can_get_wrong_is_said(
    make_scene: MakeScene, spoil: Callable[[pd.DataFrame], pd.DataFrame], message: str
) -> None:
    data = make_scene()
    spoil(written(data)).to_parquet(data / "mine.parquet")
    with pytest.raises(UserError, match=message):
        run(data)
    (data / "mine.parquet").write_text("model,frame_id\n")
    with pytest.raises(UserError, match="a table can't be read"):
        run(data)
    assert not (data / "runs/tiny/Wall/train").exists()


def test_names_must_differ(make_scene: MakeScene) -> None:
    data = make_scene()
    written(data, model="PN")
    with pytest.raises(UserError, match="frame twice"):
        run(data)
    rows = written(data).query("model == 'ours'")
    rows.assign(model="PN").to_parquet(data / "mine.parquet")
    with pytest.raises(UserError, match=r"two regressors are called 'PN'[\s\S]*models that are trained here"):
        run(data, 'models=["PN"]')


def test_what_settings_can_get_wrong_is_said(make_scene: MakeScene) -> None:
    data = make_scene()
    message = r"setting 'epoch'[\s\S]*\[train\.regressors\.PN\][\s\S]*one of epochs, batch"
    with pytest.raises(UserError, match=message):
        run(data, "regressors.PN.epoch=1")
    with pytest.raises(UserError, match=r"there is no regressor 'XY'[\s\S]*\[train\] of [^,]*tiny.toml[\s\S]*PN, MS-T"):
        run(data, "regressors.XY.epochs=1")
    with pytest.raises(UserError, match="PN is 3, not a section"):
        run(data, "regressors.PN=3")
    with pytest.raises(UserError, match=r"can't be read[\s\S]*mine\.parquet"):
        run(data)
    with pytest.raises(UserError, match="neither models nor predictions"):
        run(data, "predictions=[]")
