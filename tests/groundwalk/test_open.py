"""groundwalk.open: a run's tables, images, poses and points as they were written, and what isn't a run is refused."""

import json
import os
import re
import shutil
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

import groundwalk
from groundwalk import UserError
from groundwalk.store.choices import MapUnit
from groundwalk.store.schemas import schema
from groundwalk.torch_dataset import Item
from tests.groundwalk.made_up_run import FRAMES, LOST, MadeUpRun
from tests.known import put, table_of, written

Make = Callable[..., MadeUpRun]
PROPERTIES = {
    "frames": ("import", "frames"),
    "ground_truth": ("align", "ground_truth"),
    "predictions": ("train", "predictions"),
    "poses": ("fuse", "poses"),
    "errors": ("fuse", "errors"),
    "points": ("sfm", "points"),
    "sessions": ("import", "sessions"),
    "rejects": ("import", "rejects"),
    "checks": ("align", "checks"),
}


def open_place(made: MadeUpRun) -> groundwalk.Run:
    return groundwalk.open("place", profile="tiny", data=made.data.root)


def test_each_property_is_its_table(make_run: Make) -> None:
    made = make_run()
    run = open_place(made)
    for name, (stage, table) in PROPERTIES.items():
        if name not in ("frames", "points", "predictions"):
            expected = pd.read_parquet(made.folder / stage / f"{table}.parquet")
            pd.testing.assert_frame_equal(getattr(run, name), expected)
    assert len(run.frames) == FRAMES and len(run.table("import", "frames")) == FRAMES + 1
    assert (run.scene, run.profile, run.simulated) == ("place", "tiny", False)
    changed = run.errors
    changed["position_m"] = 7.0
    assert (run.errors["position_m"] == 0.5).all()


def test_runs_tables_page_and_what_a_notebook_shows(make_run: Make) -> None:
    made = make_run()
    run = open_place(made)
    tables = run.tables().set_index(["stage", "table"])
    assert tables["rows"]["align", "ground_truth"] == FRAMES and tables["rows"]["fuse", "errors"] == len(run.errors)
    assert set(tables.index.get_level_values("stage")) == set(run.manifests) and (tables["meaning"] != "").all()
    columns = run.columns("fuse", "errors").set_index("name")
    assert list(columns.index) == schema("fuse", "errors").column_names
    assert columns.loc["rotation_deg", "unit"] == "deg" and columns.loc["position_m", "frame"] == "map"
    assert "<pre>scene" in run._repr_html_()
    with pytest.raises(UserError, match="stage report of scene place hasn't been run"):
        _ = run.page
    with pytest.raises(UserError, match="there is no recording to view"):
        run.view()
    report = made.folder / "report"
    manifest = run.manifests["import"] | {"stage": "report", "inputs": {}}
    written(report / "manifest.json", json.dumps(manifest))
    written(report / "verdict.json", '{"verdict": "accepted"}')
    assert open_place(made).page == report / "page.html" and "page.html" in open_place(made)._repr_html_()
    (row,) = groundwalk.runs(made.data.root).to_dict("records")
    assert (row["scene"], row["profile"], row["verdict"], row["simulated"]) == ("place", "tiny", "accepted", False)
    assert row["stages"] == list(open_place(made).manifests) and row["folder"] == made.folder
    assert set(dir(groundwalk)) == {*groundwalk.__all__, "__version__"}
    assert groundwalk.__version__ == version("groundwalk")


def test_predictions_are_those_of_regressors_and_localisers(make_run: Make) -> None:
    made = make_run()
    both = open_place(made).predictions
    assert both.groupby("model", sort=False).size().to_dict() == {"PN": FRAMES, "Map": FRAMES // 2}
    assert both.loc[both["model"] == "PN", ["inliers", "refusal"]].isna().all(axis=None)
    refused = both[both["refusal"].notna()]
    assert refused["reason"].tolist() == ["3 features, 30 needed"] and refused["map_cam_tx"].isna().all()
    shutil.rmtree(made.folder / "train")
    assert set(open_place(made).predictions["model"]) == {"Map"}


def test_poses_are_matrices(make_run: Make) -> None:
    made = make_run()
    truth = open_place(made).ground_truth
    poses = groundwalk.pose_array(truth)
    known = np.arange(FRAMES) != LOST
    np.testing.assert_allclose(poses[known], made.map_T_cam[known], atol=1e-12)
    assert np.isnan(poses[LOST]).all()
    with pytest.raises(UserError, match=r"(?s)no poses 'vio_cam'.*map_cam"):
        groundwalk.pose_array(truth, "vio_cam")


def test_points_are_in_the_map(make_run: Make) -> None:
    """Also along a straight walk, and without the points of a model that isn't in the map."""
    made = make_run("import", "sfm", "align")
    points = open_place(made).points
    np.testing.assert_allclose(points[["x", "y", "z"]], made.points[:-1], atol=1e-9)
    assert len(open_place(made).table("sfm", "points")) == len(made.points)


def test_an_image_is_the_one_that_was_imported(make_run: Make) -> None:
    made = make_run("import")
    run = open_place(made)
    image = run.image("walk-0/000003")
    assert image.dtype == np.uint8 and np.array_equal(image, made.pictures[3])
    with pytest.raises(UserError, match="no frame 'walk-0/000777' in scene place"):
        run.image("walk-0/000777")
    captures = made.data.captures("place")
    shutil.copy(captures / "2.png", captures / "3.png")
    with pytest.raises(UserError, match="isn't the one that was imported"):
        run.image("walk-0/000003")
    (captures / "3.png").unlink()
    with pytest.raises(UserError, match=r"(?s)can't be read.*no such file"):
        run.image("walk-0/000003")


def test_a_torch_dataset_has_the_frames_of_a_split_with_ground_truth(make_run: Make) -> None:
    made = make_run("import", "sfm", "align")
    run = open_place(made)
    assert {split: len(run.torch_dataset(split)) for split in ("train", "val", "test", None)} == {
        "train": 3, "val": 2, "test": 6, None: 11,
    }  # fmt: skip
    items = run.torch_dataset()
    assert items.frame_ids == ["walk-0/000000", "walk-0/000001", "walk-0/000002"]
    item = items[1]
    assert np.array_equal(item["image"].numpy().transpose(1, 2, 0), made.pictures[1])
    np.testing.assert_allclose(item["map_T_cam"], made.map_T_cam[1], atol=1e-6)
    assert item["K"].tolist() == [[31, 0, 16], [0, 31, 12], [0, 0, 1]]  # the camera that goes with the ground truth
    torch.testing.assert_close(item["distortion"], torch.tensor([0.1, -0.2, 0, 0, 0, 0, 0, 0]))
    batch = next(iter(torch.utils.data.DataLoader(items, batch_size=3)))
    assert batch["image"].shape == (3, 3, 24, 32) and batch["frame_id"] == items.frame_ids
    halved = run.torch_dataset("test", lambda item: {**item, "image": item["image"][:, ::2, ::2]})
    assert halved[0]["image"].shape == (3, 12, 16)

    def scaled(item: Item) -> Item:
        item["map_T_cam"][:3, 3] /= 10
        return item

    in_place = run.torch_dataset("train", scaled)
    first, second = (in_place[1]["map_T_cam"].clone() for _ in range(2))
    assert torch.equal(first, second) and not torch.equal(first, items[1]["map_T_cam"])
    with pytest.raises(UserError, match="no split 'training'"):
        run.torch_dataset("training")


def test_a_summary_says_what_there_is(make_run: Make) -> None:
    made = make_run()
    text = open_place(made).summary()
    assert "real captures" in text and "SIMULATED" not in text
    assert "12: 4 train, 2 val, 6 test" in text
    assert "11 of 12 frames (A 11); scale by vio; vertical by gravity" in text
    assert "median 0.50 m, 2.0 deg; 6 of 6 test frames" in text
    assert "median infinite, infinite; 2 of 6 test frames" in text
    assert "not finished: report" in text
    for stage in made.folder.glob("*/manifest.json"):
        stage.write_text(stage.read_text().replace('"simulated": false', '"simulated": true'))
    assert "SIMULATED captures" in open_place(made).summary()


def test_a_summary_of_what_has_no_vio_no_scale_or_other_splits(make_run: Make) -> None:
    made = make_run()

    def rewritten(stage: str, table: str, change: Callable[[pd.DataFrame], pd.DataFrame]) -> str:
        put(made.data, "place", stage, table, change(table_of(made.data, "place", stage, table)))
        return open_place(made).summary()

    text = rewritten("import", "sessions", lambda s: s.assign(pose_source="reference", clock="name_order"))
    assert re.search(r"^sessions +2; no VIO: nothing is fused$", text, re.MULTILINE) and "of VIO path" not in text
    text = rewritten("import", "sessions", lambda s: s.assign(pose_source=["reference", "vio"]))
    assert "of VIO path; no VIO in 1 of them" in text
    text = rewritten("fuse", "summary", lambda s: s.assign(map_unit=MapUnit.SFM))
    assert "median 0.50 map units, 2.0 deg" in text
    text = rewritten("fuse", "summary", lambda s: s.assign(position_median_m=0.004, rotation_median_deg=0.02))
    assert "median 0.004 map units, 0.020 deg" in text
    text = rewritten("fuse", "errors", lambda e: pd.concat([e.assign(split="val"), e]))
    assert "6 of 6 val and test frames have a pose" in text


def test_a_run_is_opened_by_its_folder(make_run: Make, tmp_path: Path) -> None:
    made = make_run("import")
    assert groundwalk.open(made.folder).image("walk-0/000001").shape == (24, 32, 3)
    assert groundwalk.open(os.path.relpath(made.folder)).captures == made.data.captures("place")
    moved = shutil.copytree(made.folder, tmp_path / "moved")
    run = groundwalk.open(moved, data=tmp_path / "elsewhere")
    assert len(run.frames) == FRAMES
    with pytest.raises(UserError, match=r"(?s)captures of scene place aren't beside its run.*data="):
        run.image("walk-0/000001")
    assert groundwalk.open(moved, data=made.data.root).image("walk-0/000001").shape == (24, 32, 3)
    as_before = shutil.copytree(made.folder, tmp_path / "copied" / "runs" / "tiny" / "place")
    assert groundwalk.open(as_before, data=made.data.root).image("walk-0/000001").shape == (24, 32, 3)


def test_a_missing_run_is_said_with_those_that_are_there(make_run: Make, tmp_path: Path) -> None:
    made = make_run("import")
    with pytest.raises(
        UserError, match=r"(?s)no run of profile demo.*found: +place of profile tiny.*or name the profile"
    ):
        groundwalk.open("place", data=made.data.root)
    with pytest.raises(UserError, match=r"(?s)scene Office has no run.*found: +nothing"):
        groundwalk.open("Office", profile="tiny", data=tmp_path / "nothing")
    with pytest.raises(UserError, match="there is no run"):
        groundwalk.open(tmp_path / "nothing")


def test_a_stage_that_is_not_finished_is_named(make_run: Make) -> None:
    made = make_run("import")
    run = open_place(made)
    with pytest.raises(
        UserError, match=r"(?s)stage align of scene place hasn't been run.*run --scene place .* align --data"
    ):
        _ = run.ground_truth
    (made.folder / ".align.partial").mkdir()
    with pytest.raises(UserError, match="stage align of scene place has begun but not finished"):
        _ = run.ground_truth
    shutil.move(made.folder / "import", made.folder / ".import.partial")
    with pytest.raises(UserError, match="stage import of scene place has begun but not finished"):
        open_place(made)
    for stage, table in (("mapping", "images"), ("sfm", "pictures")):
        with pytest.raises(UserError, match="expected"):
            run.table(stage, table)


def test_a_foreign_folder_is_refused_and_left_as_it_is(make_run: Make, tmp_path: Path) -> None:
    (tmp_path / "foreign" / "import").mkdir(parents=True)
    with pytest.raises(UserError, match=r"(?s)isn't the folder of a run.*found:.*import"):
        groundwalk.open(tmp_path / "foreign")
    for content in ("{", "[]", '{"outputs": {}, "simulated": true}', '{"stage": "import"}'):
        manifest = written(tmp_path / "foreign" / "import" / "manifest.json", content)
        with pytest.raises(UserError, match="manifest is damaged, or of another program"):
            groundwalk.open(tmp_path / "foreign")
        assert manifest.read_text() == content
    made = make_run("import")
    with pytest.raises(UserError, match=r"(?s)folder of one stage.*place'"):
        groundwalk.open(made.folder / "import")


def test_stages_that_do_not_belong_together_are_not_mixed(make_run: Make) -> None:
    made = make_run()
    opened = open_place(made)
    made.suffix = "-again"
    made.run("import")
    with pytest.raises(UserError, match="stage import was run again after this run was opened"):
        _ = opened.frames
    run = open_place(made)
    assert run.frames["frame_id"].str.contains("again").all()
    for table in ("ground_truth", "predictions", "errors"):
        with pytest.raises(UserError, match=r"(?s)is outdated: import of scene place was run again since.*run --scene"):
            getattr(run, table)
    assert "outdated: import of scene place" in run.summary()


def test_a_group_names_its_scenes(make_run: Make) -> None:
    made = make_run("import", "sfm", "align", "train")
    group = made.data.run("tiny", "two")
    shutil.copytree(made.folder / "train", group / "train")
    manifest = group / "train" / "manifest.json"
    content = json.loads(manifest.read_text())
    content["scene"] |= {"name": "two", "members": ["place"], "stages": ["train", "fuse", "report"]}
    manifest.write_text(json.dumps(content))
    run = groundwalk.open("two", profile="tiny", data=made.data.root)
    assert len(run.predictions) == FRAMES
    with pytest.raises(UserError, match=r"(?s)two is a group of scenes and has no stage import.*its scenes: place"):
        _ = run.frames
    made.suffix = "-again"
    made.run("import", "sfm", "align")
    with pytest.raises(UserError, match="outdated: import of scene place"):
        _ = groundwalk.open("two", profile="tiny", data=made.data.root).predictions
