"""The whole import stage on small captures, and on the real ones."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from groundwalk.capture_import.inspection import inspect_capture
from groundwalk.geometry.poses import make_pose
from groundwalk.store import UserError
from groundwalk.store.tables import poses_of
from tests.capture_import.capture_writers import (
    HEIGHT,
    WIDTH,
    Walk,
    imported,
    make_walk,
    read_one,
    write_frames_jsonl,
    write_nerfstudio,
    write_scanner_app,
)
from tests.known import read_picture, rows


def test_intrinsics_follow_images_that_were_made_smaller(
    tmp_path: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    walk = make_walk(24)
    write_nerfstudio(place, walk)
    for path in (place / "images").iterdir():
        cv2.imwrite(str(path), cv2.resize(read_picture(path), None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))
    tables = imported(tmp_path)
    frames = tables["frames"]
    assert len(frames) and tables["rejects"].empty and set(frames["width"]) == {WIDTH // 2}
    np.testing.assert_allclose(frames[["fx", "fy", "cx", "cy"]], walk.camera[walk.seen] / 2)
    assert f"their intrinsics for {WIDTH}x{HEIGHT}: scaled" in capsys.readouterr().err


def test_tables_hold_the_walk_as_it_was_and_nothing_personal(tmp_path: Path, place: Path) -> None:
    walks = {"train-1": make_walk(60), "train-2": make_walk(60, seed=1), "test-1": make_walk(60, seed=2)}
    for name, walk in walks.items():
        write_scanner_app(place / name, walk, private=True)
    for name in ("true_poses", "true_cameras"):
        (place / f"{name}.parquet").write_text("never opened")
    tables = imported(tmp_path, "sampling='all'")
    frames = tables["frames"]
    assert len(frames) == 90 and frames["frame_id"].is_unique
    for name, walk in walks.items():
        own = frames[frames["session_id"] == name]
        index = own["frame_id"].str[-6:].astype(int).to_numpy()
        np.testing.assert_allclose(poses_of(own, "vio_cam"), walk.vio_T_cam[index], atol=1e-9)
        np.testing.assert_array_equal(own["t_ns"], walk.t_ns[index])
        np.testing.assert_allclose(own[["fx", "fy", "cx", "cy"]], walk.camera[index])
        assert (own["width"] == WIDTH).all() and (own["height"] == HEIGHT).all()
        vio = tables["vio"][tables["vio"]["session_id"] == name]
        np.testing.assert_allclose(poses_of(vio, "vio_cam"), walk.vio_T_cam, atol=1e-9)
        down = np.einsum("nij,nj->ni", walk.vio_T_cam[index, :3, :3], own[["gravity_x", "gravity_y", "gravity_z"]])
        np.testing.assert_allclose(down, np.tile([0, -1, 0], (len(own), 1)), atol=1e-9)
        path = np.linalg.norm(np.diff(walk.vio_T_cam[:, :3, 3], axis=0), axis=1).sum()
        row = tables["sessions"].set_index("session_id").loc[name]
        assert row["path_m"] == pytest.approx(path) and row["duration_s"] == pytest.approx(5.9)
    by_split = frames.groupby("session_id")["split"].agg(set).to_dict()
    assert by_split == {"train-1": {"train", "val"}, "train-2": {"train", "val"}, "test-1": {"test"}}
    assert tables["rejects"].empty and tables["jumps"].empty
    assert tables.figures["leak_s"] is None
    for path in (tmp_path / "runs").rglob("*"):
        assert path.is_dir() or not any(private in path.read_bytes() for private in (b"latitude", b"48.123456"))
    assert not np.isclose(frames.select_dtypes("number").to_numpy(), 48.123456).any()
    gps = imported(tmp_path, "sampling='all'", "gps=true")["gps"]
    assert len(gps) == 180 and (gps["latitude_deg"] == 48.123456).all() and gps["accuracy_m"].isna().all()
    np.testing.assert_array_equal(gps.loc[gps["recording"] == "train-1", "t_ns"], walks["train-1"].t_ns)


def test_few_frames_are_all_kept_the_leak_is_told_and_inspect_says_so(
    tmp_path: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scanner_app(place / "walk", make_walk(48))
    last = list(inspect_capture(place))[-1].removeprefix("all recordings: ")
    tables = imported(tmp_path)
    assert len(tables["frames"]) == 24
    assert set(tables["frames"]["split"]) == {"train", "val", "test"}
    assert 0 < tables.figures["leak_s"] < 5
    assert last.endswith("all are used") and last.partition(" (")[0] in capsys.readouterr().err


def test_support_frames_are_added_between_frames_that_stay_the_same(tmp_path: Path, place: Path) -> None:
    write_scanner_app(place / "walk", make_walk(201))
    write_scanner_app(place / "xlater", make_walk(101, seed=1))
    alone = imported(tmp_path, "min_frames=0", "max_support_fraction=0")
    tables = imported(tmp_path, "min_frames=0")
    frames, sessions = tables["frames"], tables["sessions"].set_index("session_id")
    dataset, support = frames[~frames["support"]], frames[frames["support"]]
    assert not alone["frames"]["support"].any() and len(support) > 10
    pd.testing.assert_frame_equal(dataset.reset_index(drop=True), alone["frames"])
    figures = tables.figures
    assert (figures["frames"], figures["support_frames"]) == (len(dataset), len(support))
    for session_id, used in frames.groupby("session_id"):
        row = sessions.loc[session_id]
        assert (row["frames"], row["support_frames"]) == ((~used["support"]).sum(), used["support"].sum())
        own = used[~used["support"]]
        for extra in rows(used[used["support"]]):
            assert extra.split == own["split"].iloc[(own["t_ns"] - extra.t_ns).abs().argmin()]


def test_the_same_capture_gives_the_same_bytes_whatever_the_order_of_its_files(tmp_path: Path) -> None:
    written = tmp_path / "one" / "captures" / "place" / "walk"
    write_scanner_app(written, make_walk(201))
    shuffled = tmp_path / "two" / "captures" / "place" / "walk"
    shuffled.mkdir(parents=True)
    for path in np.random.default_rng(0).permutation(sorted(written.iterdir())):
        shutil.copyfile(path, shuffled / path.name)
    one, two = (imported(tmp_path / n, "min_frames=30") for n in ("one", "two"))
    assert one["frames"]["support"].sum() > 5
    tables = {path.name: path.read_bytes() for path in one.folder.glob("*.parquet")}
    assert tables == {path.name: path.read_bytes() for path in two.folder.glob("*.parquet")}


def test_a_broken_row_costs_that_row_and_says_why(tmp_path: Path, place: Path) -> None:
    walk, folder = make_walk(40, every=1), place / "walk"
    write_scanner_app(folder, walk)

    def change(index: int, **values: object) -> None:
        path = folder / f"frame_{index:05d}.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    cut, outside = (folder / "frame_00003.jpg").read_bytes(), tmp_path / "outside.jpg"
    (folder / "frame_00003.jpg").write_bytes(cut[: len(cut) // 2])
    (folder / "frame_00004.json").write_text("{")
    change(5, cameraPoseARFrame=[float("nan")] * 16)
    change(6, cameraPoseARFrame=(1.2 * walk.arkit()[6]).ravel().tolist())
    change(7, intrinsics=[80, 0, 400, 0, 80, 35, 0, 0, 1])
    change(8, time=walk.t_ns[9] * 1e-9)
    change(10, time=1.0)
    (folder / "frame_00011.jpg").write_bytes(b"")
    (folder / "frame_00012.jpg").rename(outside)
    (folder / "frame_00012.jpg").symlink_to(outside)
    (folder / "frame_00099.jpg").write_bytes(cut)
    expected = {
        "frame_00003.json": "image is broken",
        "frame_00004.json": "file isn't JSON",
        "frame_00004.jpg": "no row of the log that can be read names this image",
        "frame_00005.json": "pose has a value that isn't finite",
        "frame_00006.json": "pose isn't rigid",
        "frame_00007.json": "principal point",
        "frame_00008.json": "time is a duplicate",
        "frame_00010.json": "time goes backward",
        "frame_00011.json": "image is empty",
        "frame_00012.json": "image is a link that leads out",
        "frame_00099.jpg": "no row of the log that can be read names this image",
    }
    tables = imported(tmp_path)
    found = dict(zip(tables["rejects"]["source"], tables["rejects"]["reason"], strict=True))
    # Of two rows with the same time either may go.
    found["frame_00008.json"] = found.pop("frame_00008.json", None) or found.pop("frame_00009.json")
    assert found.keys() == expected.keys()
    for source, reason in expected.items():
        assert found[source].startswith(reason)
    assert len(tables["frames"]) == 40 - 9


def test_images_that_cannot_be_trusted_are_rejects(tmp_path: Path, place: Path) -> None:
    folder = place / "walk"
    write_frames_jsonl(folder, make_walk(40, every=1))
    header, *rows = map(json.loads, (folder / "frames.jsonl").read_text().splitlines())
    rows[4]["tracking"] = "lost"
    rows[6]["tracking"] = "limited"
    sharp = read_picture(folder / "images" / "9.jpg")
    cv2.imwrite(str(folder / "images" / "9.jpg"), cv2.blur(sharp, (31, 1)))
    for i in (12, 13):  # the camera stood still, the phone didn't
        shutil.copyfile(folder / "images" / "11.jpg", folder / "images" / f"{i}.jpg")
    rows[34]["vio_T_cam"] = rows[33]["vio_T_cam"]  # here both did
    shutil.copyfile(folder / "images" / "33.jpg", folder / "images" / "34.jpg")
    for i in (15, *range(20, 30)):  # one lacks its pose, then ten in a row do
        del rows[i]["vio_T_cam"]
    (folder / "frames.jsonl").write_text("\n".join(map(json.dumps, [header, *rows])))
    tables = imported(tmp_path, "sampling='all'")
    reasons = dict(zip(tables["rejects"]["t_ns"], tables["rejects"]["reason"], strict=True))
    expected = {4: "not tracking", 9: "too blurred: sharpness"} | dict.fromkeys(range(20, 30), "no pose within 0.5 s")
    expected |= dict.fromkeys((12, 13), "image is that of frames.jsonl line 13 again, while the pose is 0.")
    assert reasons.keys() == {rows[i]["t_ns"] for i in expected}
    for i, reason in expected.items():
        assert reasons[rows[i]["t_ns"]].startswith(reason)
    assert len(tables["frames"]) == 40 - len(expected)
    assert tables["frames"].set_index("t_ns")["tracking"][rows[6]["t_ns"]] == "limited"


def test_a_large_jump_splits_the_session_a_small_one_is_told_and_rejects_name_the_part(
    tmp_path: Path, place: Path
) -> None:
    walk, folder = make_walk(90), place / "walk"
    walk.vio_T_cam[30:, :3, 3] += [0.0, 0.0, 0.2]
    walk.vio_T_cam[60:, :3, 3] += [3.0, 0.0, 0.0]
    write_scanner_app(folder, walk)
    for number in (10, 70):
        (folder / f"frame_{number:05d}.jpg").write_bytes(b"")
    for number in (21, 81):  # the time of the row before, too
        shutil.copyfile(folder / f"frame_{number - 1:05d}.json", folder / f"frame_{number:05d}.json")
    (folder / "frame_00040.json").write_text("[]")
    tables = imported(tmp_path, "sampling='all'")
    jumps, rejects = tables["jumps"], tables["rejects"].sort_values(["session_id", "source"])
    assert jumps["splits"].tolist() == [False, True] and jumps["t_ns"].tolist() == walk.t_ns[[30, 60]].tolist()
    np.testing.assert_allclose(jumps["jump_m"], [0.2, 3.0], atol=0.05)
    assert tables["frames"]["session_id"].value_counts().to_dict() == {"walk": 28, "walk.part2": 14}
    # The three metres of the jump are no part of the walk.
    assert tables["sessions"]["path_m"].sum() < 11
    assert list(zip(rejects["session_id"], rejects["source"], rejects["rejected"].fillna(""), strict=True)) == [
        ("walk", "frame_00010.json", "image"),
        ("walk", "frame_00021.json", "pose"),
        ("walk", "frame_00040.jpg", "image"),
        ("walk", "frame_00040.json", ""),
        ("walk.part2", "frame_00070.json", "image"),
        ("walk.part2", "frame_00081.json", "pose"),
    ]


def test_a_recording_that_cannot_be_used_is_left_out_and_named_and_the_others_go_on(
    tmp_path: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scanner_app(place / "good-1", make_walk(60))
    write_scanner_app(place / "good-2", make_walk(60, seed=1))
    write_scanner_app(place / "empty-log", make_walk(6))
    for path in (place / "empty-log").glob("frame*.json"):
        path.write_bytes(b"")
    write_scanner_app(place / "in-mm", _with(make_walk(60, seed=2), "millimetres"))
    (place / "upload.zip").write_bytes(b"")
    tables = imported(tmp_path)
    assert set(tables["sessions"]["recording"]) == {"good-1", "good-2"}
    left_out = tables["rejects"][tables["rejects"]["rejected"] == "recording"].set_index("session_id")
    words = {"empty-log": "no frame of this recording can be read", "in-mm": "isn't plausible", "upload": "unpacked"}
    assert left_out.index.tolist() == list(words) and tables.figures["recordings_left_out"] == 3
    told = capsys.readouterr().err
    for name, text in words.items():
        assert text in str(left_out.loc[name, "reason"]) and f"warning: {name} is left out: " in told
    unusable: list[str] = []
    lines = list(inspect_capture(place, unusable=unusable))
    assert unusable == list(words) and sum(line.startswith("  status     unusable") for line in lines) == 3
    (tmp_path / "scenes").mkdir()
    (tmp_path / "scenes" / "place.toml").write_text("split.test = ['upload']\n")
    with pytest.raises(UserError, match="no such session"):
        imported(tmp_path)
    (tmp_path / "scenes" / "place.toml").unlink()
    shutil.rmtree(place / "good-1")
    shutil.rmtree(place / "good-2")
    with pytest.raises(UserError, match="no frame of this recording can be read"):
        imported(tmp_path)


def test_user_mistakes_are_told_in_a_few_lines(tmp_path: Path) -> None:
    captures = tmp_path / "captures"
    (captures / "empty").mkdir(parents=True)
    with pytest.raises(UserError, match="no captures"):
        imported(tmp_path, scene="empty")
    (captures / "other").mkdir()
    (captures / "other" / "holiday.txt").write_text("sun")
    with pytest.raises(UserError, match=r"(?s)known format.*holiday.txt.*formats lists"):
        imported(tmp_path, scene="other")
    write_scanner_app(captures / "broken" / "walk", make_walk(6))
    for path in (captures / "broken" / "walk").glob("frame*.json"):
        path.write_text("[]")
    with pytest.raises(UserError, match="no frame of this recording can be read"):
        imported(tmp_path, scene="broken")
    write_scanner_app(captures / "huge" / "walk", make_walk(6))
    with pytest.raises(UserError, match=r"(?s)no usable image.*larger than 0.001 megapixels"):
        imported(tmp_path, "max_megapixels=0.001", scene="huge")
    write_scanner_app(captures / "bytes" / "walk", make_walk(6))
    (captures / "bytes" / "walk").rename(os.fsdecode(os.fsencode(captures / "bytes") + b"/w\xff"))
    with pytest.raises(UserError, match="isn't UTF-8"):
        imported(tmp_path, scene="bytes")


def test_what_a_capture_states_of_its_shutter_is_in_frames_and_a_wrong_header_is_refused(
    tmp_path: Path, place: Path
) -> None:
    write_frames_jsonl(place / "walk", make_walk(8))
    log = place / "walk" / "frames.jsonl"
    as_written = log.read_text()

    def stated(**members: object) -> None:
        log.write_text(as_written.replace("{", json.dumps(members)[:-1] + ", ", 1))

    for settings, side in (([], "bottom"), (["first_row='left'"], "left")):
        stated(first_row="bottom", readout_s=0.0187)
        frames = imported(tmp_path, *settings)["frames"]
        assert set(frames["first_row"]) == {side} and set(frames["stated_readout_s"]) == {0.0187}
    readouts: list[tuple[str, object]] = [("readout_s", value) for value in (18.7, -0.01, True, "20 ms")]
    for key, value in [("first_row", "down"), ("gravity_aligned", "no"), *readouts]:
        stated(**{key: value})
        with pytest.raises(UserError, match=r"(?s)isn't its header.*readout_s, seconds, 0 to 0.*true or false"):
            read_one(place)


def _with(walk: Walk, fault: str) -> Walk:
    """The walk with a fault that no single row shows."""
    count, xyz = len(walk.t_ns), walk.vio_T_cam[:, :3, 3]
    units = {"tenths of a metre": 10, "millimetres": 1000, "kilometres": 1e-3}
    changed = {
        "turning alone": {"vio_T_cam": make_pose(walk.vio_T_cam[:, :3, :3], np.repeat(xyz[:1], count, axis=0))},
        "frozen": {"vio_T_cam": np.repeat(walk.vio_T_cam[:1], count, axis=0)},
        "one image": {"has_image": np.arange(count) == 4},
        "black": {"pictures": np.zeros((count, HEIGHT, WIDTH, 3), np.uint8)},
        "milliseconds": {"t_ns": walk.t_ns * 1000},
        **{name: {"vio_T_cam": make_pose(walk.vio_T_cam[:, :3, :3], f * xyz)} for name, f in units.items()},
    }
    return replace(walk, **changed[fault])


USABLE = "usable: 1 warning above"


@pytest.mark.parametrize(
    ("fault", "status", "said"),
    [
        (
            "tenths of a metre",
            USABLE,
            "VIO moves at 12.34 m/s (median; 95th percentile 13.45 m/s), a walk is below 3",
        ),
        ("milliseconds", USABLE, "poses come at 0.01 Hz (median interval 100 s), expected 0.1 to 1000 Hz"),
        (
            "kilometres",
            USABLE,
            "VIO moves at 0.0012 m/s (median; 95th percentile 0.0013 m/s), a phone in a hand is faster than 0.01 m/s "
            "at times: are positions in another unit than metres (in kilometres it would be 1.3 m/s)?",
        ),
        ("turning alone", USABLE, "all 24 poses lie within 0 mm over 2.3 s while 12 images differ: did odometry run?"),
        ("one image", USABLE, "it has one image: a model needs many that overlap"),
        ("millimetres", "unusable: not plausible", "in millimetres it would be 1.2 m/s"),
        ("frozen", "unusable: not plausible", "all 24 poses are equal while 12 images differ: odometry didn't run"),
        ("black", "unusable: no sound image", "12 x image shows nothing: its grey levels vary by 0.0"),
    ],
)
def test_what_is_not_plausible_is_told_by_inspect_and_import(
    tmp_path: Path, place: Path, fault: str, status: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    write_scanner_app(place / "walk", _with(make_walk(), fault))
    lines = list(inspect_capture(place))
    assert any(said in line for line in lines) and any(line.startswith(f"  status     {status}") for line in lines)
    if status == USABLE and fault != "one image":
        imported(tmp_path)
    else:
        with pytest.raises(UserError) as error:
            imported(tmp_path)
    if status == USABLE:
        assert f"warning: walk: {said}" in capsys.readouterr().err
    else:
        assert said in str(error.value)


def test_what_cannot_be_read_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="unknown kind"):
        list(inspect_capture(Path("/dev/null")))
    write_scanner_app(tmp_path / "walk", make_walk(6))

    def refused(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "iterdir", refused)
    with pytest.raises(UserError, match=r"(?s)can't be read.*walk.*Permission denied"):
        list(inspect_capture(tmp_path / "walk"))


@pytest.mark.parametrize(("capture", "frames", "images", "poses"), [("chair", 24, 24, 70), ("corridor", 77, 140, 436)])
def test_real_captures_are_imported_whole(
    tmp_path: Path, shared_captures: Path, capture: str, frames: int, images: int, poses: int
) -> None:
    (tmp_path / "captures").mkdir()
    (tmp_path / "captures" / capture).symlink_to(shared_captures / capture)
    tables = imported(tmp_path, scene=capture)
    used = tables["frames"]
    assert (~used["support"]).sum() == frames and len(used) >= images and len(tables["vio"]) == poses
    assert tables["sessions"][["frames", "support_frames"]].to_numpy().tolist() == [[frames, len(used) - frames]]
    assert tables["rejects"].empty and tables["jumps"].empty
    assert tables["sessions"]["path_m"].item() == pytest.approx({"chair": 2.6, "corridor": 67.7}[capture], abs=0.1)
