"""A folder that holds no capture: what is said is short, names what is missing, and finds recordings further down."""

import json
import shutil
from pathlib import Path

import pytest

from groundwalk.capture_import.capture import Limits
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.capture_import.formats import FORMATS
from groundwalk.store import UserError
from tests.capture_import.capture_writers import WRITERS, jpeg, make_walk

# What is taken from a recording of each format, and how the refusal says so.
HALVES = {
    "stray_scanner": ("rgb.mp4", "odometry.csv is here, rgb.mp4 is not"),
    "scan_capture": ("images.mp4", "poses.txt is here, images.mp4 is not"),
    "ios_logger": ("Frames.m4v", "ARposes.txt and Frames.txt are here, Frames.m4v is not"),
    "spectacular_ai": (
        "output.jsonl",
        "data.jsonl is here, output.jsonl (its poses, which vio_jsonl of the SDK's examples writes) is not",
    ),
    "record3d": ("rgb", "metadata.json is here, rgbd/ or rgb/ is not"),
    "polycam": ("keyframes/images", "keyframes/cameras/ is here, keyframes/images/ is not"),
    "nerf_capture": ("images", "transforms.json is here, images/ is not"),
    "arkit_scenes": ("vga_wide", "lowres_wide.traj is here, wide/ or vga_wide/ or lowres_wide/ is not"),
    "euroc": (
        "mav0/state_groundtruth_estimate0",
        "mav0/cam0/data.csv is here, mav0/state_groundtruth_estimate0/data.csv or mav0/mocap0/data.csv is not",
    ),
    "tum": ("groundtruth.txt", "rgb.txt is here, groundtruth.txt is not"),
    "rtabmap": ("scan_rgb", "*_camera_poses.txt and *_calib/ are here, *_rgb/ is not"),
    "kitti": ("poses.txt", "calib.txt, times.txt and image_2/ are here, poses.txt is not"),
    "llff": ("images", "poses_bounds.npy is here, images/ or images_*/ is not"),
    "colmap": (
        "images",
        "sparse/*/images.* is here, a folder with the 3 images that it names, such as 000000.jpg, is not",
    ),
    "nerfstudio": (
        "images",
        "transforms.json is here, a folder with the 3 images that it names, such as images/000004.jpg, is not",
    ),
}


def write_half(folder: Path, name: str) -> None:
    WRITERS[name].write(folder, make_walk(6))
    missing = folder / HALVES[name][0]
    shutil.rmtree(missing) if missing.is_dir() else missing.unlink()


def refused(root: Path) -> str:
    with pytest.raises(UserError) as error:
        for found in find_recordings(root, root.parent / "unpacked", Limits()):
            found.read(Limits())
    said = str(error.value)
    assert len(said.splitlines()) <= 12 and said.count(" not\n") <= 3
    return said


@pytest.mark.parametrize("name", ["colmap", "nerfstudio"])
def test_other_images_than_those_that_are_named_are_none_of_the_recording(tmp_path: Path, name: str) -> None:
    root = tmp_path / "capture"
    WRITERS[name].write(root, make_walk(12))
    for image in list((root / "images").rename(root / "other").iterdir()):
        image.rename(image.with_name(f"photo {image.name}".replace(".jpg", ".JPG")))
    said = refused(root)
    assert HALVES[name][1].partition(" 3 ")[0] in said and 'format = "photos"' in said


def write_photos(folder: Path, count: int) -> None:
    folder.mkdir()
    for n in range(count):
        (folder / f"{n}.jpg").write_bytes(jpeg(n))


def test_a_list_of_images_is_no_model_of_colmap(tmp_path: Path) -> None:
    root = tmp_path / "capture"
    write_photos(root, 3)
    (root / "images.txt").write_text("0.jpg\n1.jpg\n2.jpg\n")
    (found,) = find_recordings(root, tmp_path / "unpacked", Limits())
    assert found.format.id == "photos"


@pytest.mark.parametrize("name", HALVES)
@pytest.mark.parametrize("place", ["", "a", "a/b"])
def test_half_a_recording_is_named_with_what_is_missing(tmp_path: Path, name: str, place: str) -> None:
    write_half(tmp_path / "capture" / place, name)
    of_format = FORMATS[name].label + (f" ({place})" if place else "")
    assert refused(tmp_path / "capture").startswith(f"{of_format}: {HALVES[name][1]}")


def test_many_halves_and_logs_are_told_in_a_few_lines(tmp_path: Path) -> None:
    root = tmp_path / "capture"
    for name in HALVES:
        write_half(root / name, name)
    for n in range(40):
        (root / f"log {n}.json").write_text(json.dumps({"pose_matrix": [1], "timestamp": 2}))
    said = refused(root)
    assert said.count("seems to hold poses") == 3 and len(said) < 2500


@pytest.mark.parametrize(
    "files",
    [
        {},
        {"notes.txt": b"hello"},
        {"transforms.json": b""},
        {"transforms.json": b"\xff\xfe{\0"},
        {"odometry.csv": b"\0" * 10, "rgb.mp4/x": b""},
        {"poses.csv": b"t;x;y\n1,5;2,5;3"},
        {"a/b/c/d/e/f/g/odometry.csv": b"x"},
        {"line\nbreak.json": b'{"pose": 1}'},
    ],
    ids=lambda files: next(iter(files), "nothing"),
)
def test_any_folder_ends_in_a_short_message(tmp_path: Path, files: dict[str, bytes]) -> None:
    root = tmp_path / "capture"
    root.mkdir()
    for name, content in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
    refused(root)


@pytest.mark.parametrize(
    ("photos", "listed", "said"),
    [
        (2, "", "photos are read from three on"),
        (4, "1.5e-3 " + "0 " * 6 + "1\n", "result.txt seems to be TUM's list of poses"),
        (4, "1.5e-3 " + "0 " * 10 + "1\n", "result.txt seems to be KITTI's list of poses"),
    ],
)
def test_too_few_photos_and_a_list_of_poses_of_another_name_are_told(
    tmp_path: Path, photos: int, listed: str, said: str
) -> None:
    write_photos(tmp_path / "capture", photos)
    if listed:
        (tmp_path / "capture" / "result.txt").write_text("# poses\n" + 4 * listed)
    told = refused(tmp_path / "capture")
    assert said in told
    assert not listed or ("read as poses.txt beside" in told and 'format = "photos"' in told)


def test_a_log_below_whose_columns_are_named_in_comments_is_told(tmp_path: Path) -> None:
    """kapture's, of which only the images were read."""
    sensors = tmp_path / "capture" / "sensors"
    sensors.mkdir(parents=True)
    write_photos(sensors / "records_data", 3)
    columns = "# kapture format: 1.1\n# timestamp, device_id, qw, qx, qy, qz, tx, ty, tz\n"
    (sensors / "trajectories.txt").write_text(columns + "0, cam, 1, 0, 0, 0, 0, 0, 0\n")
    assert "sensors/trajectories.txt seems to hold poses (tx) and times (timestamp)" in refused(tmp_path / "capture")
