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


def test_test_frames_without_a_pose_are_infinitely_wrong(
    make_scene: MakeScene, capsys: pytest.CaptureFixture[str]
) -> None:
    data = make_scene()
    rows = written(data)
    tested = rows["frame_id"].str.startswith("later/")
    ours, theirs = (np.flatnonzero(tested & (rows["model"] == name)) for name in ("ours", "theirs"))
    assert len(ours) == 3
    rows.loc[ours[:2], "map_cam_tx"] += [1.0, 2.0]
    rows.loc[theirs[0], "map_cam_tx"] = np.nan
    more = [rows[rows["model"] == "ours"].assign(model=name) for name in ("whole", "elsewhere")]
    more[1].loc[ours[2], "picked_scene"] = "Other"
    pd.concat([rows.drop([ours[2], theirs[1]]), *more]).to_parquet(data / "mine.parquet")
    figures = load_manifest(run(data))["figures"]
    said = capsys.readouterr().err
    assert figures["ours Wall test median position_m"] == pytest.approx(2)
    assert "ours Wall: median 2.00 m, 0.0 deg; 2 of 3 test frames have a pose" in said
    assert figures["theirs Wall test median position_m"] is figures["theirs Wall test median rotation_deg"] is None
    assert "theirs Wall: no median, as half or more have no pose; 1 of 3 test frames have a pose" in said
    assert figures["whole Wall test median position_m"] == pytest.approx(1)
    assert "whole Wall: median 1.00 m, 0.0 deg over 3 test frames" in said
    # A pose in another scene's map is none in this one.
    assert "elsewhere Wall: median 2.00 m, 0.0 deg; 2 of 3 test frames have a pose" in said


def test_a_scene_may_have_test_frames_alone(make_scene: MakeScene) -> None:
    data = make_scene(train=0)
    written(data)
    figures = load_manifest(run(data))["figures"]
    assert figures["ours Wall test median position_m"] == pytest.approx(0, abs=1e-9)
    assert not any(name.startswith("mean-pose") for name in figures)


def test_covariances_are_36_numbers_or_six_rows_of_six(make_scene: MakeScene) -> None:
    data = make_scene()
    matrix = np.arange(36.0).reshape(6, 6)
    for stated in (matrix.ravel().tolist(), matrix.tolist()):
        written(data, covariance=[None, *[stated] * 25])
        covariance = pd.read_parquet(run(data) / "predictions.parquet")["covariance"]
        assert covariance.isna().sum() == 1
        assert np.array_equal(np.stack(covariance.dropna().to_list()), np.tile(np.arange(36), (25, 1)))


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda rows: rows.drop(columns="map_cam_qw"), r"lacks something[\s\S]*no map_cam_qw"),
        (lambda rows: rows.iloc[:0], r"lacks something[\s\S]*no rows"),
        (lambda rows: pd.concat([rows, rows.iloc[:1]]), r"have a frame twice[\s\S]*walk/000000"),
        (lambda rows: rows.assign(map_cam_qx=90.0), r"no quaternions[\s\S]*lengths up to 90"),
        (lambda rows: rows.assign(map_cam_tx="far"), r"no numbers[\s\S]*map_cam_tx"),
        (lambda rows: rows.assign(frame_id="elsewhere/000001").iloc[[0, 13]], r"no prediction of ours is of a frame"),
        (lambda rows: rows.assign(frame_id=range(len(rows))), r"no text[\s\S]*column frame_id[\s\S]*text[\s\S]*int64"),
        (lambda rows: rows.assign(scene=1), r"no text[\s\S]*column scene\n"),
        (lambda rows: rows.assign(picked_scene=0), r"no text[\s\S]*column picked_scene"),
        (lambda rows: rows.assign(inference_ms="12.1"), r"no numbers[\s\S]*column inference_ms[\s\S]*numbers"),
        (lambda rows: rows.assign(covariance="[1, 0]"), r"36 numbers[\s\S]*frame walk/000000[\s\S]*str \[1, 0\]"),
        (lambda rows: rows.assign(covariance=0.2), r"36 numbers[\s\S]*column covariance[\s\S]*float64 0\.2"),
        (lambda rows: rows.assign(covariance=[[1.0] * 9] * len(rows)), r"36 numbers[\s\S]*column covariance"),
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
