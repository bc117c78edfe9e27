"""The stage: maps of training frames alone, an answer or a refusal for each query, runs that resume."""

import json
import re
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pandas as pd
import pytest

from groundwalk.localisation.definition import STAGE
from groundwalk.localisation.inputs import read_inputs, with_found_focal
from groundwalk.localisation.query import MapLocaliser
from groundwalk.localisation.results import QueryResult
from groundwalk.scoring.errors import position_error, rotation_error_deg
from groundwalk.store import UserError, execute
from groundwalk.store.manifests import load_manifest
from groundwalk.store.schemas import schema
from groundwalk.store.tables import pose_frame, poses_of
from tests.known import put, read_picture, table_of
from tests.localisation.board_scene import COUNT, TEST, VAL, Boards, other_board_picture

SMALL = ["max_features=300", "localisers.Map.max_points=400"]
MakeBoards = Callable[..., Boards]
TIMED = ["inference_ms", "cpu_ms"]


def run(made: Boards, *settings: str) -> dict:
    """Run the stage; its manifest."""
    return load_manifest(execute(STAGE, "Boards", "tiny", made.data, [*SMALL, *settings]))


def of_frame(predictions: pd.DataFrame, row: int, model: str = "Map") -> pd.Series:
    mine = predictions[(predictions["frame_id"] == f"walk/{row:06d}") & (predictions["model"] == model)]
    assert len(mine) == 1
    return mine.iloc[0]


def test_training_frames_move_as_sfm_says(make_boards: MakeBoards) -> None:
    """Where it takes motion at a time offset, too, which its table of images has no other trace of."""
    made = make_boards()
    folder, sfm_T_cam = made.data.run("tiny", "Boards"), made.map_T_cam.copy()
    sfm_T_cam[:, :3, 3] /= 2
    moving = {"readout_s": 0.02, "angular_x": 0.1, "velocity_z": 0.3}
    for stage, name, columns in (
        ("import", "frames", {"first_row": "left"}),
        ("sfm", "images", {**pose_frame("sfm_cam", sfm_T_cam), **moving}),
    ):
        put(made.data, "Boards", stage, name, table_of(made.data, "Boards", stage, name).assign(**columns))
    inputs = read_inputs(folder)
    np.testing.assert_allclose(inputs.views.angular, [[0.1, 0, 0]] * COUNT)
    np.testing.assert_allclose(inputs.views.velocity, [[0, 0, 0.6]] * COUNT)
    assert {camera.first_row for camera in (*inputs.logged, *inputs.views.cameras)} == {"left"}


def test_frames_of_a_guessed_focal_length_are_asked_with_the_training_frames(make_boards: MakeBoards) -> None:
    """Never with their own, which is ground truth; those of another size, or logged, as they were."""
    made = make_boards()
    folder, tested = made.data.run("tiny", "Boards"), np.flatnonzero(TEST)
    frames, truth = (table_of(made.data, "Boards", *name) for name in (("import", "frames"), ("align", "ground_truth")))
    assert with_found_focal(frames, folder) is frames
    truth.loc[tested, ["fx", "fy"]] = 999.0
    put(made.data, "Boards", "align", "ground_truth", truth)
    frames = frames.assign(fx=384.0, fy=384.0, focal_sd=0.5)
    put(made.data, "Boards", "import", "frames", frames)
    mixed = frames.assign(width=np.where(TEST, 640, 320), focal_sd=np.where(VAL, 0.0, 0.5))
    np.testing.assert_array_equal(with_found_focal(mixed, folder)["fy"], np.where(TEST | VAL, 384.0, 300.0))
    run(made, 'models=["Map"]')
    for row in tested.tolist():
        pose = poses_of(of_frame(made.table("predictions"), row).to_frame().T, "map_cam")[0]
        assert position_error(pose, made.map_T_cam[row]) < 0.02


def test_every_query_is_localised_and_what_it_cost_is_said(boards: Boards) -> None:
    manifest = run(boards)
    predictions, models, storage = (boards.table(name) for name in ("predictions", "models", "storage"))
    queries = np.flatnonzero(TEST | VAL).tolist()
    assert models["model"].tolist() == ["Map", "HLoc"]
    for model in models["model"]:
        for row in queries:
            said = of_frame(predictions, row, model)
            pose = poses_of(said.to_frame().T, "map_cam")[0]
            assert position_error(pose, boards.map_T_cam[row]) < 0.02, (model, row)
            assert rotation_error_deg(pose, boards.map_T_cam[row]) < 0.5
            assert said["split"] == ("val" if VAL[row] else "test")
            assert said["scene"] == said["picked_scene"] == "Boards" and pd.isna(said["refusal"])
            assert said["inliers"] >= 10 and said["inference_ms"] > 0
        assert len(predictions[predictions["model"] == model]) == len(queries)
        mine = models[models["model"] == model].iloc[0]
        assert storage.loc[storage["model"] == model, "bytes"].sum() == mine["bytes"] > 1000
        assert mine["train_frames"] == COUNT - len(queries) and mine["points"] >= 100
        assert predictions.loc[predictions["model"] == model, "covariance"].notna().all()
        assert manifest["figures"][f"{model} test refused"] == 0
        assert manifest["figures"][f"{model} test within 0.25 m and 2 deg, %"] == 100
    folder = boards.data.run("tiny", "Boards", "localise")
    assert (folder / "recording.rrd").stat().st_size > 1000
    assert (folder / models["file"][0]).stat().st_size == models["bytes"][0] and models["file"][1] == ""
    assert json.loads(models["config"][0])["max_points"] == 400
    assert {"features", "points", "build Map", "localise HLoc", "recording"} <= set(manifest["seconds"])


def test_the_map_is_the_same_without_the_images_of_other_splits(make_boards: MakeBoards, boards: Boards) -> None:
    run(boards)
    made = make_boards()
    for row in np.flatnonzero(TEST | VAL).tolist():
        cv2.imwrite(str(made.image(row)), np.zeros((240, 320), np.uint8))
    made.note_images()
    run(made, 'models=["Map"]', 'splits=["train"]')
    assert made.map_bytes() == boards.map_bytes()
    made.image(int(np.flatnonzero(TEST)[0])).unlink()
    with pytest.raises(UserError, match="1 of 18 images aren't as import saw them"):
        run(made, 'models=["Map"]', 'splits=["train", "test"]')


def test_bad_images_are_refused_as_rows(make_boards: MakeBoards) -> None:
    made = make_boards()
    black, blurred, elsewhere, whole = np.flatnonzero(TEST)[:4].tolist()
    picture = read_picture(made.image(blurred), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(made.image(black)), np.zeros_like(picture))
    cv2.imwrite(str(made.image(blurred)), cv2.GaussianBlur(picture, (0, 0), 25))
    cv2.imwrite(str(made.image(elsewhere)), other_board_picture(made.map_T_cam[elsewhere]))
    made.note_images()
    figures = run(made)["figures"]
    predictions = made.table("predictions")
    for model in ("Map", "HLoc"):
        for row in (black, blurred, elsewhere):
            said = of_frame(predictions, row, model)
            assert said["refusal"] and said["reason"] and np.isnan(said["map_cam_tx"])
            assert said["covariance"] is None
        assert of_frame(predictions, black, model)["refusal"] == "few_features"
        assert pd.isna(of_frame(predictions, whole, model)["refusal"])
        assert len(of_frame(predictions, whole, model)["covariance"]) == 36
        assert figures[f"{model} test refused"] == 3 and figures[f"{model} test wrong"] == 0


def test_frames_that_levels_leave_out_are_counted(make_boards: MakeBoards, capsys: pytest.CaptureFixture[str]) -> None:
    made = make_boards()
    truth = table_of(made.data, "Boards", "align", "ground_truth")
    tested = np.flatnonzero(TEST)
    truth.loc[tested[:2], "quality"] = "C"
    put(made.data, "Boards", "align", "ground_truth", truth)
    figures = run(made, 'models=["Map"]')["figures"]
    assert figures["Map test frames of quality class C"] == 2
    words = f"100.0 % within 0.25 m and 2 deg of {len(tested) - 2} (2 of quality class C left out)"
    assert words in capsys.readouterr().err


def test_a_killed_run_keeps_its_map_and_ends_in_the_same_tables(
    make_boards: MakeBoards, boards: Boards, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, asked = make_boards(), []

    def killed_at_the_third(self: MapLocaliser, *arguments: Any, **more: Any) -> QueryResult:
        asked.append(more)
        if len(asked) == 3:
            raise KeyboardInterrupt
        return localise(self, *arguments, **more)

    localise = MapLocaliser.localise
    with monkeypatch.context() as patched, pytest.raises(KeyboardInterrupt):
        patched.setattr(MapLocaliser, "localise", killed_at_the_third)
        run(made)
    assert not made.data.run("tiny", "Boards", "localise").exists()
    with monkeypatch.context() as patched:
        patched.setattr("groundwalk.localisation.build.build_map", None)  # the map is there
        assert run(made)["resumed"]
    run(boards)
    assert made.map_bytes() == boards.map_bytes()
    resumed, whole = (b.table("predictions").drop(columns=TIMED) for b in (made, boards))
    pd.testing.assert_frame_equal(resumed, whole)


def test_errors_in_a_map_without_metric_scale_are_not_given_in_metres(
    make_boards: MakeBoards, capsys: pytest.CaptureFixture[str]
) -> None:
    made = make_boards()
    truth = table_of(made.data, "Boards", "align", "ground_truth")
    put(made.data, "Boards", "align", "ground_truth", truth.assign(scale_source="none"))
    figures = run(made, 'models=["Map"]')["figures"]
    assert "Map test median position_m" in figures and not [name for name in figures if "within" in name]
    said = capsys.readouterr().err
    assert "warning: Boards: NO METRIC SCALE: positions are in SfM's unit, not in metres" in said
    assert re.search(r"Map: median [\d.e-]+ map units; 0 of \d+ test frames refused", said)


def test_no_localisers_give_empty_tables(make_boards: MakeBoards) -> None:
    made = make_boards()
    run(made, "models=[]")
    for name in ("predictions", "models", "storage"):
        assert list(made.table(name).columns) == schema("localise", name).column_names and made.table(name).empty


def test_what_a_user_can_get_wrong_is_said(make_boards: MakeBoards) -> None:
    made = make_boards(4)
    with pytest.raises(UserError, match=r"(?s)too few frames to build a map from.*found: +3 of 3"):
        run(made)
    for setting, message in (
        ('models=["Mapp"]', "there is no structure localiser 'Mapp'"),
        ("localisers.HLoc.retreived=3", "retreived"),
        ('splits=["tset"]', "splits"),
        ("localisers.Map=3", "not a section"),
    ):
        with pytest.raises(UserError, match=message):
            run(made, setting)


def test_a_place_without_texture_is_no_map(make_boards: MakeBoards) -> None:
    made = make_boards()
    for row in range(COUNT):
        cv2.imwrite(str(made.image(row)), np.full((240, 320), 128, np.uint8))
    made.note_images()
    with pytest.raises(UserError, match=r"(?s)too few points to localise by.*found: +0 by"):
        run(made)
