import json
import re
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import pytest
import torch

from groundwalk.store import DataRoot, StageRun, UserError, execute
from groundwalk.store.files import write_json
from groundwalk.store.images import read_image
from groundwalk.store.manifests import load_manifest, output_hashes
from groundwalk.store.resizing import pinhole_image
from groundwalk.store.schemas import schema
from groundwalk.store.tables import camera_of, dataset_frames, pose_frame, read_table, write_table
from groundwalk.training import inputs
from groundwalk.training.build import load_trained
from groundwalk.training.data import normalised, to_tensor
from groundwalk.training.definition import STAGE
from groundwalk.training.settings import TrainSettings

SMALL = [
    "resize=40",
    "crop=32",
    "device=cpu",
    "threads=1",
    "regressors.PN.epochs=1",
    "regressors.PN.weights=scratch",
    "regressors.MS-T.epochs=1",
    "regressors.MS-T.weights=scratch",
    "regressors.MS-T.layers=1",
]
MakeScene = Callable[..., Path]


def table(folder: Path, name: str) -> pd.DataFrame:
    return pd.read_parquet(folder / f"{name}.parquet")


def test_the_stage_predicts_every_frame_and_says_what_it_trained(
    make_scene: MakeScene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inputs, "_HELD_OUT", 0.45)
    data = make_scene()
    folder = execute(STAGE, "Wall", "tiny", DataRoot(data), SMALL)
    predictions, cards, history = (table(folder, name) for name in ("predictions", "models", "history"))
    frames = dataset_frames(pd.read_parquet(data / "runs/tiny/Wall/import/frames.parquet"))
    for model in ("PN", "MS-T"):
        mine = predictions[predictions["model"] == model]
        assert sorted(mine["frame_id"]) == sorted(frames["frame_id"])
        assert set(mine["split"]) == {"train", "val", "test"}
        assert (mine["inference_ms"] > 0).all()
        assert mine["covariance"].isna().all()
    assert cards["model"].tolist() == ["PN", "MS-T"]
    assert cards["weights"].tolist() == ["scratch", "scratch"]
    assert cards["reduced"][1] == "crop 32 instead of 224, epochs 1 instead of 600, layers 1 instead of 6"
    assert cards["train_frames"].tolist() == [6, 6] and cards["val_frames"].tolist() == [4, 4]
    assert json.loads(cards["config"][1])["layers"] == 1
    assert "1 encoder and 1 decoder" in cards["layers"][1]
    assert history.groupby("model")["selected"].sum().tolist() == [1, 1]
    figures = load_manifest(folder)["figures"]
    assert figures["mean-pose Wall test median position_m"] > 0
    assert (folder / "recording.rrd").stat().st_size > 1000

    # The weights file alone gives the same poses again.
    trained = load_trained(folder / "weights" / "PN.pt")
    mine = predictions[(predictions["model"] == "PN") & (predictions["frame_id"] == "later/000000")]
    camera = camera_of(frames.iloc[0])
    focal = camera.fx / camera.height
    assert trained.focal_px == cards["focal_px"][0] == pytest.approx(focal * 40)
    small = pinhole_image(read_image(data / "captures/Wall/later-0.png"), camera, 40, focal)
    image = to_tensor([small[4:36, 10:42]], torch.device("cpu"))
    position = mine[["map_cam_tx", "map_cam_ty", "map_cam_tz"]].to_numpy()
    with torch.no_grad():
        poses = trained.model(normalised(image))
    assert poses.position_B3.numpy() == pytest.approx(position, abs=1e-5)


def test_errors_in_a_map_without_metric_scale_are_not_given_in_metres(
    make_scene: MakeScene, capsys: pytest.CaptureFixture[str]
) -> None:
    data = make_scene()
    path, of = data / "runs/tiny/Wall/align/ground_truth.parquet", schema("align", "ground_truth")
    write_table(path, read_table(path, of).assign(scale_source="none"), of)
    manifest = path.parent / "manifest.json"
    write_json(manifest, load_manifest(path.parent) | {"outputs": output_hashes(path.parent)})
    frames = pd.read_parquet(data / "runs/tiny/Wall/import/frames.parquet")
    pose = pose_frame("map_cam", np.tile(np.eye(4), (len(frames), 1, 1)))
    pose.assign(model="mine", frame_id=frames["frame_id"]).to_parquet(data / "mine.parquet")
    settings = ["models=[]", "predictions=['mine.parquet']", "resize=40", "crop=32"]
    execute(STAGE, "Wall", "tiny", DataRoot(data), settings)
    said = capsys.readouterr().err
    assert "warning: Wall: NO METRIC SCALE: positions are in SfM's unit, not in metres" in said
    assert all(re.search(rf"{of} Wall: median [\d.]+ map units, ", said) for of in ("mean-pose", "mine"))


def test_images_that_show_less_than_the_virtual_pinhole_are_counted() -> None:
    frames = pd.DataFrame({"width": 640, "height": 480, "split": "train", "map_cam_tx": 0.0, "fx": [480.0] * 9 + [600]})
    said: list[str] = []
    frames["fy"] = frames["fx"]
    run = cast(StageRun[TrainSettings], SimpleNamespace(say=said.append))
    inputs.warn_of_borders(run, frames, inputs.virtual_focal(frames))
    assert len(said) == 1 and "1 of 10 images have focal lengths over 1.1 times" in said[0]
    inputs.warn_of_borders(run, frames, 600 / 480)
    assert len(said) == 1


def test_a_changed_weights_file_is_another_run() -> None:
    def files(**regressors: dict[str, str]) -> tuple[str, ...]:
        return tuple(STAGE.files(TrainSettings(models=("PN", "PN-Lite"), regressors=regressors)))

    assert files() == files(PN={"weights": "imagenet"}) == ()
    assert files(PN={"weights": "mine.pth"}) == ("mine.pth",)


@pytest.mark.slow
def test_images_are_as_captured_where_the_settings_say_so(make_scene: MakeScene) -> None:
    folder = execute(STAGE, "Wall", "tiny", DataRoot(make_scene()), [*SMALL, "undistort=false", 'models=["PN"]'])
    assert table(folder, "models")["focal_px"].isna().all()
    assert load_trained(folder / "weights" / "PN.pt").focal_px is None


@pytest.mark.slow
def test_a_group_shares_one_transformer(make_scene: MakeScene) -> None:
    data = make_scene("Wall", seed=0)
    make_scene("Other", seed=1)
    (data / "scenes").mkdir()
    (data / "scenes" / "both.toml").write_text('members = ["Wall", "Other"]\nstages = ["train"]\n')
    folder = execute(STAGE, "both", "tiny", DataRoot(data), [*SMALL, "regressors.MS-T.epochs=2"])
    predictions, cards = table(folder, "predictions"), table(folder, "models")
    assert cards["model"].tolist() == ["MS-T"]
    assert cards["scenes"][0].tolist() == ["Wall", "Other"]
    assert predictions["scene"].value_counts().to_dict() == {"Wall": 14, "Other": 14}
    assert set(predictions["picked_scene"]) <= {"Wall", "Other"}
    with pytest.raises(UserError, match="PN holds one scene"):
        execute(STAGE, "both", "tiny", DataRoot(data), [*SMALL, 'models=["PN"]'])


def test_what_a_user_can_get_wrong_is_said(make_scene: MakeScene) -> None:
    data = DataRoot(make_scene(train=1))
    with pytest.raises(UserError, match="too few frames to train on"):
        execute(STAGE, "Wall", "tiny", data, SMALL)
    with pytest.raises(UserError, match="crop 64 is larger than resize 40"):
        execute(STAGE, "Wall", "tiny", data, [*SMALL, "crop=64"])
    (make_scene("Other") / "mine.pth").write_text("no weights")
    with pytest.raises(UserError, match=r"(?s)weights file can't be read.*data/mine\.pth"):
        execute(STAGE, "Other", "tiny", data, [*SMALL, "models=['PN']", "regressors.PN.weights=mine.pth"])
    data = DataRoot(make_scene("Gone"))
    (data.captures("Gone") / "walk-3.png").unlink()
    with pytest.raises(UserError, match=r"walk-3\.png"):
        execute(STAGE, "Gone", "tiny", data, SMALL)
