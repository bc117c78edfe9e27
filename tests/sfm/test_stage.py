"""The whole stage on a tiny room with two walks and known poses."""

import contextlib
import os
import signal
import sqlite3
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pycolmap
import pytest

from groundwalk.geometry.fits import fit_sim3
from groundwalk.geometry.poses import rotation_angle
from groundwalk.sfm.definition import STAGE
from groundwalk.store import UserError, execute
from groundwalk.store.choices import Clock, NotRegistered
from groundwalk.store.tables import poses_of
from tests.known import put, read_picture, table_of, without_vio
from tests.sfm.textured_room import Room, make_room

_SETTINGS = ["sequence_pairs=3", "vio_pairs=2", "retrieval_pairs=3"]
_TABLES = ["images", "models", "attempts", "pairs", "points"]


def _run(room: Room, *settings: str) -> Path:
    return execute(STAGE, "room", "tiny", room.data, [*_SETTINGS, *settings])


def test_a_room_of_two_walks_becomes_one_right_model(room: Room) -> None:
    folder = _run(room)
    images = pd.read_parquet(folder / "images.parquet")
    assert images["registered"].all()
    sfm_T_cam = poses_of(images, "sfm_cam")
    fit = fit_sim3(room.true_T_cam[:, :3, 3], sfm_T_cam[:, :3, 3])
    assert np.linalg.norm(room.errors_m(images), axis=1).max() < 0.02
    turned = rotation_angle(np.swapaxes(fit.poses(sfm_T_cam)[:, :3, :3], 1, 2) @ room.true_T_cam[:, :3, :3])
    assert np.degrees(turned).max() < 0.3
    covariance = np.array(list(images["covariance"])).reshape(-1, 6, 6)
    assert (np.linalg.eigvalsh(covariance) > 0).all()

    pairs = pd.read_parquet(folder / "pairs.parquet")
    assert {"sequence", "retrieval"} <= set(pairs["origin"])
    across = pairs["frame_id_a"].str.split("/").str[0] != pairs["frame_id_b"].str.split("/").str[0]
    assert (pairs.loc[across, "status"] == "verified").any()
    assert not pairs.duplicated(["frame_id_a", "frame_id_b"]).any()

    assert (pairs["status"] == "inconsistent_with_vio").mean() < 0.03
    assert pairs.loc[~across & (pairs["status"] == "verified"), "rotation_deg"].median() < 1

    # Held-out matches fit the poses about as well as those that did.
    models = pd.read_parquet(folder / "models.parquet")
    selected = models[models["selected"]].iloc[0]
    assert selected["held_out_matches"] > 20
    assert selected["held_out_px"] == pytest.approx(selected["fitted_px"], rel=0.5)
    assert images["held_out_matches"].sum() == 2 * selected["held_out_matches"]
    attempts = pd.read_parquet(folder / "attempts.parquet")
    assert attempts["outcome"].tolist() == ["accepted"]
    assert attempts[["consistent_fraction", "selected"]].to_numpy().tolist() == [[1.0, True]]

    # The model beside the tables is COLMAP's own, with the cameras of the table.
    model = pycolmap.Reconstruction(folder / "model")
    points = pd.read_parquet(folder / "points.parquet")
    assert model.num_points3D() == len(points)
    assert model.compute_num_observations() == images["observations"].sum() == points["track_length"].sum()
    assert images["reprojection_px"].mean() == pytest.approx(model.compute_mean_reprojection_error(), rel=0.2)
    assert {image.name for image in model.images.values()} == {f"{i}.jpg" for i in images["frame_id"]}
    columns = images[["fx", "fy", "cx", "cy"]].to_numpy(float)
    for row, (intrinsics, lens) in enumerate(zip(columns, images["distortion"], strict=True)):
        assert list(model.cameras[row + 1].params) == pytest.approx([*intrinsics, *lens])
    # The room's camera is a pinhole, which the images tell.
    assert np.abs(columns / [260, 260, 160, 120] - 1).max() < 0.01
    lenses = pd.read_parquet(folder / "lenses.parquet").iloc[0]
    assert abs(lenses["k1"]) < 4 * lenses["k1_sd"] + 0.005 and abs(lenses["k2"]) < 4 * lenses["k2_sd"] + 0.005
    assert not (folder / "scratch").exists()


def _as_photos(room: Room, exif: float | None = None) -> None:
    """Make import's tables those of photos without VIO, times or an order of names; `exif`: their EXIF states focal
    lengths, as many times the right ones."""
    frames = without_vio(table_of(room.data, "room", "import", "frames"))
    order = np.random.default_rng(0).permutation(len(frames))
    frames = frames.assign(clock=Clock.NAME_ORDER, t_ns=order * 1_000_000_000)
    if exif is not None:
        frames = frames.assign(fx=exif * frames["fx"], fy=exif * frames["fy"], focal_sd=0.05)
    put(room.data, "room", "import", "frames", frames)
    put(room.data, "room", "import", "vio", table_of(room.data, "room", "import", "vio").iloc[:0])
    room.note_images()


@pytest.mark.parametrize("exif", [None, 1.0, 1.5])
def test_photos_without_vio_and_times_become_one_right_model(
    exif: float | None, room: Room, capsys: pytest.CaptureFixture[str]
) -> None:
    _as_photos(room, exif)
    folder = _run(room)
    assert ("EXIF states a focal length" in capsys.readouterr().err) == (exif == 1.5)
    pairs = pd.read_parquet(folder / "pairs.parquet")
    assert set(pairs["origin"]) == {"exhaustive"} and len(pairs) == 14 * 13 / 2
    images = pd.read_parquet(folder / "images.parquet")
    assert set(images["model_id"]) == {"incremental/0"} and images["registered"].all()
    assert np.linalg.norm(room.errors_m(images), axis=1).max() < 0.02


def test_portrait_and_landscape_photos_of_one_camera_have_one_lens_and_one_focal_length(room: Room) -> None:
    """Of unknown focal length; every second one lies upright, as import turns them clockwise."""
    _as_photos(room)
    frames, turned = table_of(room.data, "room", "import", "frames"), np.arange(14) % 2 > 0
    for image in frames.loc[turned, "image"]:
        path = room.data.captures("room") / image
        cv2.imwrite(str(path), cv2.rotate(read_picture(path), cv2.ROTATE_90_CLOCKWISE))
    frames.loc[turned, ["width", "height"]] = frames.loc[turned, ["height", "width"]].to_numpy()
    frames.loc[turned, ["cx", "cy"]] = frames.loc[turned, ["cy", "cx"]].to_numpy()
    frames.loc[turned, "first_row"] = "right"
    put(room.data, "room", "import", "frames", frames.assign(fx=320.0, fy=320.0, focal_sd=0.5))
    room.note_images()
    folder = _run(room)
    images, lenses = pd.read_parquet(folder / "images.parquet"), pd.read_parquet(folder / "lenses.parquet")
    assert images["registered"].all() and lenses["frames"].tolist() == [14]
    assert lenses["lens_id"].str.contains("320x240").all()
    assert np.abs(images[["fx", "fy"]].to_numpy() / 260 - 1).max() < 0.01
    assert images["fx"].groupby(images["frame_id"].str[:3]).std().max() < 0.5
    # As well as where none is turned, 0.35 mm.
    assert np.sqrt(np.mean(room.errors_m(images) ** 2)) < 0.0006


def test_a_frame_without_features_and_a_log_without_poses_between_images_are_named(
    room: Room, capsys: pytest.CaptureFixture[str]
) -> None:
    _blank(room, 13)
    folder = _run(room)
    said = " ".join(capsys.readouterr().err.split())
    images = pd.read_parquet(folder / "images.parquet").set_index("frame_id")
    assert images["not_registered"].dropna().to_dict() == {"two/000006": NotRegistered.NO_VERIFIED_PAIRS}
    assert not images.loc["two/000006", "registered"] and "1 of 14 frames not registered: no verified pairs" in said
    assert "no VIO poses within 0.3 s before and after 14 of 14 images (7 of one, 7 of two)" in said


def test_walks_that_nothing_visual_ties_together_become_components(tmp_path: Path) -> None:
    room = make_room(tmp_path, per_walk=10, same_place=False)
    folder = _run(room)
    images = pd.read_parquet(folder / "images.parquet")
    assert images["registered"].all()
    walk = images["frame_id"].str.split("/").str[0]
    assert images.groupby(walk)["model_id"].nunique().tolist() == [1, 1]
    assert images["model_id"].nunique() == 2
    models = pd.read_parquet(folder / "models.parquet").set_index("model_id")
    selected = models[models["selected"]]
    assert set(selected["folder"]) == {"model", "model_2"}
    points = pd.read_parquet(folder / "points.parquet")
    for model_id, model in selected.iterrows():
        own = (images["model_id"] == model_id).to_numpy()
        assert np.linalg.norm(room.errors_m(images[own]), axis=1).max() < 0.02
        written = pycolmap.Reconstruction(folder / model["folder"])
        assert written.num_reg_images() == own.sum() == model["images"]
        assert written.num_points3D() == (points["model_id"] == model_id).sum() == model["points"]


@pytest.mark.slow
def test_global_mapping_places_the_room_right(room: Room) -> None:
    images = pd.read_parquet(_run(room, "mapper=global", "retry=false") / "images.parquet")
    assert images["registered"].all() and np.linalg.norm(room.errors_m(images), axis=1).max() < 0.02


def test_mirrored_images_are_named(room: Room) -> None:
    for image in room.frames.loc[room.frames["session_id"] == "two", "image"]:
        path = room.data.captures("room") / image
        cv2.imwrite(str(path), read_picture(path)[:, ::-1])
    room.note_images()
    with pytest.raises(UserError) as caught:
        _run(room, "retrieval_pairs=0", "sequence_pairs=6")
    assert "session two" in str(caught.value)
    assert "mirrored" in str(caught.value)


@pytest.mark.slow
def test_a_stage_killed_anywhere_ends_in_the_same_tables(room: Room, tmp_path: Path) -> None:
    scratch = room.data.run("tiny", "room", ".sfm.partial") / "scratch"
    program = tmp_path / "run.py"
    program.write_text(
        "from pathlib import Path\nfrom groundwalk.store import DataRoot, execute\n"
        "from groundwalk.sfm.definition import STAGE\n"
        f"if __name__ == '__main__':\n"
        f"    execute(STAGE, 'room', 'tiny', DataRoot(Path({str(room.data.root)!r})), {_SETTINGS})\n"
    )

    def databases() -> list[Path]:
        return [path for path in scratch.glob("database*.db") if ".partial" not in path.name]

    reached_one_after_the_other = (
        databases,
        lambda: any(map(_any_verified, databases())),
        (scratch / "matched_0" / "guided.parquet").exists,
        (scratch / "mapping_0").exists,
    )
    for reached in reached_one_after_the_other:
        process = subprocess.Popen([sys.executable, program], start_new_session=True)
        while not reached() and process.poll() is None:
            time.sleep(0.005)
        assert process.poll() is None, "it ended before it could be killed"
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    resumed = {table: (_run(room) / f"{table}.parquet").read_bytes() for table in _TABLES}
    at_once = execute(STAGE, "room", "tiny", room.data, _SETTINGS, force=True)
    for table in _TABLES:
        assert (at_once / f"{table}.parquet").read_bytes() == resumed[table], table


@pytest.mark.slow
def test_the_tables_are_the_same_bytes_each_time_and_on_any_number_of_cores(room: Room) -> None:
    """A stage works on the cores that its process may use."""
    cores = os.sched_getaffinity(0)
    runs = []
    try:
        for usable in (cores, cores, {min(cores)}):
            os.sched_setaffinity(0, usable)
            folder = execute(STAGE, "room", "tiny", room.data, _SETTINGS, force=True)
            runs.append({table: (folder / f"{table}.parquet").read_bytes() for table in _TABLES})
    finally:
        os.sched_setaffinity(0, cores)
    assert runs[1] == runs[0], "the same run came out different"
    assert runs[2] == runs[0], "one core came out different from several"


def test_images_without_texture_end_in_a_clear_error(room: Room) -> None:
    _blank(room, 0)
    with pytest.raises(UserError, match="hardly any features"):
        _run(room)


def test_where_too_few_frames_register_more_is_tried_and_said(room: Room, capsys: pytest.CaptureFixture[str]) -> None:
    _blank(room, 6)
    folder = _run(room)
    said = " ".join(capsys.readouterr().err.split())
    attempts = pd.read_parquet(folder / "attempts.parquet")
    assert attempts["attempt"].tolist() == ["default", "more_pairs", "more_features", "vio_start"]
    assert set(attempts["outcome"]) == {"too_few_registered"} and attempts["selected"].sum() == 1
    assert "only 6 of 14 frames registered, which align refuses" in said
    assert pd.read_parquet(folder / "images.parquet")["registered"].sum() == 6


def test_frames_without_a_model_end_in_an_error_that_lists_the_attempts(room: Room) -> None:
    rng = np.random.default_rng(0)
    for image in room.frames["image"]:
        noise = cv2.GaussianBlur(rng.uniform(0, 255, (240, 320)), (0, 0), 2.0)
        noise = cv2.normalize(noise, np.empty(0), 0, 255, cv2.NORM_MINMAX)
        cv2.imwrite(str(room.data.captures("room") / image), noise.astype(np.uint8))
    room.note_images()
    with pytest.raises(UserError, match="no model of the frames") as caught:
        _run(room, "retry=false")
    assert "default (incremental)" in str(caught.value) and "more_pairs" not in str(caught.value)


def _any_verified(database: Path) -> bool:
    """COLMAP's database has pairs that were matched and verified; nothing is written to it."""
    with contextlib.closing(sqlite3.connect(f"{database.as_uri()}?mode=ro", uri=True)) as opened:
        return bool(opened.execute("SELECT COUNT(*) FROM two_view_geometries").fetchone()[0])


def _blank(room: Room, first: int) -> None:
    """Make all images from that one on grey."""
    for image in room.frames["image"][first:]:
        cv2.imwrite(str(room.data.captures("room") / image), np.full((240, 320), 128, np.uint8))
    room.note_images()


def test_what_import_blurred_gets_no_features(tmp_path: Path) -> None:
    """The table as import writes it: with an image in which nothing was found, and a box that leaves the image."""
    room = make_room(tmp_path, per_walk=4)
    lines = ["frame_id,source,kind,x,y,width,height,score", "one/000001,1.jpg,,,,,,"]
    lines += ["one/000002,2.jpg,face,100,60,100,100,", "two/000000,0.jpg,plate,-9,0,99,50,0.9"]
    (room.data.run("tiny", "room", "import") / "blurred.csv").write_text("\n".join(lines))
    with pycolmap.Database.open(_run(room, "max_features=500") / "features.db") as opened:
        px_of = {image.name: opened.read_keypoints(image.image_id)[:, :2] for image in opened.read_all_images()}
        described = [opened.num_descriptors_for_image(image.image_id) for image in opened.read_all_images()]
    assert described == [len(px) for px in px_of.values()]
    for name, grown in {"one/000002.jpg": (70, 30, 230, 190), "two/000000.jpg": (-39, -15, 120, 65)}.items():
        blurred, other = (
            np.all((px > grown[:2]) & (px < grown[2:]), axis=1) for px in (px_of[name], px_of["one/000001.jpg"])
        )
        assert not blurred.any() and other.sum() > 20 < len(px_of[name])
