"""Whether +y is up is tested, not believed."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from groundwalk.capture_import.capture import Limits, RawFrame, Recording, Session
from groundwalk.capture_import.checks.gravity import check_gravity, starts_along_axes
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.capture_import.inspection import inspect_capture
from groundwalk.capture_import.sessions import sound_sessions
from groundwalk.geometry.poses import ARKIT_CAM_T_CAM, Array, inverse, make_pose
from groundwalk.store.choices import Clock
from tests.capture_import.capture_writers import (
    Walk,
    imported,
    make_walk,
    reader_of,
    sessions_in,
    write_frames_jsonl,
    write_ios_logger,
    write_record3d,
    write_scan_capture,
    write_stray_scanner,
)
from tests.known import there

GRAVITY = ["gravity_x", "gravity_y", "gravity_z"]


def relative_to_start(walk: Walk) -> Walk:
    """With the first camera as the world, in ARKit's axes."""
    arkit_T_world = inverse(walk.vio_T_cam[0] @ ARKIT_CAM_T_CAM)
    return replace(walk, vio_T_cam=arkit_T_world @ walk.vio_T_cam)


def state(folder: Path, is_aligned: bool) -> None:
    lines = (folder / "frames.jsonl").read_text().splitlines()
    header = json.dumps(json.loads(lines[0]) | {"gravity_aligned": is_aligned})
    (folder / "frames.jsonl").write_text("\n".join([header, *lines[1:]]))


def test_poses_relative_to_the_first_camera_have_no_gravity(
    tmp_path: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_record3d(place / "walk", relative_to_start(make_walk()))
    write_record3d(place / "other", make_walk(seed=1))
    made = imported(tmp_path)
    by_id, frames = made["sessions"].set_index("session_id"), made["frames"]
    assert [*by_id.loc["walk", ["up", "up_source"]]] == ["unknown", "start pose"]
    assert [*by_id.loc["other", ["up", "up_source"]]] == ["+y", "format"]
    unknown = frames["session_id"] == "walk"
    assert frames.loc[unknown, GRAVITY].isna().all(axis=None) and frames.loc[~unknown, GRAVITY].notna().all(axis=None)
    assert "walk: gravity unknown: the first pose lies exactly along the world's axes" in capsys.readouterr().err


def write_imu(file: Path, walk: Walk, unit_s: float) -> None:
    """Of a phone that is held with its home button to the right: its x points up in the image, its y to the left."""
    rng = np.random.default_rng(0)
    rows = ["timestamp, a_x, a_y, a_z, alpha_x, alpha_y, alpha_z"]
    for t_ns, pose in zip(np.repeat(walk.t_ns, 20), np.repeat(make_walk().vio_T_cam, 20, axis=0), strict=True):
        right, down, forward = pose[:3, :3].T @ [0.0, -1.0, 0.0] + rng.normal(0, 0.1, 3)
        rows.append(f"{t_ns * 1e-9 / unit_s:.6f}, {-down}, {-right}, {-forward}, 0.0, 0.0, 0.0")
    file.write_text("\n".join([*rows, "torn, row"]))


@pytest.mark.parametrize(
    ("write", "log", "unit_s"),
    [
        (write_stray_scanner, "imu.csv", 1),
        (write_ios_logger, "Accel.txt", 1),
        (write_scan_capture, "accelerometer.txt", 1e-6),
    ],
)
@pytest.mark.parametrize(("tilt_deg", "says"), [(0, r"\+y is up"), (40, "unknown")])
def test_an_accelerometer_says_whether_y_is_up(
    tmp_path: Path, write: Callable[[Path, Walk], None], log: str, unit_s: float, tilt_deg: float, says: str
) -> None:
    walk = make_walk()
    tilt = make_pose(Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix(), [0, 0, 0])
    write(tmp_path / "walk", replace(walk, vio_T_cam=tilt @ walk.vio_T_cam))
    write_imu(tmp_path / "walk" / log, walk, unit_s)
    text = "\n".join(inspect_capture(tmp_path / "walk"))
    found = re.search(rf"gravity +{says}: the accelerometer's mean over \d+ samples is ([\d.]+)° from \+y", text)
    assert found is not None and abs(float(found[1]) - tilt_deg) < 1.5


def test_frames_jsonl_states_whether_its_y_is_up(tmp_path: Path, place: Path) -> None:
    write_frames_jsonl(place / "denied", make_walk())
    write_frames_jsonl(place / "level", relative_to_start(make_walk(seed=1)))
    state(place / "denied", False)
    state(place / "level", True)
    made = imported(tmp_path)
    sessions, frames = made["sessions"], made["frames"]
    assert sessions.set_index("session_id")["up"].to_dict() == {"denied": "unknown", "level": "+y"}
    assert set(sessions["up_source"]) == {"stated"}
    assert frames.loc[frames["session_id"] == "denied", GRAVITY].isna().all(axis=None)


@pytest.mark.parametrize("axes", [np.eye(3), ARKIT_CAM_T_CAM[:3, :3], np.roll(np.eye(3), 1, axis=0)])
@pytest.mark.parametrize("off_deg", [0.0, 0.02, 5.0])
def test_a_start_along_axes_is_seen_in_any_convention_and_a_phone_held_level_is_none(
    axes: Array, off_deg: float
) -> None:
    walk = make_walk()
    tilt = Rotation.from_euler("x", off_deg, degrees=True).as_matrix()
    turned = make_pose(axes @ tilt, [1.0, 2.0, 3.0]) @ inverse(walk.vio_T_cam[0]) @ walk.vio_T_cam
    session = Session("walk", Recording("", Clock.BOOT, Path(), []), [RawFrame(0, pose) for pose in turned])
    assert starts_along_axes([session]) == (off_deg == 0)


def test_poses_before_odometry_has_begun_are_no_start(tmp_path: Path) -> None:
    """ARKit's are the identity until it tracks; then they jump."""
    walk = make_walk(40)
    poses = walk.vio_T_cam.copy()
    poses[:6] = ARKIT_CAM_T_CAM
    poses[6:, :3, 3] += [3.0, 0, 0]
    write_record3d(tmp_path / "walk", replace(walk, vio_T_cam=poses))
    sessions = sessions_in(tmp_path / "walk")
    assert len(sessions) == 2 and not starts_along_axes(sessions)


def test_real_captures_keep_their_gravity_and_a_tilted_corridor_loses_it(shared_captures: Path, tmp_path: Path) -> None:
    for capture, said in (("chair", "format"), ("charuco", "format"), ("corridor", "lines in the images")):
        reader = reader_of(shared_captures / capture)
        for source in find_recordings(shared_captures / capture, tmp_path / capture, Limits()):
            sessions = sound_sessions(source.read(Limits()), reader.check, 0.5)
            check = check_gravity(sessions, reader)
            assert (check.is_aligned, check.source) == (True, said)
    for degrees in (10, 40):
        rotation = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0, 0.8])).as_matrix()
        turn = make_pose(rotation, [0, 0, 0])
        tilted = [
            replace(session, frames=[replace(f, vio_T_cam=turn @ there(f.vio_T_cam)) for f in session.frames])
            for session in sessions
        ]
        check = check_gravity(tilted, reader)
        assert not check.is_aligned and f"the best others, {degrees}° off" in check.text
