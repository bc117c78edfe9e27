"""Layouts that people have, as ../shared/cases/make_cases.py rebuilds them: what is read of each."""

import importlib.util
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from rerun.chunk import RrdReader

from groundwalk.capture_import.capture import ImageFile, Limits, Recording
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.capture_import.formats.scanner_app import FORMAT as SCANNER_APP
from groundwalk.capture_import.inspection import inspect_capture
from groundwalk.store import UserError
from tests.capture_import.capture_writers import imported, read_one
from tests.known import there


@pytest.fixture(scope="module")
def cases(shared_captures: Path) -> ModuleType:
    script = shared_captures.parent / "cases" / "make_cases.py"
    if not script.is_file():
        pytest.skip("the layouts aren't here: no file ../shared/cases/make_cases.py beside the repository")
    spec = there(importlib.util.spec_from_file_location("make_cases", script))
    module = importlib.util.module_from_spec(spec)
    there(spec.loader).exec_module(module)
    return module


@pytest.fixture(scope="module")
def truth(cases: ModuleType) -> np.ndarray:
    """ARKit's poses (24, 4, 4) of the images, as the capture itself is read."""
    raw = SCANNER_APP.read(cases.SRC, Limits())
    return np.array([frame.vio_T_cam for frame in raw.frames if frame.image is not None], dtype=float)


Make = Callable[[str], Path]


@pytest.fixture
def make(cases: ModuleType, tmp_path: Path) -> Make:
    def made(name: str) -> Path:
        cases.CASES[name](tmp_path / name)
        return tmp_path / name

    return made


def inspected(folder: Path) -> tuple[list[str], list[str]]:
    """What `inspect` says of a capture, and which of its recordings it calls unusable."""
    unusable: list[str] = []
    return list(inspect_capture(folder, unusable=unusable)), unusable


def poses_of(raw: Recording) -> np.ndarray:
    return np.array([frame.vio_T_cam for frame in raw.frames], dtype=float)


def names_of(raw: Recording) -> list[str]:
    return [frame.image.path.name for frame in raw.frames if isinstance(frame.image, ImageFile)]


SIZELESS = "states no size of 24 images"


@pytest.mark.parametrize(
    ("name", "format_id", "stem", "said"),
    [
        ("colmap_input_folder", "colmap", "{:06d}", []),
        ("colmap_frames_folder", "colmap", "{:06d}", []),
        ("colmap_unpadded_names", "colmap", "frame{}", []),
        ("colmap_workspace", "colmap", "{:06d}", []),
        ("colmap_and_transforms", "colmap", "{:06d}", ["read as COLMAP model; it is nerfstudio transforms.json, too"]),
        ("nerf_fov_only", "nerfstudio", "{:04d}", ["of camera_angle_x", "principal point isn't stated", SIZELESS]),
        ("nerf_backslashes", "nerfstudio", "{:06d}", []),
        ("nerf_per_frame_intrinsics", "nerfstudio", "{:06d}", []),
        ("polycam_without_size", "polycam", "", [SIZELESS]),  # names are times
    ],
)
def test_models_and_transforms_give_all_poses(
    make: Make, truth: np.ndarray, name: str, format_id: str, stem: str, said: list[str]
) -> None:
    raw = read_one(make(name))
    assert raw.format == format_id and not raw.rejects and raw.clock.has_times == (not stem)
    np.testing.assert_allclose(poses_of(raw), truth, atol=1e-5)
    assert not stem or names_of(raw) == [f"{stem.format(n)}.jpg" for n in range(24)]
    assert len(raw.notes) == len(said) and all(part in note for part, note in zip(said, raw.notes, strict=True))
    camera = there(raw.frames[0].intrinsics)
    assert (camera.fx, camera.fy) == pytest.approx((361.9136, 361.9136), abs=1e-3)
    assert (camera.cx, camera.cy) == pytest.approx((240, 180), abs=10)


def test_the_larger_of_two_models_is_read(make: Make, truth: np.ndarray) -> None:
    raw = read_one(make("colmap_two_models"))
    np.testing.assert_allclose(poses_of(raw), truth[5:], atol=1e-5)
    (note,) = raw.notes
    assert note.startswith("sparse/1 is read, the model with most images (19)") and "sparse/0 (5)" in note
    assert [reject.source for reject in raw.rejects] == [f"images/{n:06d}.jpg" for n in range(5)]


def test_a_chosen_format_names_what_it_leaves_out(make: Make) -> None:
    model = make("colmap_input_folder")
    make("polycam_without_size")
    said = list[str]()
    read_one(model.parent, "colmap", said.append)
    (note,) = said
    assert "polycam_without_size (Polycam raw)" in note and "colmap" in note
    with pytest.raises(UserError, match=r"(?s)no capture in the format record3d.*colmap_input_folder \(COLMAP model\)"):
        find_recordings(model.parent, model.parent / "unpacked", Limits(), "record3d")


@pytest.mark.parametrize(
    ("name", "said", "unusable"),
    [
        ("nerf_missing_images", [r"images     21 sound", r"rejected   3 x .*images/"], False),
        ("nerf_split", [r"images     24 sound", r"48 x image is a copy of that of transforms_train frame"], False),
        ("exif_rotated", [r"rejected   24 x .*EXIF orientation 6"], True),
        ("polycam_without_size", [r"images     24 sound, 480x360"], False),
        ("stray_newest", [r"status     good"], False),
        ("nested_two_levels", [r"status     good"], False),
        ("millimetres", [r"in millimetres it would be 0\.22 m/s", r"status     unusable: not plausible"], True),
        ("record3d_without_poses", [r"odometry didn't run", r"status .*read its images alone, without poses"], True),
        (
            "record3d_relative_to_start",
            [r"gravity    unknown: the first pose", r"usable: its gravity is unknown"],
            False,
        ),
    ],
)
def test_what_is_good_and_what_the_data_deny_is_told(make: Make, name: str, said: list[str], unusable: bool) -> None:
    folder = make(name)
    lines, named = inspected(folder)
    assert bool(named) == unusable
    for pattern in said:
        assert any(re.search(pattern, line) for line in lines), pattern
    if name == "record3d_without_poses":
        raw = read_one(folder, "photos")
        assert len(raw.frames) == 24 and raw.pose_source == "none"
    if name == "nerf_split":
        frames = read_one(folder).frames
        assert len(frames) == 72 and sum(frame.split == "test" for frame in frames) == 24


def test_a_part_of_a_recording_leads_to_the_whole(make: Make) -> None:
    folder = make("polycam_without_size")
    with pytest.raises(UserError, match=r"a part of the recording .*polycam_without_size\n.*inspect .*polycam_without"):
        read_one(folder / "keyframes" / "images")


def test_an_unknown_log_is_told_and_can_be_written_anew(make: Make, truth: np.ndarray) -> None:
    folder = make("unknown_app")
    with pytest.raises(UserError) as error:
        read_one(folder)
    said = str(error.value)
    assert len(said.splitlines()) <= 12 and "24 images" in said and "frames.jsonl" in said
    keys = "poses (cameraTransform), intrinsics (cameraIntrinsics) and times (timeStamp)"
    assert f"recording.json seems to hold {keys}" in said
    page = (Path(__file__).parents[3] / "docs" / "reference" / "capture-formats.md").read_text(encoding="utf-8")
    program = page.partition("```python\n")[2].partition("```")[0]
    subprocess.run([sys.executable, "-c", program], cwd=folder, check=True)
    np.testing.assert_allclose(poses_of(read_one(folder)), truth, atol=1e-6)


@pytest.mark.parametrize(("name", "format_id"), [("tum_lists", "tum"), ("rtabmap_export", "rtabmap")])
def test_lists_of_poses_and_images_are_read(make: Make, truth: np.ndarray, name: str, format_id: str) -> None:
    folder = make(name)
    raw = read_one(folder)
    assert raw.format == format_id and not raw.rejects and raw.pose_source == "reference"
    np.testing.assert_allclose(poses_of(raw), truth, atol=1e-5)
    lines, unusable = inspected(folder)
    assert not unusable and any("24 sound, 480x360" in line for line in lines)
    # TUM's lists have no intrinsics: the focal length is found by the poses and the images.
    (focal,) = [re.search(r"fx ([0-9.]+)\.\.([0-9.]+) px", line) for line in lines if "  images " in line]
    assert [float(px) for px in there(focal).groups()] == pytest.approx([361.9, 361.9], rel=0.03)


def test_without_times_nothing_is_in_seconds(make: Make, place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make("colmap_unpadded_names").rename(place)
    made = imported(place.parents[1])
    figures = made.figures
    assert made["sessions"][["duration_s", "path_m"]].isna().all(axis=None)
    assert figures["leak_s"] is None and figures["path_m"] is None and figures["frames"] == 24
    assert figures["split"] == "the last images of each recording by their names"
    said = capsys.readouterr().err.partition("done in")[0]
    assert "no times" in said and not re.search(r"[0-9] s\b|m/s| m in ", said)
    lines = "\n".join(inspect_capture(place))
    assert "poses      24, without times" in lines and not re.search(r"[0-9] (m|s|Hz)\b|m/s", lines)
    chunks = [chunk.to_record_batch().schema.names for chunk in RrdReader(made.folder / "recording.rrd").stream()]
    assert any("image_by_name" in names for names in chunks) and not any("time" in names for names in chunks)
    # Natural order: the last fifth of the names tests.
    tests = made["frames"].loc[made["frames"]["split"] == "test", "image"]
    assert [Path(name).stem for name in tests] == [f"frame{n}" for n in range(24 - len(tests), 24)]


@pytest.mark.parametrize("is_shuffled", [True, False])
def test_near_copies_in_training_are_warned_of(
    cases: ModuleType, place: Path, capsys: pytest.CaptureFixture[str], is_shuffled: bool
) -> None:
    order = np.random.default_rng(0).permutation(24) if is_shuffled else np.arange(24)
    cases.images(place / "images", take=order)
    cases.colmap(place / "sparse" / "0", take=order)
    near = imported(place.parents[1]).figures["test_images_near_train"]
    warned = "test images show nearly what a training image shows" in capsys.readouterr().err
    assert warned == is_shuffled
    assert near > 0.5 if is_shuffled else near == 0


def test_a_split_by_images_is_taken_and_copies_make_none(make: Make, place: Path) -> None:
    make("nerf_backslashes").rename(place)
    content = json.loads((place / "transforms.json").read_text())
    content["test_filenames"] = [f"images/{n:06d}.jpg" for n in range(0, 24, 4)]
    (place / "transforms.json").write_text(json.dumps(content))
    made = imported(place.parents[1])
    assert made.figures["split"] == "as the data set states"
    tests = made["frames"].loc[made["frames"]["split"] == "test", "image"]
    assert [int(Path(name).stem) for name in tests] == list(range(0, 24, 4))
    shutil.rmtree(place)
    make("nerf_split").rename(place)
    made = imported(place.parents[1])
    assert made.figures["frames"] == 24 and made.figures["test_images_also_in_train"] == 0
    assert made.figures["split"] == "the last images of each recording by their names"
    assert made["frames"]["image"].str.startswith("train/").all()
