"""Each export read back by the reader of its format, to 1e-6 of the ground truth."""

import json
import re
import shutil
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import open3d
import pandas as pd
import PIL.ExifTags
import PIL.Image
import pycolmap
import pytest
from evo.tools import file_interface
from typer.testing import CliRunner

from groundwalk.alignment.definition import STAGE
from groundwalk.capture_import.capture import Limits, RawFrame, Recording
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.export import command, huggingface
from groundwalk.export.__main__ import app
from groundwalk.export.colmap import camera_fields, write_hloc
from groundwalk.export.dataset import Dataset, load_dataset
from groundwalk.export.dataset_card import _privacy, _quality
from groundwalk.export.exporters import EXPORTERS
from groundwalk.export.huggingface import _encoded
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.earth import ENU_R_YUP, enu_of
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array, inverse, make_pose, pose_from_tq, transform
from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.cleaning import clean_scene
from groundwalk.store.files import sha256_of, write_json
from groundwalk.store.georeference import FILE, Georeference
from groundwalk.store.manifests import load_manifest
from groundwalk.store.tables import camera_of, pose_frame, poses_of, with_cameras
from tests.known import cell, cells, note_outputs, put, read_picture, rewrite, rows, table_of, there

UNREGISTERED, VALIDATION, TESTED = "walk0/000003", range(5, 8), range(15, 20)
FRAMES = 39
INTRINSICS = ["fx", "fy", "cx", "cy"]


@pytest.fixture
def scene(aligned: DataRoot, tmp_path: Path) -> DataRoot:
    """A copy of `aligned` that a test may change."""
    shutil.copytree(aligned.root, tmp_path / "data")
    return DataRoot(tmp_path / "data")


@pytest.fixture(scope="module")
def aligned(data_of_module: DataRoot) -> DataRoot:
    """Two aligned walks with images, SfM's model, one frame without ground truth, and a walk with all three splits."""
    data = data_of_module
    frames = table_of(data, "Place", "import", "frames")
    frames["image"] = [f"{frame_id}.jpg" for frame_id in frames["frame_id"]]
    frames["fx"] += np.arange(len(frames))
    frames.loc[VALIDATION, "split"] = "val"
    frames.loc[TESTED, "split"] = "test"
    paths = [data.captures("Place") / image for image in frames["image"]]
    for row, path in enumerate(paths):
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), np.full((12, 16, 3), 4 * row, np.uint8))
    frames["image_sha256"] = [sha256_of(path) for path in paths]
    put(data, "Place", "import", "frames", frames)
    images = table_of(data, "Place", "sfm", "images")
    images.loc[images["frame_id"] == UNREGISTERED, "registered"] = False
    # SfM found other focal lengths for one walk.
    scale = np.where(images["frame_id"].str.startswith("walk1/"), 1.01, 1.0)
    images["fx"], images["fy"] = frames["fx"] * scale, frames["fy"] * scale
    images["distortion"] = [[0.0] * 4] * len(images)
    put(data, "Place", "sfm", "images", images)
    _write_models(data, {"model": "incremental/0"})
    execute(STAGE, "Place", "tiny", data)
    return data


def _write_models(data: DataRoot, model_ids: dict[str, str]) -> None:
    """SfM's models of the frames that have their ids, each in its folder, and the table that says so."""
    images, folder = table_of(data, "Place", "sfm", "images"), data.run("tiny", "Place", "sfm")
    frames = with_cameras(table_of(data, "Place", "import", "frames"), images)
    for name, model_id in model_ids.items():
        (folder / name).mkdir(exist_ok=True)
        rows = np.flatnonzero(images["model_id"] == model_id)
        _model(frames.iloc[rows], poses_of(images, "sfm_cam")[rows]).write_binary(folder / name)
    models = pd.DataFrame({"model_id": list(model_ids.values()), "folder": list(model_ids)})
    models = models.assign(
        mapping="incremental", selected=True, images=20, points=19, observations=38, held_out_matches=0
    )
    models[["mean_track_length", "mean_reprojection_px", "held_out_px", "fitted_px"]] = 0.5
    put(data, "Place", "sfm", "models", models)


def _model(frames: pd.DataFrame, sfm_T_cam: Array) -> pycolmap.Reconstruction:
    """A model of these frames and a point a metre or so ahead of each, seen by it and the next one."""
    model = pycolmap.Reconstruction()
    for row, frame in enumerate(rows(frames), start=1):
        camera = camera_of(frame)
        _add_image(model, row, frame.frame_id, camera, sfm_T_cam[row - 1], np.full((2, 2), 100.0))
    for row in range(1, len(frames)):
        track = pycolmap.Track([pycolmap.TrackElement(row, 0), pycolmap.TrackElement(row + 1, 1)])
        model.add_point3D((sfm_T_cam[row - 1] @ [0, 0, 0.4, 1])[:3], track)
    return model


def _add_image(
    model: pycolmap.Reconstruction, number: int, frame_id: str, lens: Camera, sfm_T_cam: Array, seen_px: Array
) -> None:
    params = [lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion]
    camera = pycolmap.Camera(camera_id=number, model="OPENCV", width=lens.width, height=lens.height, params=params)
    model.add_camera_with_trivial_rig(camera)
    image = pycolmap.Image(name=f"{frame_id}.jpg", keypoints=seen_px, camera_id=number, image_id=number)
    model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(inverse(sfm_T_cam)[:3]))


def _export(scene: DataRoot, name: str, *options: str) -> Path:
    return _exported(scene, name, *options)[0]


def _exported(scene: DataRoot, name: str, *options: str) -> tuple[Path, str]:
    """The folder, and what the command said, as one line."""
    out = scene.root.parent / "out" / name
    arguments = ["--scene", "Place", "--profile", "tiny", "--data", str(scene.root), "--format", name]
    arguments += ["--licence", "cc-by-4.0"]
    done = CliRunner().invoke(app, [*arguments, "--out", str(out), *options], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return out, " ".join(done.output.split())


def _truth(scene: DataRoot) -> pd.DataFrame:
    """Ground truth by frame_id."""
    gt = table_of(scene, "Place", "align", "ground_truth")
    return gt[gt["quality"] != "none"].set_index("frame_id")


def _frame_of(out: Path) -> dict[str, str]:
    """frame_id by exported image."""
    listed = pd.read_csv(out / "frames.csv", keep_default_na=False)
    return {image: frame_id for image, frame_id in zip(listed["image"], listed["frame_id"], strict=True) if image}


def _assert_same(scene: DataRoot, found: dict[str, Array]) -> None:
    """Poses (4, 4) by frame_id are the ground truth of all frames that have it."""
    truth = _truth(scene)
    assert set(found) == set(truth.index) and len(truth) == FRAMES
    np.testing.assert_allclose(np.stack([found[i] for i in truth.index]), poses_of(truth, "map_cam"), atol=1e-6)


@pytest.mark.parametrize("name", ["colmap", "colmap-text"])
def test_colmap_reads_its_model_in_the_map(scene: DataRoot, name: str) -> None:
    out = _export(scene, name)
    model, frame_of = pycolmap.Reconstruction(out / "sparse" / "0"), _frame_of(out)
    found = _poses(model, frame_of)
    _assert_same(scene, found)
    # As COLMAP says that no cameras are tied together.
    assert len(model.frames) == len(model.images) and len(model.rigs) == len(model.cameras)
    assert all(rig.num_sensors() == 1 for rig in model.rigs.values())
    # The points came along: each lies ahead of its first camera, 0.4 SfM units in metres.
    figures = json.loads((scene.run("tiny", "Place", "align") / "manifest.json").read_text())["figures"]
    for point in model.points3D.values():
        first = min(point.track.elements, key=lambda e: e.point2D_idx)
        frame_id = frame_of[f"images/{model.image(first.image_id).name}"]
        if first.point2D_idx == 0:
            ahead = found[frame_id] @ [0, 0, 0.4 * figures["metres_per_sfm_unit"], 1]
            np.testing.assert_allclose(point.xyz, ahead[:3], atol=1e-6)
    lists = {split: (out / f"{split}.txt").read_text().split() for split in ("train", "val", "test")}
    assert lists["val"] == [f"walk0/{i:06d}.jpg" for i in VALIDATION]
    assert len(lists["test"]) == 25 and sum(map(len, lists.values())) == FRAMES


def test_colmap_reads_two_models_in_one_map(scene: DataRoot) -> None:
    """Two of equal size, each with half of both walks: SfM's order and align's need not be the same."""
    images = table_of(scene, "Place", "sfm", "images")
    late = (np.arange(len(images)) % 20 >= 10) & images["registered"].to_numpy(bool)
    images.loc[late, "model_id"] = "incremental/1"
    sfm_T_cam = poses_of(images, "sfm_cam")
    other = Sim3(2.1, make_pose(np.eye(3)[[1, 2, 0]], np.zeros(3))[:3, :3], np.array([-4.0, 9.0, 2.0]))
    sfm_T_cam[late] = other.poses(sfm_T_cam[late])
    images[pose_frame("sfm_cam", sfm_T_cam).columns] = pose_frame("sfm_cam", sfm_T_cam)
    put(scene, "Place", "sfm", "images", images)
    _write_models(scene, {"model": "incremental/0", "model_2": "incremental/1"})
    execute(STAGE, "Place", "tiny", scene, force=True)
    out = _export(scene, "colmap")
    assert sorted(path.name for path in (out / "sparse").iterdir()) == ["0", "1"]
    truth, found = _truth(scene), dict[str, Array]()
    for number in (0, 1):
        model = pycolmap.Reconstruction(out / "sparse" / str(number))
        own = _poses(model, _frame_of(out))
        assert set(own) == set(truth.index[truth["component"] == number])
        assert model.num_points3D() > 10
        found |= own
    assert truth["component"].value_counts().to_dict() == {0: 20, 1: 19}
    _assert_same(scene, found)
    for option in ("link", "none"):
        out, said = _exported(scene, "hloc", "--force", "--images", option)
        note = json.loads((out / "export.json").read_text())
        assert (note["frames"], note["left_out"], note["excluded"]) == (20, 19, 1)
        assert "20 frames, 1 without" in said and "19 of further SfM models" in said


def _poses(model: pycolmap.Reconstruction, frame_of: dict[str, str]) -> dict[str, Array]:
    """map_T_cam by frame_id."""
    return {
        frame_of[f"images/{image.name}"]: inverse(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]))
        for image in model.images.values()
    }


def test_hloc_gets_a_reference_and_queries(scene: DataRoot) -> None:
    """Read as its parsers do: blanks between a name, a camera or a pose."""
    out = _export(scene, "hloc")
    frame_of, truth = _frame_of(out), _truth(scene)
    frames = table_of(scene, "Place", "import", "frames").set_index("frame_id")
    split = frames["split"]
    reference = pycolmap.Reconstruction(out / "reference")
    found = _poses(reference, frame_of)
    assert {split[frame_id] for frame_id in found} == {"train", "val"} and reference.points3D
    lists = [(out / f"queries_{name}.txt").read_text().splitlines() for name in ("with_intrinsics", "poses")]
    for camera, pose in zip(*lists, strict=True):
        name, model, width, height, *params = camera.split()
        same, qw, qx, qy, qz, *translation = pose.split()
        frame_id = frame_of[f"images/{name}"]
        row = truth.loc[frame_id]
        assert same == name and split[frame_id] == "test" and (out / "images" / name).is_file()
        assert (model, int(width), int(height)) == ("PINHOLE", *frames.loc[frame_id, ["width", "height"]])
        np.testing.assert_allclose(np.array(params, float), row[INTRINSICS].to_numpy(float), atol=1e-6)
        quaternion = np.array([qx, qy, qz, qw], float)
        found[frame_id] = inverse(pose_from_tq(np.array(translation, float), quaternion))
    _assert_same(scene, found)


def test_kapture_is_two_data_sets_by_its_definition(scene: DataRoot) -> None:
    """Fields between commas; a pose is world to camera, w first; a record's sensor is in sensors.txt, its pose in
    trajectories.txt under the same time and sensor."""
    out = _export(scene, "kapture")
    frame_of, truth, found, devices = _frame_of(out), _truth(scene), dict[str, Array](), list[str]()
    sizes = table_of(scene, "Place", "import", "frames").set_index("frame_id")[["width", "height"]].astype(str)
    for part, splits in (("mapping", {"train", "val"}), ("query", {"test"})):
        tables = {}
        for name in ("sensors", "trajectories", "records_camera"):
            lines = (out / part / "sensors" / f"{name}.txt").read_text(encoding="utf-8").splitlines()
            assert lines[0] == "# kapture format: 1.1"
            tables[name] = [[field.strip() for field in line.split(",")] for line in lines if not line.startswith("#")]
        sensors = {device: fields for device, _, kind, *fields in tables["sensors"] if kind == "camera"}
        devices += sensors
        poses = {(time, device): np.array(pose, float) for time, device, *pose in tables["trajectories"]}
        for time, device, image in tables["records_camera"]:
            frame_id = frame_of[f"{part}/sensors/records_data/{image}"]
            row, (model, width, height, *params) = truth.loc[frame_id], sensors[device]
            assert row["split"] in splits and int(time) < 2**32
            assert (out / part / "sensors" / "records_data" / image).is_file()
            assert (model, width, height) == ("PINHOLE", *sizes.loc[frame_id])
            np.testing.assert_allclose(np.array(params, float), row[INTRINSICS].to_numpy(float), atol=1e-6)
            qw, qx, qy, qz, *translation = poses[time, device]
            found[frame_id] = inverse(pose_from_tq(np.array(translation), np.array([qx, qy, qz, qw])))
    # kapture's merge takes sensors of one id as one, with the first part's camera.
    assert len(devices) == len(set(devices))
    _assert_same(scene, found)


def _with_focal_lengths(scene: DataRoot, spread_px: float) -> Dataset:
    """As one phone took it, with focal lengths that differ by at most this."""
    dataset = load_dataset(scene, "tiny", "Place", reads_images=False)
    focal_px = 1400 + np.linspace(0, spread_px, FRAMES)
    frames = dataset.frames.assign(cx=960.0, cy=720.0, fx=focal_px, fy=focal_px)
    return replace(dataset, frames=frames, sessions=dataset.sessions.assign(device="A phone"))


def test_frames_of_a_device_share_a_camera_where_no_corner_moves_by_half_a_pixel(scene: DataRoot) -> None:
    """A corner is 1,200 px from the middle: 0.5 px of it are 0.58 px of a focal length of 1,400."""
    near = EXPORTERS.find("colmap").with_its_cameras(_with_focal_lengths(scene, 2 * 0.57))
    assert len(set(near.cameras)) == 1 and near.apart_px == 0
    assert near.cameras[0].fx == pytest.approx(1400.57)
    far = EXPORTERS.find("colmap").with_its_cameras(_with_focal_lengths(scene, 2 * 0.60))
    assert len(set(far.cameras)) == FRAMES and 0.5 < far.apart_px < 0.52
    for name in ("colmap", "hloc", "kapture"):
        out = scene.root / name
        out.mkdir()
        EXPORTERS.find(name).write(near, out, "none")
        if name == "kapture":
            sensors = (out / "mapping" / "sensors" / "sensors.txt").read_text().splitlines()
            assert len([line for line in sensors if not line.startswith("#")]) == 1
            continue
        model = pycolmap.Reconstruction(out / ("reference" if name == "hloc" else "sparse/0"))
        assert len(model.cameras) == len(model.rigs) == 1 < len(model.images) == len(model.frames)


def test_a_zoomed_image_keeps_a_pinhole_of_its_own(scene: DataRoot) -> None:
    assert len({camera.fx for camera in _with_focal_lengths(scene, 60).with_pinholes().cameras}) == 1
    assert len({camera.fx for camera in _with_focal_lengths(scene, 80).with_pinholes().cameras}) == FRAMES


def test_kapture_has_colmaps_lenses() -> None:
    lens = (0.1, -0.2, 0.003, 0.004)
    opencv = camera_fields(Camera(64, 48, 50.0, 51.0, 32.0, 24.0, lens))
    assert ", ".join(opencv) == "OPENCV, 64, 48, 50.0, 51.0, 32.0, 24.0, 0.1, -0.2, 0.003, 0.004"
    full = camera_fields(Camera(64, 48, 50.0, 51.0, 32.0, 24.0, (*lens, 0.5)))
    assert full[:2] == ["FULL_OPENCV", "64"] and full[-5:] == ["0.004", "0.5", "0.0", "0.0", "0.0"]


def test_where_on_earth_the_map_is_is_given_out_only_where_it_is_asked_for(scene: DataRoot) -> None:
    with pytest.raises(UserError, match="where on earth") as refused:
        _export(scene, "tum", "--georeference")
    assert "gps = true" in str(refused.value.details["do"])
    align = scene.run("tiny", "Place", "align")
    place = Georeference(
        source="gps", origin=(-33.8568, 151.2153, 40.0), enu_S_map=Sim3(1.0, ENU_R_YUP, np.array([3.0, -2.0, 1.5])),
        covariance=np.diag([1e-5, 1e-5, 1e-3, 4.0, 4.0, 9.0, 0.0]), middle=np.zeros(3), stated=9, used=9, rms_m=2.0,
        worst_m=4.0, gives_scale=False,
    )  # fmt: skip
    place.write(align / FILE)
    note_outputs(align)
    truth = _truth(scene)
    enu = place.enu_S_map.points(poses_of(truth, "map_cam")[:, :3, 3])
    for name in ("colmap", "nerfstudio", "huggingface"):
        plain = _export(scene, name)
        private = [path for path in plain.rglob("*") if path.is_file() and path.suffix != ".parquet"]
        assert not any(b"151.21" in path.read_bytes() or "geo" in path.name for path in private)
        shutil.rmtree(plain)
        out = _export(scene, name, "--georeference")
        listed = pd.read_csv(out / "georeference.csv").set_index("frame_id").loc[truth.index]
        np.testing.assert_allclose(listed[["east_m", "north_m", "up_m"]], enu, atol=1e-6)
        geodetic = listed[["latitude_deg", "longitude_deg", "altitude_m"]]
        np.testing.assert_allclose(enu_of(place.origin, geodetic.to_numpy()), enu, atol=1e-3)
        assert (listed["east_sd_m"] >= 2).all() and (listed["up_sd_m"] >= 3).all()
        if name == "colmap":
            lines = (out / "geo_registration.txt").read_text().split("\n")
            image, *values = lines[0].split(" ")
            expected = geodetic.loc[_frame_of(out)[f"images/{image}"]]
            np.testing.assert_allclose(np.array(values, float), expected, atol=1e-9)
        if name == "nerfstudio":
            content = json.loads((out / "transforms.json").read_text())
            enu_T_world, frame = np.array(content["georeference"]["enu_T_world"]), content["frames"][0]
            at = (enu_T_world @ frame["transform_matrix"])[:3, 3]
            np.testing.assert_allclose(at, enu[truth.index == _frame_of(out)[frame["file_path"]]][0], atol=1e-6)
        if name == "huggingface":
            card = (out / "README.md").read_text(encoding="utf-8")
            assert "georeference.csv say where on earth" in card and "GPS were never read" not in card


def test_a_card_says_of_people_and_places_what_is_so(scene: DataRoot) -> None:
    dataset = replace(load_dataset(scene, "tiny", "Place"), simulated=False)
    assert "people who are in the images can be recognised. Positions by GPS were never read." in _privacy(dataset)
    asked = _privacy(replace(dataset, reads_gps=True, origin=(5e5, 4e6, 0.0)))
    assert "Positions by GPS were read; neither they" in asked and "map_origin in export.json leads back" in asked
    counts = np.where(np.arange(FRAMES) < 5, np.nan, 1.0)
    blurred = dataset.frames.assign(blurred_faces=counts, blurred_plates=0.0)
    said = _privacy(replace(dataset, frames=blurred))
    assert "34 faces and 0 licence plates" in said and "5 images were not searched" in said


def test_a_card_says_how_many_frames_have_a_covariance(scene: DataRoot) -> None:
    dataset = load_dataset(scene, "tiny", "Place", reads_images=False)
    assert "Each frame has its 6x6 covariance." in _quality(dataset)
    some = dataset.frames.assign(covariance=cells([None, *dataset.frames["covariance"][1:]]))
    assert f"{FRAMES - 1} of {FRAMES} frames have their 6x6" in _quality(replace(dataset, frames=some))


def test_whether_people_were_looked_for_is_said_of_every_export_with_images(scene: DataRoot) -> None:
    note_outputs(scene.run("tiny", "Place", "align"), simulated=False)
    out, said = _exported(scene, "tum")
    assert "people who are in the images can be recognised. [import] blur = true in" in said
    assert "can be recognised" in json.loads((out / "export.json").read_text())["people"]
    assert "recognised" not in _exported(scene, "tum", "--images", "none", "--force")[1]
    frames = table_of(scene, "Place", "import", "frames")
    put(scene, "Place", "import", "frames", frames.assign(blurred_faces=1.0, blurred_plates=0.0))
    said = _exported(scene, "tum", "--force")[1]
    assert f"{FRAMES} faces and 0 licence plates were blurred" in said and "blur = true" not in said


def test_copied_and_embedded_images_carry_no_place(scene: DataRoot) -> None:
    """A photo's EXIF may say where it was taken."""
    dataset = load_dataset(scene, "tiny", "Place", reads_images=False)
    source = dataset.images[0].file
    data = source.read_bytes()
    source.write_bytes(data[:2] + b"\xff\xe1\x00\x11Exif\0\0@151.2153" + data[2:])
    assert b"151.2153" in source.read_bytes()
    target = scene.root / "copied.jpg"
    dataset.images[0].place(target, "copy")
    assert b"151.2153" not in target.read_bytes() and b"151.2153" not in _encoded(dataset.images[0], "a")["bytes"]


def test_an_image_that_readers_would_turn_by_its_exif_is_copied(scene: DataRoot) -> None:
    source, exif = load_dataset(scene, "tiny", "Place", reads_images=False).images[0], PIL.Image.Exif()
    for orientation, name in ((1, "linked.jpg"), (6, "turned.jpg")):
        exif[PIL.ExifTags.Base.Orientation] = orientation
        PIL.Image.new("RGB", (16, 12)).save(source.file, exif=exif)
        source.place(scene.root / name, "link")
    assert (scene.root / "linked.jpg").is_symlink() and not (scene.root / "turned.jpg").is_symlink()
    assert read_picture(scene.root / "turned.jpg").shape == (12, 16, 3)


def test_hloc_without_test_frames_and_a_data_set_without_a_licence_are_refused(scene: DataRoot) -> None:
    dataset = load_dataset(scene, "tiny", "Place")
    with pytest.raises(UserError, match="0 test frames"):
        write_hloc(replace(dataset, frames=dataset.frames.assign(split="train")), scene.root / "out", "none")
    with pytest.raises(UserError, match="licence") as refused:
        _export(scene, "huggingface", "--licence", "")
    assert "--licence cc-by-4.0" in str(refused.value.details["do"])
    out = scene.root.parent / "out"
    assert not out.exists() or not list(out.iterdir())


def test_evo_reads_euroc_which_has_one_camera_a_session(scene: DataRoot) -> None:
    _give_lens(scene, LENS)
    out, truth = _export(scene, "euroc", "--images", "copy"), _truth(scene)
    assert {frame_id: int(Path(image).stem) for image, frame_id in _frame_of(out).items()} == truth["t_ns"].to_dict()
    for session in _sessions(out):
        assert session.pose_source == "reference" and len({there(raw.intrinsics) for raw in session.frames}) == 1
    # The middle of SIZE, where the first pixel's centre is 0.
    assert ", 159.5, 119.5]" in (out / "walk0" / "mav0" / "cam0" / "sensor.yaml").read_text()
    path = out / "walk0" / "mav0" / "state_groundtruth_estimate0" / "data.csv"
    trajectory = file_interface.read_euroc_csv_trajectory(str(path))
    walk0 = truth[truth["session_id"] == "walk0"]
    np.testing.assert_allclose(trajectory.timestamps, walk0["t_ns"] / 1e9, atol=1e-6)
    # Its world has +z up.
    positions = poses_of(walk0, "map_cam")[:, :3, 3]
    np.testing.assert_allclose(trajectory.positions_xyz, positions[:, [0, 2, 1]] * [1, -1, 1], atol=1e-9)

    gt = table_of(scene, "Place", "align", "ground_truth")
    gt["fx"] *= np.where(np.arange(len(gt)) % 2, 1.3, 1.0)
    rewrite(scene, "Place", "align", "ground_truth", gt)
    with pytest.raises(UserError, match="one camera a session"):
        _export(scene, "euroc", "--force")


def test_evo_reads_tum(scene: DataRoot) -> None:
    out = _export(scene, "tum")
    truth, found = _truth(scene), dict[str, Array]()
    for key, of_session in truth.groupby("session_id"):
        session_id = str(key)
        trajectory = file_interface.read_tum_trajectory_file(str(out / session_id / "groundtruth.txt"))
        np.testing.assert_allclose(trajectory.timestamps, of_session["t_ns"] / 1e9, atol=1e-6)
        found |= dict(zip(of_session.index, trajectory.poses_se3, strict=True))
        rgb = [line.split() for line in (out / session_id / "rgb.txt").read_text().splitlines()[1:]]
        assert [float(t) for t, _ in rgb] == trajectory.timestamps.tolist()
        for frame_id, (_, image) in zip(of_session.index, rgb, strict=True):
            assert (out / session_id / image).read_bytes() == _image(scene, frame_id).read_bytes()
    _assert_same(scene, found)


def test_nerfstudio_poses_are_opengl_cameras_in_a_world_with_z_up(scene: DataRoot) -> None:
    """By its documentation: columns are right, up, back and position; applied_transform took our world to theirs."""
    out = _export(scene, "nerfstudio")
    content = json.loads((out / "transforms.json").read_text())
    applied = np.vstack([content["applied_transform"], [0, 0, 0, 1]])
    np.testing.assert_allclose(applied @ [0, 1, 0, 0], [0, 0, 1, 0], atol=1e-12)
    frame_of, truth, found = _frame_of(out), _truth(scene), {}
    for frame in content["frames"]:
        frame_id = frame_of[frame["file_path"]]
        right, up, back, position = np.linalg.solve(applied, np.array(frame["transform_matrix"])).T[:, :3]
        found[frame_id] = make_pose(np.stack([right, -up, -back], axis=1), position)
        given = [frame[key] for key in ("fl_x", "fl_y", "cx", "cy")]
        assert given == truth.loc[frame_id, INTRINSICS].to_numpy(float).tolist()
        assert (out / frame["file_path"]).is_file()
    _assert_same(scene, found)
    named = {split: content[f"{split}_filenames"] for split in ("train", "val", "test")}
    assert len(named["val"]) == 3 and len(named["test"]) == 25
    assert {path for paths in named.values() for path in paths} == {f["file_path"] for f in content["frames"]}


def _sessions(out: Path) -> list[Recording]:
    found = find_recordings(out, out.parent / "unpacked", Limits())
    return [recording.read(Limits()) for recording in found]


def _path(frame: RawFrame) -> Path:
    assert frame.image is not None
    return frame.image.path


@pytest.mark.parametrize("name", ["7scenes", "cambridge", "colmap", "colmap-text", "nerfstudio"])
def test_our_importer_reads_what_other_tools_read(scene: DataRoot, name: str) -> None:
    # Import takes nothing that leads out of the capture folder, links least of all.
    out = _export(scene, name, "--images", "copy")
    frame_of, truth, found = _frame_of(out), _truth(scene), {}
    sessions = _sessions(out)
    is_split = name in ("7scenes", "cambridge")  # a sequence is wholly for training or for testing
    split = [Counter(s.split or f.split for f in s.frames) for s in sessions]
    assert split == (
        [{"train": 14}, {"test": 5}, {"test": 20}] if is_split else [{"train": 14, "test": 5}, {"test": 20}]
    )
    for session in sessions:
        assert not session.rejects and session.clock == "name_order"
        stated = (session.pose_source, session.is_metric, session.is_gravity_aligned)
        assert stated == ("reference", True, not is_split) and (is_split or not session.notes)
        for raw in session.frames:
            image = _path(raw)
            frame_id = frame_of[image.relative_to(out).as_posix()]
            found[frame_id] = there(raw.vio_T_cam)
            assert (read_picture(image) == read_picture(_image(scene, frame_id))).all()
            camera = there(raw.intrinsics)
            expected = truth.loc[frame_id, INTRINSICS].to_numpy(float)
            np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], expected, atol=1e-6)
            assert not any(camera.distortion)
    _assert_same(scene, found)


@pytest.mark.parametrize(
    ("scale_source", "vertical_source", "unit"),
    [
        ("reference, unit unknown", "reference, up unknown", "a reference's unknown unit"),
        ("none", "none", "SfM's unit"),
    ],
)
def test_a_map_of_unknown_unit_and_vertical_is_exported_as_such(
    scene: DataRoot, scale_source: str, vertical_source: str, unit: str
) -> None:
    gt, align = table_of(scene, "Place", "align", "ground_truth"), scene.run("tiny", "Place", "align")
    gt = gt.assign(scale_source=scale_source, vertical_source=vertical_source)
    put(scene, "Place", "align", "ground_truth", gt)
    origin = dict(zip("xyz", (4186460.0, 834910.0, 4723430.0), strict=True)) if scale_source != "none" else {}
    figures = load_manifest(align)["figures"] | {f"map_origin_{axis}": origin.get(axis) for axis in "xyz"}
    note_outputs(align, figures=figures)
    out, said = _exported(scene, "nerfstudio", "--images", "copy")
    assert f"warning: NO METRIC SCALE: positions are in {unit}, not in metres" in said
    note = json.loads((out / "export.json").read_text())
    assert note["map"].startswith(unit) and "up unknown" in note["map"]
    assert ("add map_origin" in note["map"]) == bool(origin)
    assert note["map_origin"] == (list(origin.values()) or None)
    assert {(s.is_metric, s.is_gravity_aligned) for s in _sessions(out)} == {(False, False)}
    dataset = load_dataset(scene, "tiny", "Place")
    assert re.search(r"median: [\d.e-]+ map units and", _quality(dataset))
    alone = replace(dataset, sessions=dataset.sessions.assign(pose_source="none"))
    assert "no standard error is said. Metric scale" in _quality(alone)
    for path in _export(scene, "euroc", "--images", "none").rglob("state_groundtruth_estimate0/data.csv"):
        assert "p_x [map units]" in path.read_text()


@pytest.mark.parametrize("name", EXPORTERS)
def test_frames_without_ground_truth_are_left_out_and_listed(scene: DataRoot, name: str) -> None:
    out = _export(scene, name, "--images", "none")
    note = json.loads((out / "export.json").read_text())
    assert (note["frames"], note["excluded"], note["simulated"], note["format"]) == (FRAMES, 1, True, name)
    listed = pd.read_csv(out / "frames.csv", keep_default_na=False).set_index("frame_id")
    assert len(listed) == FRAMES + 1
    assert listed.loc[UNREGISTERED, ["image", "quality"]].to_numpy().tolist() == ["", "none"]
    assert "register" in cell(listed, UNREGISTERED, "reason")
    truth = _truth(scene)
    cameras = listed.loc[truth.index, INTRINSICS].astype(float)  # for formats that have no place for them
    if EXPORTERS.find(name).cameras == "pinhole":
        assert (cameras[["cx", "cy"]] == [960, 720]).all(axis=None) and (cameras["fx"] == cameras["fy"]).all()
    else:
        assert (cameras == truth[INTRINSICS]).all(axis=None)
    assert (listed.loc[truth.index, ["width", "height"]].astype(int) == [1920, 1440]).all(axis=None)
    assert not [p for p in out.rglob("*") if p.suffix in (".jpg", ".png")]


def test_support_frames_are_not_exported(scene: DataRoot) -> None:
    support = {"walk0/000007", "walk1/000011"}
    frames = table_of(scene, "Place", "import", "frames")
    put(scene, "Place", "import", "frames", frames.assign(support=frames["frame_id"].isin(support)))
    execute(STAGE, "Place", "tiny", scene, force=True)
    out = _export(scene, "colmap")
    listed = pd.read_csv(out / "frames.csv", keep_default_na=False)
    assert len(listed) == FRAMES + 1 - len(support) and not set(listed["frame_id"]) & support
    model = pycolmap.Reconstruction(out / "sparse" / "0")
    assert {image.name.removesuffix(".jpg") for image in model.images.values()} == set(_frame_of(out).values())


def test_an_image_that_changed_since_import_is_not_exported_beside_its_old_pose(scene: DataRoot) -> None:
    image = _image(scene, "walk0/000002")
    cv2.imwrite(str(image), np.full((12, 16, 3), 200, np.uint8))
    with pytest.raises(UserError, match=r"(?s)1 of \d+ images aren't as import saw them.*000002.jpg"):
        _export(scene, "tum")
    assert not (scene.root.parent / "out").exists()
    image.unlink()
    _export(scene, "tum", "--images", "none")


def test_nothing_is_overwritten_unasked_and_never_what_is_no_export(scene: DataRoot) -> None:
    out = _export(scene, "tum")
    assert all(image.is_symlink() for image in out.rglob("*.jpg"))
    with pytest.raises(UserError, match="holds earlier exports"):
        _export(scene, "tum")
    (out / "notes").mkdir()
    (out / "notes" / "day 1.txt").write_text("mine")
    (out / "link").symlink_to("nowhere")
    with pytest.raises(UserError, match=r"(?s)other files.*link, notes/day 1.txt"):
        _export(scene, "tum", "--force")
    assert (out / "notes" / "day 1.txt").read_text() == "mine"
    shutil.rmtree(out / "notes")
    (out / "link").unlink()
    _export(scene, "tum", "--force", "--images", "none")
    assert not any(out.rglob("*.jpg"))
    # As it was written before the note listed the files.
    note = json.loads((out / "export.json").read_text())
    write_json(out / "export.json", {name: value for name, value in note.items() if name != "files"})
    with pytest.raises(UserError, match="other files than earlier exports"):
        _export(scene, "tum", "--force")
    assert (out / "frames.csv").exists()


@pytest.mark.parametrize("images", ["none", "copy"])
def test_what_is_exported_is_held_and_the_same_at_the_end(
    scene: DataRoot, monkeypatch: pytest.MonkeyPatch, images: str
) -> None:
    """A stage that would replace it, and `clean`, are refused meanwhile; what other programs change is noticed."""
    truth = scene.run("tiny", "Place", "align") / "ground_truth.parquet"
    changed = truth if images == "none" else next(scene.captures("Place").rglob("*.jpg"))

    def while_it_is_written(*arguments: Any) -> None:
        with pytest.raises(UserError, match="read or removed by another run"):
            execute(STAGE, "Place", "tiny", scene, force=True)
        with pytest.raises(UserError, match="read or removed by another run"):
            clean_scene(scene, "tiny", "Place")
        changed.write_bytes(changed.read_bytes() + b"x")
        listed(*arguments)

    listed = command._write_lists
    monkeypatch.setattr(command, "_write_lists", while_it_is_written)
    with pytest.raises(UserError, match=r"isn.t as its stage wrote it|aren.t as import saw them"):
        _export(scene, "tum", "--images", images)
    assert not (scene.root.parent / "out" / "tum").exists()


def test_an_export_that_fails_leaves_nothing_behind(scene: DataRoot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("groundwalk.export.dataset.verify_images", lambda *_: None)  # and then an image goes
    _give_lens(scene, LENS)
    _image(scene, "walk1/000019").unlink()
    for name in EXPORTERS:
        with pytest.raises(UserError, match="image is missing"):
            _export(scene, name)
    assert list((scene.root.parent / "out").iterdir()) == []


LENS = (0.092, -0.125, 0.001, -0.0005)
SIZE = (320, 240)
# Where each frame sees dots, at unit focal length, and how far they are away.
SEEN, DEPTH_M = np.array([(-0.5, -0.36), (0.49, -0.35), (-0.47, 0.37), (0.5, 0.36), (0.02, 0.01)]), 3.0


def _give_lens(scene: DataRoot, lens: tuple[float, ...]) -> dict[str, Array]:
    """Every frame gets a camera with this lens, and an image with dots in it; returns their places in the map."""
    gt = table_of(scene, "Place", "align", "ground_truth")
    gt = gt.assign(
        fx=230.0 + 0.1 * np.arange(len(gt)),
        fy=231.0,
        cx=161.3,
        cy=118.4,
        distortion=cells([list(lens)] * len(gt)),
    )
    rewrite(scene, "Place", "align", "ground_truth", gt)
    x, y = np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1])[:, None] + 0.5
    points = {}
    for frame_id, row in _truth(scene).iterrows():
        camera = Camera(*SIZE, row["fx"], row["fy"], row["cx"], row["cy"], lens)
        dots = [np.exp(-((x - u) ** 2 + (y - v) ** 2) / 8) for u, v in camera.project(SEEN)]
        cv2.imwrite(str(_image(scene, str(frame_id))), (230 * np.sum(dots, axis=0)).astype(np.uint8))
        map_T_cam = poses_of(pd.DataFrame([row]), "map_cam")[0]
        points[str(frame_id)] = transform(map_T_cam, DEPTH_M * np.column_stack([SEEN, np.ones(len(SEEN))]))
    _write_frames(scene, width=SIZE[0], height=SIZE[1])
    return points


def _write_frames(scene: DataRoot, **columns: int) -> None:
    """Import's frames with the images that are there now."""
    frames = table_of(scene, "Place", "import", "frames").assign(**columns)
    frames["image_sha256"] = [sha256_of(_image(scene, frame_id)) for frame_id in frames["frame_id"]]
    put(scene, "Place", "import", "frames", frames)


def _dots_off_px(image: Path, world_T_cam: Array, intrinsics: Iterable[float], points: Array) -> float:
    """How far the image's dots are from where a pinhole of fx, fy, cx, cy projects the points, at most."""
    pixels = read_picture(image, cv2.IMREAD_GRAYSCALE).astype(float)
    fx, fy, cx, cy = intrinsics
    off, xyz = [], transform(inverse(world_T_cam), points)
    for u, v in Camera(*SIZE, fx, fy, cx, cy).project(xyz[:, :2] / xyz[:, 2:]):
        columns, rows = (np.arange(int(c) - 7, int(c) + 8) for c in (u, v))
        window = np.maximum(pixels[np.ix_(rows, columns)] - 8, 0)
        at = np.array([window.sum(0) @ (columns + 0.5), window.sum(1) @ (rows + 0.5)]) / window.sum()
        off.append(float(np.linalg.norm(at - [u, v])))
    return max(off)


@pytest.mark.parametrize("name", ["7scenes", "cambridge", "euroc"])
def test_formats_without_distortion_get_images_of_pinholes(scene: DataRoot, name: str) -> None:
    points = _give_lens(scene, LENS)
    out = _export(scene, name, "--images", "copy")
    note = json.loads((out / "export.json").read_text())
    assert (note["undistorted_images"], note["jpeg_quality"]) == (FRAMES, 95)
    listed = pd.read_csv(out / "frames.csv").set_index("frame_id")
    frame_of, found = _frame_of(out), {}
    for session in _sessions(out):
        assert not session.rejects
        for raw in session.frames:
            image, camera = _path(raw), there(raw.intrinsics)
            frame_id = frame_of[image.relative_to(out).as_posix()]
            found[frame_id] = there(raw.vio_T_cam)
            stated = listed.loc[frame_id, INTRINSICS].to_numpy(float)
            assert stated == pytest.approx([camera.fx, camera.fy, camera.cx, camera.cy])
            assert camera.distortion == (0.0,) * 4
            assert _dots_off_px(image, found[frame_id], stated, points[frame_id]) < 0.2
            before = _truth(scene).loc[frame_id, INTRINSICS].to_numpy(float)
            assert _dots_off_px(_image(scene, frame_id), found[frame_id], before, points[frame_id]) > 1
    _assert_same(scene, found)


@pytest.fixture
def with_lens(scene: DataRoot) -> DataRoot:
    """Images of dots through a lens, and a SfM model of these dots and one beyond what an undistorted image shows: each
    is a point that its frame sees, alone."""
    points = _give_lens(scene, LENS)
    sessions = table_of(scene, "Place", "import", "sessions")
    put(scene, "Place", "import", "sessions", sessions.assign(device="A phone"))
    truth, dataset = _truth(scene), load_dataset(scene, "tiny", "Place", reads_images=False)
    model, to_map = pycolmap.Reconstruction(), dataset.models[0].map_S_sfm
    for row, (frame_id, pose) in enumerate(zip(truth.index, to_map.inverse().poses(dataset.map_T_cam), strict=True), 1):
        fx, fy, cx, cy = truth.loc[frame_id, INTRINSICS].to_numpy(float)
        lens = Camera(*SIZE, fx, fy, cx, cy, LENS)
        corner = lens.unproject(np.array([[1.0, 1.0]]))
        beyond = transform(dataset.map_T_cam[row - 1], [[*corner[0], 1.0]])
        pixels = lens.project(np.vstack([SEEN, corner]))
        _add_image(model, row, str(frame_id), lens, pose, pixels)
        for number, xyz in enumerate(to_map.inverse().points([*points[str(frame_id)], *beyond])):
            model.add_point3D(xyz, pycolmap.Track([pycolmap.TrackElement(row, number)]), [row, number, 7])
    model.write_binary(scene.run("tiny", "Place", "sfm") / "model")
    sfm, align = (scene.run("tiny", "Place", stage) for stage in ("sfm", "align"))
    note_outputs(sfm)
    note_outputs(align, inputs=load_manifest(align)["inputs"] | {"Place/sfm": load_manifest(sfm)["outputs"]})
    return scene


def test_splats_get_undistorted_images_a_model_and_transforms_that_agree(with_lens: DataRoot) -> None:
    out = _export(with_lens, "splat")
    model, frame_of = pycolmap.Reconstruction(out / "sparse" / "0"), _frame_of(out)
    # One centred pinhole, whatever the focal lengths were, as some readers put the principal point there.
    (camera,) = model.cameras.values()
    assert camera.model.name == "PINHOLE" and (camera.width, camera.height) == SIZE
    focal, same, *centre = camera.params
    assert focal == same and centre == [160, 120]
    found, content = _poses(model, frame_of), json.loads((out / "transforms.json").read_text())
    _assert_same(with_lens, found)
    world_T_map = np.vstack([content["applied_transform"], [0, 0, 0, 1]])
    names = {image.name: image for image in model.images.values()}
    assert len(content["frames"]) == FRAMES and content["camera_model"] == "PINHOLE"
    seen = 0
    for frame in content["frames"]:
        image = names[frame["file_path"].removeprefix("images/")]
        frame_id = frame_of[frame["file_path"]]
        pose = np.linalg.inv(world_T_map) @ frame["transform_matrix"] @ np.diag([1, -1, -1, 1])
        np.testing.assert_allclose(pose, found[frame_id], atol=1e-9)
        assert [frame[key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h")] == [*camera.params, *SIZE]
        assert not any(frame[key] for key in ("k1", "k2", "k3", "p1", "p2"))
        observed = image.get_observation_points2D()
        points = np.array([model.point3D(of.point3D_id).xyz for of in observed])
        reprojected = np.array([image.project_point(xyz) for xyz in points])
        np.testing.assert_allclose(reprojected, [of.xy for of in observed], atol=1e-3)
        # The dots in the image lie where its points are seen.
        assert _dots_off_px(out / frame["file_path"], found[frame_id], camera.params, points) < 0.2
        assert _dots_off_px(_image(with_lens, frame_id), found[frame_id], camera.params, points) > 1
        seen += len(points)
    # The points beyond the undistorted images are gone.
    assert seen == len(model.points3D) == FRAMES * len(SEEN)
    cloud = open3d.io.read_point_cloud(out / content["ply_file_path"])
    in_map = list(model.points3D.values())
    expected = transform(world_T_map, np.array([point.xyz for point in in_map]))
    order, other = np.lexsort(np.asarray(cloud.points).round(3).T), np.lexsort(expected.round(3).T)
    np.testing.assert_allclose(np.asarray(cloud.points)[order], expected[other], atol=1e-4)
    colours = np.array([point.color for point in in_map])
    np.testing.assert_allclose(255 * np.asarray(cloud.colors)[order], colours[other], atol=0.1)
    split = table_of(with_lens, "Place", "import", "frames").set_index("frame_id")["split"]
    for name in ("train", "val", "test"):
        listed = [f"images/{line}" for line in (out / f"{name}.txt").read_text().split()]
        assert listed == content[f"{name}_filenames"] and {split[frame_of[path]] for path in listed} == {name}
    assert not [path for path in (out / "images").iterdir() if path.is_dir()]


def test_nerfstudio_holds_five_coefficients(scene: DataRoot) -> None:
    points = _give_lens(scene, LENS)
    out = _export(scene, "nerfstudio")
    content = json.loads((out / "transforms.json").read_text())
    frame = content["frames"][0]
    assert content["camera_model"] == "OPENCV"
    assert [frame[key] for key in ("k1", "k2", "p1", "p2", "k3")] == [*LENS, 0.0]
    assert (out / frame["file_path"]).is_symlink()

    points = _give_lens(scene, (*LENS, 0.02, 0.01, 0.0, 0.0))
    out = _export(scene, "nerfstudio", "--force")
    frame_of, truth = _frame_of(out), _truth(scene)
    for frame in json.loads((out / "transforms.json").read_text())["frames"][:5]:
        assert not any(frame[key] for key in ("k1", "k2", "p1", "p2", "k3"))
        stated, frame_id = [frame[key] for key in ("fl_x", "fl_y", "cx", "cy")], frame_of[frame["file_path"]]
        map_T_cam = poses_of(truth.loc[[frame_id]], "map_cam")[0]
        assert _dots_off_px(out / frame["file_path"], map_T_cam, stated, points[frame_id]) < 0.2


def test_what_cannot_be_exported_is_said(scene: DataRoot) -> None:
    _give_lens(scene, (-300.0, 0.0, 0.0, 0.0))
    with pytest.raises(UserError, match="can't be undistorted"):
        _export(scene, "cambridge")
    _give_lens(scene, LENS)
    cv2.imwrite(str(_image(scene, "walk0/000000")), np.zeros((12, 16, 3), np.uint8))
    _write_frames(scene)
    with pytest.raises(UserError, match="16 x 12"):
        _export(scene, "cambridge")

    note_outputs(scene.run("tiny", "Place", "sfm"))
    with pytest.raises(UserError, match="another run of stage sfm"):
        _export(scene, "tum")


def _image(scene: DataRoot, frame_id: str) -> Path:
    return scene.captures("Place") / f"{frame_id}.jpg"


def test_huggingface_loads_in_shards_below_their_limit(
    scene: DataRoot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`load_dataset` reads splits, poses and images; mlcroissant finds no fault and the same rows; the card says what
    there is."""
    how = "not installed: make install, or pip install -c constraints.txt datasets mlcroissant"
    datasets = pytest.importorskip("datasets", reason=how)
    mlcroissant = pytest.importorskip("mlcroissant", reason=how)
    pixels = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    for frame_id in table_of(scene, "Place", "import", "frames")["frame_id"]:
        cv2.imwrite(str(_image(scene, frame_id)), pixels)
    _write_frames(scene, width=160, height=120)
    limit = 5 * _image(scene, "walk0/000000").stat().st_size
    monkeypatch.setattr(huggingface, "_MAX_SHARD_BYTES", limit)
    monkeypatch.setattr(huggingface, "_ROW_BYTES", 0)
    out = _export(scene, "huggingface", "--citation", "A walk, 2026")
    files = sorted(path.name for path in (out / "data").iterdir())
    assert [name for name in files if "train" in name] == [f"train-{i:05d}-of-00003.parquet" for i in range(3)]
    # Besides images, each row has numbers, and each file its schema.
    assert all((out / "data" / name).stat().st_size < limit + 50_000 for name in files)
    listed = pd.read_csv(out / "frames.csv", keep_default_na=False)
    assert set(listed["image"]) - {""} == {f"data/{name}" for name in files}

    truth, found = _truth(scene), dict[str, Array]()
    loaded = datasets.load_dataset(str(out), cache_dir=str(tmp_path / "cache"))
    assert {split: len(rows) for split, rows in loaded.items()} == {"train": 11, "validation": 3, "test": 25}
    for row in (row for split in loaded.values() for row in split):
        found[row["frame_id"]] = pose_from_tq(np.array(row["position"]), np.array(row["quaternion"]))
        expected = truth.loc[row["frame_id"]]
        np.testing.assert_allclose(row["covariance"], expected["covariance"])
        assert row["image"].size == (160, 120) and row["quality"] == expected["quality"]
    _assert_same(scene, found)
    croissant = mlcroissant.Dataset(jsonld=str(out / "croissant.json"))
    issues = croissant.metadata.issues
    assert not issues.errors and not issues.warnings, issues.report()
    for split, of_split in loaded.items():
        frame_ids = [record[f"{split}/frame_id"].decode() for record in croissant.records(split)]
        assert frame_ids == list(of_split["frame_id"]) == sorted(frame_ids)
    stated = json.loads((out / "croissant.json").read_text(encoding="utf-8"))
    assert stated["rai:dataCollectionType"] == "Simulation" and stated["rai:machineAnnotationTools"] == "groundwalk"
    told = {"dataCollection", "dataAnnotationProtocol", "dataUseCases", "dataLimitations", "dataBiases"}
    assert all(stated[f"rai:{name}"] for name in told)
    assert stated["rai:dataCollectionMissingData"] == "1 frames without ground truth are left out."
    assert stated["rai:personalSensitiveInformation"].startswith("The images show a simulated place without people.")
    card = (out / "README.md").read_text(encoding="utf-8")
    for said in ("license: cc-by-4.0", "SIMULATED", "1 of 40 frames got no ground truth", "Cite as: A walk, 2026"):
        assert said in card
