"""A folder that holds no capture: what is said is short, names what is missing, and finds recordings further down."""

import json
import shutil
from pathlib import Path

import pytest

from groundwalk.capture_import.capture import Limits
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.store import UserError
from tests.capture_import.capture_writers import WRITERS, make_walk

# What is taken from a recording of each format, and how the refusal says so.
HALVES = {
    "stray_scanner": ("rgb.mp4", "Stray Scanner{place}: odometry.csv is here, rgb.mp4 is not"),
    "scan_capture": ("images.mp4", "ScanCapture (LaMAR){place}: poses.txt is here, images.mp4 is not"),
    "ios_logger": ("Frames.m4v", "ios_logger{place}: ARposes.txt and Frames.txt are here, Frames.m4v is not"),
    "record3d": ("rgb", "Record3D{place}: metadata.json is here, rgbd/ or rgb/ is not"),
    "polycam": ("keyframes/images", "Polycam raw{place}: keyframes/cameras/ is here, keyframes/images/ is not"),
    "nerf_capture": ("images", "NeRFCapture{place}: transforms.json is here, images/ is not"),
    "arkit_scenes": (
        "vga_wide",
        "ARKitScenes raw{place}: lowres_wide.traj is here, wide/ or vga_wide/ or lowres_wide/ is not",
    ),
    "euroc": (
        "mav0/state_groundtruth_estimate0",
        "EuRoC{place}: mav0/cam0/data.csv is here, mav0/state_groundtruth_estimate0/data.csv or mav0/mocap0/data.csv "
        "is not",
    ),
    "tum": ("groundtruth.txt", "TUM RGB-D lists{place}: rgb.txt is here, groundtruth.txt is not"),
    "rtabmap": ("scan_rgb", "RTAB-Map export{place}: *_camera_poses.txt and *_calib/ are here, *_rgb/ is not"),
    "kitti": ("poses.txt", "KITTI odometry{place}: calib.txt, times.txt and image_2/ are here, poses.txt is not"),
    "llff": ("images", "LLFF{place}: poses_bounds.npy is here, images/ or images_*/ is not"),
    "colmap": (
        "images",
        "COLMAP model{place}: sparse/*/images.* is here, a folder with the 3 images that it names, such as "
        "000000.jpg, is not",
    ),
    "nerfstudio": (
        "images",
        "nerfstudio transforms.json{place}: transforms.json is here, a folder with the 3 images that it "
        "names, such as images/000004.jpg, is not",
    ),
}


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
    others = root / "other"
    (root / "images").rename(others)
    for image in list(others.iterdir()):
        image.rename(image.with_name(f"photo {image.name}".replace(".jpg", ".JPG")))
    assert HALVES[name][1].format(place="").partition(" 3 ")[0] in (said := refused(root))
    assert 'format = "photos"' in said


def test_a_list_of_images_is_no_model_of_colmap(tmp_path: Path) -> None:
    root = tmp_path / "capture"
    root.mkdir()
    for n in range(3):
        (root / f"{n}.jpg").write_bytes(make_walk(4).jpeg(n))
    (root / "images.txt").write_text("0.jpg\n1.jpg\n2.jpg\n")
    (found,) = find_recordings(root, tmp_path / "unpacked", Limits())
    assert found.format.id == "photos"


@pytest.mark.parametrize("name", HALVES)
@pytest.mark.parametrize("place", ["", "a", "a/b"])
def test_half_a_recording_is_named_with_what_is_missing(tmp_path: Path, name: str, place: str) -> None:
    gone, said = HALVES[name]
    folder = tmp_path / "capture" / place
    WRITERS[name].write(folder, make_walk(6))
    missing = folder / gone
    shutil.rmtree(missing) if missing.is_dir() else missing.unlink()
    assert refused(tmp_path / "capture").startswith(said.format(place=f" ({place})" if place else ""))


def test_many_halves_and_logs_are_told_in_a_few_lines(tmp_path: Path) -> None:
    root = tmp_path / "capture"
    for name, (gone, _) in HALVES.items():
        WRITERS[name].write(root / name, make_walk(6))
        shutil.rmtree(root / name / gone) if (root / name / gone).is_dir() else (root / name / gone).unlink()
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


def test_two_photos_are_told_to_be_too_few(tmp_path: Path) -> None:
    for n in range(2):
        (tmp_path / "capture").mkdir(exist_ok=True)
        (tmp_path / "capture" / f"{n}.jpg").write_bytes(make_walk(2).jpeg(n))
    assert "photos are read from three on" in refused(tmp_path / "capture")


@pytest.mark.parametrize(("count", "said"), [(8, "TUM's list of poses"), (12, "KITTI's list of poses")])
def test_a_list_of_poses_of_another_name_is_told_for_what_it_is(tmp_path: Path, count: int, said: str) -> None:
    for n in range(4):
        (tmp_path / "capture").mkdir(exist_ok=True)
        (tmp_path / "capture" / f"{n}.jpg").write_bytes(make_walk(4).jpeg(n))
    (tmp_path / "capture" / "result.txt").write_text("# poses\n" + 4 * ("1.5e-3 " + "0 " * (count - 2) + "1\n"))
    told = refused(tmp_path / "capture")
    assert "result.txt seems to be" in told and said in told and "read as poses.txt beside" in told
    assert 'format = "photos"' in told
