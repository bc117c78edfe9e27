"""COLMAP models and nerfstudio files: reference poses, with the intrinsics that they state."""

import json
import re
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pycolmap
import pytest

from groundwalk.capture_import.capture import ImageFile, Intrinsics, Limits, Recording
from groundwalk.capture_import.capture import poses_of as raw_poses_of
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.capture_import.formats.colmap import _Camera, _intrinsics
from groundwalk.capture_import.inspection import inspect_capture
from groundwalk.geometry.poses import inverse
from groundwalk.store import UserError
from groundwalk.store.tables import poses_of
from tests.capture_import.capture_writers import (
    Walk,
    imported,
    make_walk,
    sessions_in,
    write_colmap,
    write_llff,
    write_nerfstudio,
)
from tests.known import read_picture, there

DISTORTED = {
    "SIMPLE_PINHOLE": [80.0, 48.5, 35.5],
    "PINHOLE": [80.0, 81.0, 48.5, 35.5],
    "SIMPLE_RADIAL": [80.0, 48.5, 35.5, 0.09],
    "RADIAL": [80.0, 48.5, 35.5, 0.09, -0.12],
    "OPENCV": [80.0, 81.0, 48.5, 35.5, 0.09, -0.12, 0.001, -0.002],
    "FULL_OPENCV": [80.0, 81.0, 48.5, 35.5, 0.09, -0.12, 0.001, -0.002, 0.03, 0.01, 0.02, -0.01],
}
# As wide as a phone's ultra-wide camera: 60 to 70 degrees from the axis in the corners.
FISHEYE = {
    "SIMPLE_RADIAL_FISHEYE": [50.0, 48.5, 35.5, 0.02],
    "RADIAL_FISHEYE": [50.0, 48.5, 35.5, 0.03, -0.01],
    "OPENCV_FISHEYE": [50.0, 51.0, 48.5, 35.5, -0.03, 0.01, -0.005, 0.001],
}


def read_all(root: Path) -> list[Recording]:
    return [found.read(Limits()) for found in find_recordings(root, root.parent / "unpacked", Limits())]


def project(camera: Intrinsics, xyz: np.ndarray) -> np.ndarray:
    """OpenCV's projection of points (N, 3), as its documentation of calib3d has it."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (*camera.distortion, *[0.0] * (8 - len(camera.distortion)))
    x, y = (xyz[:, :2] / xyz[:, 2:]).T
    r2 = x**2 + y**2
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    return np.stack([camera.fx * u + camera.cx, camera.fy * v + camera.cy], axis=1)


def rewritten(walk: Path, text: bool = False) -> pycolmap.Reconstruction:
    """The walk's COLMAP model, of which nothing but cameras, images and points is left."""
    folder = walk / "sparse" / "0"
    model = pycolmap.Reconstruction(folder)
    for file in folder.iterdir():
        file.unlink()
    (model.write_text if text else model.write_binary)(folder)
    return model


def write_with_camera(tmp_path: Path, model: str, params: list[float], text: bool = False) -> pycolmap.Camera:
    """A walk as a COLMAP model whose first camera is as stated."""
    write_colmap(tmp_path / "walk", make_walk(4))
    camera = pycolmap.Camera(camera_id=1, model=model, width=96, height=72, params=params)
    written = rewritten(tmp_path / "walk")
    written.camera(1).model, written.camera(1).params = camera.model, params
    written.write_binary(tmp_path / "walk" / "sparse" / "0")
    rewritten(tmp_path / "walk", text)
    return camera


def changed(tmp_path: Path, walk: Walk, change: Callable[[dict[str, Any]], object]) -> Recording:
    """The only recording of a walk as nerfstudio has it, whose transforms.json was changed."""
    if not (tmp_path / "walk").exists():
        write_nerfstudio(tmp_path / "walk", walk)
    file = tmp_path / "walk" / "transforms.json"
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))
    (recording,) = read_all(tmp_path)
    return recording


@pytest.mark.parametrize("model", DISTORTED | FISHEYE)
@pytest.mark.parametrize("text", [False, True])
def test_cameras_project_as_in_colmap(tmp_path: Path, model: str, text: bool) -> None:
    camera = write_with_camera(tmp_path, model, (DISTORTED | FISHEYE)[model], text)
    (session,) = read_all(tmp_path)
    found = session.frames[0].intrinsics
    assert found is not None and (found.width, found.height) == (96, 72)
    wide = [1.2, 0.9] if model in FISHEYE else [0.5, 0.4]
    xyz = np.random.default_rng(0).uniform([-wide[0], -wide[1], 1], [*wide, 2], (50, 3))
    atol = 0.05 if model in FISHEYE else 1e-9
    np.testing.assert_allclose(project(found, xyz), there(camera.img_from_cam(xyz)), atol=atol)


@pytest.mark.parametrize(
    ("model", "params", "reason"),
    [
        ("FOV", [80, 80, 48, 36, 0.5], "FOV"),
        ("OPENCV_FISHEYE", [30, 30, 48, 36, 0, 0, 0, 0], "further than 80 degrees"),
        ("OPENCV_FISHEYE", [80, 80, 48, 36, -1.5, 0, 0, 0], "folds back|further than 80 degrees"),
        ("OPENCV_FISHEYE", [80, float("nan"), 48, 36, 0, 0, 0, 0], "finite"),
    ],
)
def test_cameras_that_cannot_be_used_are_left_out_by_name(
    tmp_path: Path, model: str, params: list[float], reason: str
) -> None:
    write_with_camera(tmp_path, model, params)
    (session,) = read_all(tmp_path)
    assert len(session.frames) == 1 and len(session.rejects) == 1
    assert re.search(reason, session.rejects[0].reason)


@pytest.mark.parametrize(
    ("factors", "focal_px", "focal_sd"),
    [
        ([0.99, 1.0, 1.01, 1.02, 1.3], [80.4, 80.4, 80.4, 80.4, 104], 0),  # one is another lens
        ([0.94, 0.99, 1.03, 1.05, 1.0], [80] * 5, 0.044),  # alike, but not known well
        ([0.7, 0.8, 1.0, 1.3, 1.6], [56, 64, 80, 104, 128], 0),  # photos of many cameras
        ([1.0, 2.0], [80, 160], 0),
    ],
)
def test_a_camera_for_each_image_is_one_camera_where_they_are_alike(
    tmp_path: Path, factors: list[float], focal_px: list[float], focal_sd: float
) -> None:
    write_colmap(tmp_path / "walk", make_walk(len(factors), every=1))
    rewritten(tmp_path / "walk", text=True)
    sparse = tmp_path / "walk" / "sparse" / "0"
    lines = [line for line in (sparse / "images.txt").read_text().splitlines() if not line.startswith("#")]
    rows = [line.split() for line in lines[::2]]
    cameras = [f"{n} SIMPLE_RADIAL 96 72 {80 * factor} 48 36 0.05" for n, factor in enumerate(factors, 1)]
    (sparse / "cameras.txt").write_text("\n".join(cameras))
    (sparse / "images.txt").write_text(
        "".join(f"{' '.join([*r[:8], str(n), r[9]])}\n\n" for n, r in enumerate(rows, 1))
    )
    with warnings.catch_warnings(action="error"):
        (session,) = read_all(tmp_path)
    found = [there(frame.intrinsics) for frame in session.frames]
    assert [camera.fx for camera in found] == pytest.approx(focal_px, abs=0.5)
    assert {camera.distortion[0] for camera in found} == {0.05}
    assert found[0].focal_sd == pytest.approx(focal_sd, abs=0.002)
    assert any("have a camera each" in note for note in session.notes) == (len(set(focal_px)) < len(factors))


@pytest.mark.parametrize(
    ("beside", "lens"), [("images_2", ()), ("stereo", (0.0,) * 4), ("run-colmap-geometric.sh", (0.0,) * 4)]
)
def test_a_pinhole_of_undistorted_images_states_that_there_is_no_distortion(
    tmp_path: Path, beside: str, lens: tuple[float, ...]
) -> None:
    write_colmap(tmp_path / "dense" / "0", make_walk(4))
    (tmp_path / "dense" / "0" / beside).mkdir()
    (raw,) = read_all(tmp_path / "dense")
    assert {there(frame.intrinsics).distortion for frame in raw.frames} == {lens}


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_a_model_beyond_the_limits_is_refused(tmp_path: Path, suffix: str) -> None:
    write_colmap(tmp_path / "walk", make_walk(8))
    written = rewritten(tmp_path / "walk", text=suffix == ".txt")
    (found,) = find_recordings(tmp_path, tmp_path.parent / "unpacked", Limits())
    count = len(written.images)
    assert len(found.read(Limits(max_rows=count)).frames) == count
    with pytest.raises(UserError, match=f"more than {count - 1} "):
        found.read(Limits(max_rows=count - 1))


def test_points_that_end_beyond_the_file_and_a_wrong_number_of_parameters_are_refused(tmp_path: Path) -> None:
    write_colmap(tmp_path / "walk", make_walk(4))
    rewritten(tmp_path / "walk")
    images = tmp_path / "walk" / "sparse" / "0" / "images.bin"
    images.write_bytes(images.read_bytes().replace(b"000000.jpg", b"00000\xe9.jpg"))
    (raw,) = read_all(tmp_path)  # a name that isn't UTF-8 costs its image
    assert len(raw.frames) == 2 and [reject.source for reject in raw.rejects] == ["images/000000.jpg"]
    images.write_bytes(images.read_bytes()[:-1])
    with pytest.raises(UserError, match="points of"):
        read_all(tmp_path)
    with pytest.raises(ValueError, match="4 parameters, not 8"):
        _intrinsics(_Camera("OPENCV", 96, 72, (80.0, 80.0, 48.0, 36.0)))


def test_nerfstudio_matrices_of_intrinsics_and_scaled_rotations(tmp_path: Path) -> None:
    walk = make_walk(4)

    def state(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            fx, fy, cx, cy = (frame.pop(key) for key in ("fl_x", "fl_y", "cx", "cy"))
            frame["K"] = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
            pose = np.array(frame["transform_matrix"])
            pose[:3, :3] *= 0.002
            frame["transform_matrix"] = pose.tolist()

    raw = changed(tmp_path, walk, state)
    assert not any("isn't stated" in note or "camera_angle_x" in note for note in raw.notes)
    for frame, i in zip(raw.frames, walk.seen, strict=True):
        camera = there(frame.intrinsics)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == pytest.approx(tuple(walk.camera[i]))
        np.testing.assert_allclose(there(frame.vio_T_cam), walk.vio_T_cam[i], atol=1e-9)


def test_nerfstudio_intrinsics_are_those_stated(tmp_path: Path) -> None:
    def state(content: dict[str, Any]) -> None:
        content |= {"k1": 0.09, "k2": -0.12, "p1": 0.001, "p2": -0.002}
        content["frames"][0]["k1"] = 0.08  # frames are written last first

    raw = changed(tmp_path, make_walk(4), state)
    lenses = [(0.09, -0.12, 0.001, -0.002, 0.0), (0.08, -0.12, 0.001, -0.002, 0.0)]
    assert [there(frame.intrinsics).distortion for frame in raw.frames] == lenses
    with pytest.raises(UserError, match="THIN_PRISM_FISHEYE"):
        changed(tmp_path, make_walk(4), lambda content: content.update(camera_model="THIN_PRISM_FISHEYE"))


@pytest.mark.parametrize(
    ("model", "own", "lens"), [("OPENCV", False, ()), ("PINHOLE", False, (0.0,) * 4), ("OPENCV", True, (0.0,) * 4)]
)
def test_a_pinhole_of_nerfstudio_and_zeros_of_our_own_export_state_that_there_is_no_distortion(
    tmp_path: Path, model: str, own: bool, lens: tuple[float, ...]
) -> None:
    write_nerfstudio(tmp_path / "walk", make_walk(4))
    if own:
        (tmp_path / "walk" / "export.json").write_text('{"map": "metres, +y up"}')
    raw = changed(tmp_path, make_walk(4), lambda content: content.update(camera_model=model, k1=0.0))
    assert {there(frame.intrinsics).distortion for frame in raw.frames} == {lens}


def test_rows_of_llff_are_joined_in_the_order_of_names_as_text(tmp_path: Path) -> None:
    """Smaller copies in images_2/ do as well; too few images are refused with both counts."""
    walk = make_walk(24)  # 0.jpg, 2.jpg, ..., 22.jpg
    write_llff(tmp_path / "walk", walk)
    (tmp_path / "walk" / "images").rename(tmp_path / "walk" / "images_2")
    for image in (tmp_path / "walk" / "images_2").iterdir():
        cv2.imwrite(str(image), cv2.resize(read_picture(image), (48, 36)))
    (session,) = sessions_in(tmp_path)
    assert [frame.source for frame in session.frames[:2]] == ["poses_bounds.npy row 0", "poses_bounds.npy row 6"]
    for seen, i in zip(session.images, walk.seen, strict=True):
        assert isinstance(seen.image, ImageFile) and seen.image.path.stem == str(i)
        np.testing.assert_allclose(there(seen.vio_T_cam), walk.vio_T_cam[i], atol=1e-9)
        assert (seen.camera.fx, seen.camera.width) == (pytest.approx(walk.camera[0, 0] / 2), 48)
    (tmp_path / "walk" / "images_2" / "0.jpg").unlink()
    with pytest.raises(UserError, match=r"(?s)12 images, as many as rows.*11 in images_2/"):
        read_all(tmp_path)
    np.save(tmp_path / "walk" / "poses_bounds.npy", np.zeros((11, 15)))
    with pytest.raises(UserError, match=r"(?s)17 numbers.*\(11, 15\)"):
        read_all(tmp_path)


@pytest.mark.parametrize("stated", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_a_fisheye_lens_of_nerfstudio_projects_as_opencvs(tmp_path: Path, stated: dict[str, Any]) -> None:
    def state(content: dict[str, Any]) -> None:
        del content["camera_model"]  # which instant-ngp doesn't write
        content |= stated | {"k1": 0.03, "k2": -0.01, "k4": 0.001}
        for frame in content["frames"]:
            frame |= {"fl_x": 50.0, "fl_y": 51.0}

    camera = there(changed(tmp_path, make_walk(4), state).frames[0].intrinsics)
    xyz = np.random.default_rng(0).uniform([-1.2, -0.9, 1], [1.2, 0.9, 2], (50, 3))
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    expected, _ = cv2.fisheye.projectPoints(
        xyz[:, None], np.zeros(3), np.zeros(3), K, np.array([0.03, -0.01, 0, 0.001])
    )
    np.testing.assert_allclose(project(camera, xyz), expected[:, 0], atol=0.05)


def test_applied_transform_is_undone(tmp_path: Path) -> None:
    walk = make_walk(4, every=1)
    # As ns-process-data has it: x and y swapped, z mirrored.
    applied = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])

    def apply(content: dict[str, Any]) -> None:
        for frame in content["frames"]:
            frame["transform_matrix"] = (applied @ frame["transform_matrix"]).tolist()
        content["applied_transform"] = applied[:3].tolist()

    raw = changed(tmp_path, walk, apply)
    np.testing.assert_allclose(np.stack([there(f.vio_T_cam) for f in raw.frames]), walk.vio_T_cam, atol=1e-12)
    with pytest.raises(UserError, match="applied_transform isn't rigid"):
        changed(tmp_path, walk, lambda content: content.update(applied_transform=(2 * applied[:3]).tolist()))


@pytest.mark.parametrize("write", [write_colmap, write_nerfstudio])
def test_each_folder_of_images_is_a_recording(tmp_path: Path, write: Callable[[Path, Walk], object]) -> None:
    root = tmp_path / "scene"
    write(root, make_walk(8, every=1))

    def moved(name: str) -> str:
        return f"{'a' if int(name[:6]) < 5 else 'b'}/{name}"

    for image in list((root / "images").iterdir()):
        (root / "images" / moved(image.name)).parent.mkdir(exist_ok=True)
        image.rename(root / "images" / moved(image.name))
    if write is write_nerfstudio:
        content = json.loads((root / "transforms.json").read_text())
        for frame in content["frames"]:
            frame["file_path"] = f"images/{moved(Path(frame['file_path']).name)}"
        content["test_filenames"] = [f["file_path"] for f in content["frames"] if "/b/" in f["file_path"]]
        (root / "transforms.json").write_text(json.dumps(content))
    else:
        model = pycolmap.Reconstruction(root / "sparse" / "0")
        for named in model.images.values():
            named.name = moved(named.name)
        model.write_binary(root / "sparse" / "0")
        (root / "test.txt").write_text("".join(f"b/{i:06d}.jpg\n" for i in range(5, 8)))
    splits = {raw.recording_id: [frame.split for frame in raw.frames] for raw in read_all(tmp_path)}
    assert splits == {"a": 5 * ["train"], "b": 3 * ["test"]}
    (root / "images" / "b").rename(tmp_path / "elsewhere")
    (session,) = read_all(tmp_path)
    assert "3 rows name images in missing folders" in session.notes[0]


@pytest.mark.parametrize("write", [write_colmap, write_nerfstudio])
@pytest.mark.parametrize("name", ["images/{}.jpg", "/home/me/walk/images/{}.jpg", "..\\walk\\{}.jpg", "{}"])
def test_names_of_test_images_are_found_as_those_of_images(
    tmp_path: Path, write: Callable[[Path, Walk], object], name: str
) -> None:
    walk, root = make_walk(16), tmp_path / "walk"
    write(root, walk)

    def state(names: list[str]) -> None:
        if write is write_colmap:
            (root / "test.txt").write_text("\n".join(names))
        else:
            content = json.loads((root / "transforms.json").read_text())
            (root / "transforms.json").write_text(json.dumps(content | {"test_filenames": names}))

    state([name.format(f"{i:06d}") for i in walk.seen[::4]])
    (raw,) = read_all(tmp_path)
    assert [frame.split for frame in raw.frames] == 2 * ["test", "train", "train", "train"]
    state(["/home/me/other.jpg", "../others"])
    (raw,) = read_all(tmp_path)
    assert {frame.split for frame in raw.frames} == {None}
    assert raw.notes[0] == "no split: of the 2 images named for testing, such as others, none is here"


@pytest.mark.parametrize("write", [write_colmap, write_nerfstudio])
def test_images_are_those_of_the_folder_that_has_them(tmp_path: Path, write: Callable[[Path, Walk], object]) -> None:
    root = tmp_path / "walk"
    write(root, make_walk(12))
    (root / "images").rename(root / "rgb")
    shutil.copytree(root / "rgb", root / "1080")  # other images of the same names, and one more
    (root / "1080" / "more.jpg").write_bytes(make_walk(4).jpeg(0))
    (raw,) = read_all(tmp_path)
    folders = {frame.image.path.parent for frame in raw.frames if frame.image is not None}
    assert (len(raw.frames), folders) == (6, {root / "rgb"})
    assert write is write_colmap or "in rgb/ are read" in raw.notes[-1]


def test_a_recording_below_a_log_whose_images_are_elsewhere_is_found(tmp_path: Path) -> None:
    write_nerfstudio(tmp_path / "walk", make_walk(12))
    shutil.rmtree(tmp_path / "walk" / "images")
    write_colmap(tmp_path / "walk" / "colmap_dense", make_walk(12))
    (raw,) = read_all(tmp_path / "walk")
    assert (raw.recording_id, raw.format, len(raw.frames)) == ("colmap_dense", "colmap", 6)


@pytest.mark.parametrize("metric", [False, True])
def test_a_reference_is_no_vio_and_its_unit_is_stated(tmp_path: Path, place: Path, metric: bool) -> None:
    walk = make_walk(8, every=1)
    write_nerfstudio(place / "walk", walk)
    made = imported(tmp_path, f"reference_is_metric={str(metric).lower()}")
    unit = "m" if metric else "unknown"
    assert made["sessions"][["pose_source", "reference_unit", "up"]].iloc[0].tolist() == ["reference", unit, "unknown"]
    assert made["frames"][["vio_cam_tx", "gravity_x"]].isna().all(axis=None) and made["vio"].empty
    np.testing.assert_allclose(poses_of(made["reference"], "map_cam"), walk.vio_T_cam, atol=1e-9)


def test_a_georeferenced_data_set_comes_in_near_its_origin(tmp_path: Path, place: Path) -> None:
    """Of all recordings the same origin, in the tables and in words."""
    walk, ecef = make_walk(24), (4186461.3, 834911.7, 4723432.9)
    write_nerfstudio(place, walk)
    content = json.loads((place / "transforms.json").read_text())
    for i, frame in enumerate(sorted(content["frames"], key=lambda row: row["file_path"])):
        folder = "a" if i < len(content["frames"]) / 2 else "b"
        (place / "images" / folder).mkdir(exist_ok=True)
        (place / frame["file_path"]).rename(place / "images" / folder / Path(frame["file_path"]).name)
        frame["file_path"] = f"images/{folder}/{Path(frame['file_path']).name}"
        for row, value in zip(frame["transform_matrix"], ecef, strict=False):
            row[3] += value
    (place / "transforms.json").write_text(json.dumps(content))
    lines = [line for line in inspect_capture(place) if "reference_origin_x" in line]
    assert len(lines) == 2 and "(4186460, 834910, 4723430) of the data set's own coordinates" in lines[0]
    made = imported(tmp_path)
    origins = made["sessions"][[f"reference_origin_{axis}" for axis in "xyz"]]
    assert origins.to_numpy().tolist() == [[4186460.0, 834910.0, 4723430.0]] * 2
    centres = poses_of(made["reference"], "map_cam")[:, :3, 3] + origins.to_numpy()[0]
    assert len(centres) and np.abs(centres - ecef).max() < 10


def test_rows_of_nerfstudio_without_an_image_are_rejects(tmp_path: Path) -> None:
    nameless = [{"transform_matrix": np.eye(4).tolist()}, 7]
    raw = changed(tmp_path, make_walk(6), lambda content: content["frames"].extend(nameless))
    assert [r.reason for r in raw.rejects] == ["image name is no text", "frame is no object"]
    with pytest.raises(UserError, match="image name is no text"):
        changed(tmp_path, make_walk(6), lambda content: content.update(frames=nameless))


@pytest.mark.parametrize(
    "name", ["/home/me/images/{:04d}.jpg", "../other/images/{:04d}.jpg", "../photos\\{:04d}.jpg", "images\\{:04d}"]
)
def test_images_of_paths_elsewhere_are_found_here_and_a_last_row_may_be_left_out(tmp_path: Path, name: str) -> None:
    walk = make_walk(4)

    def rename(content: dict[str, Any]) -> None:
        for row in content["frames"]:
            written = tmp_path / "walk" / row["file_path"]
            image = written.rename(written.with_name(f"{int(written.stem):04d}.jpg"))
            row.update(file_path=name.format(int(image.stem)), transform_matrix=row["transform_matrix"][:3])

    raw = changed(tmp_path, walk, rename)
    assert len(raw.frames) == walk.has_image.sum() and not raw.rejects
    poses = np.array([frame.vio_T_cam for frame in raw.frames])
    np.testing.assert_allclose(poses, walk.vio_T_cam[walk.has_image], atol=1e-6)


@pytest.mark.parametrize("place", ["colmap/sparse/0", "distorted/sparse/0", "output/sparse", "model"])
def test_a_model_in_a_workspace_beside_its_images_is_read(tmp_path: Path, place: str) -> None:
    walk = make_walk()
    write_colmap(tmp_path / "scene", walk)
    for copy in ("depth", "mvs/images"):  # of the same names
        shutil.copytree(tmp_path / "scene" / "images", tmp_path / "scene" / copy)
    (tmp_path / "scene" / place).parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / "scene" / "sparse" / "0").rename(tmp_path / "scene" / place)
    (raw,) = read_all(tmp_path / "scene")
    np.testing.assert_allclose(raw_poses_of(raw.frames), walk.vio_T_cam[walk.seen], atol=1e-9)


@pytest.mark.parametrize("text", [False, True])
def test_each_camera_of_a_rig_is_a_recording_with_its_own_poses(tmp_path: Path, text: bool) -> None:
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=4, num_points3D=20, camera_width=96, camera_height=72
    )
    model = pycolmap.synthesize_dataset(options)
    poses = {}
    for image in model.images.values():
        image.name = f"camera{image.camera_id}/{image.frame_id:04d}.jpg"
        poses[image.name] = inverse(np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]))
        (tmp_path / "images" / image.name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(tmp_path / "images" / image.name), np.zeros((72, 96, 3), np.uint8))
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    (model.write_text if text else model.write_binary)(tmp_path / "sparse" / "0")
    assert (tmp_path / "sparse" / "0" / ("rigs.txt" if text else "rigs.bin")).exists()
    recordings = read_all(tmp_path)
    assert [len(raw.frames) for raw in recordings] == [4, 4]
    for raw in recordings:
        for frame in raw.frames:
            assert isinstance(frame.image, ImageFile)
            name = frame.image.path.relative_to(tmp_path / "images").as_posix()
            np.testing.assert_allclose(there(frame.vio_T_cam), poses[name], atol=1e-9)
