"""Each format: written from a walk, read back to the same walk."""

import json
import math
import re
import shutil
import zipfile
from pathlib import Path

import numpy as np
import pytest

from groundwalk.capture_import.capture import GpsFix, ImageFile, Limits, poses_of
from groundwalk.capture_import.discovery import find_recordings
from groundwalk.capture_import.formats import FORMATS
from groundwalk.capture_import.inspection import inspect_capture
from groundwalk.capture_import.media.images import decode_rgb
from groundwalk.capture_import.parsing import fisheye_intrinsics
from groundwalk.capture_import.sessions import sound_sessions
from groundwalk.geometry.poses import relative, rotation_angle, tq_from_pose
from groundwalk.store import UserError
from tests.capture_import.capture_writers import (
    HEIGHT,
    WIDTH,
    WRITERS,
    find_one,
    image,
    imported,
    make_walk,
    read_one,
    rejects_of,
    sessions_in,
    write_pose_list,
    write_record3d,
    write_stray_scanner,
)
from tests.known import rows, there


# What a walk's poses are written in; images alone have none.
@pytest.mark.parametrize("name", [*(n for n in FORMATS.builtin if not FORMATS[n].is_images_alone), "record3d.r3d"])
def test_a_written_walk_reads_back_the_same(tmp_path: Path, name: str) -> None:
    walk, (name, _, archive) = make_walk(24), name.partition(".")
    writer = WRITERS[name]
    if archive:
        write_record3d(tmp_path / "place" / "walk", walk, archive=True)
    else:
        writer.write(tmp_path / "place" / "walk", walk)
        for file in [path for path in (tmp_path / "place" / "walk").rglob("*") if path.is_file()]:
            # As macOS writes beside each file on a disk that keeps no attributes.
            file.with_name(f"._{file.name}").write_bytes(b"\0\5\x16\7\0\2\0\0Mac OS X        ")
    found = find_one(tmp_path / "place")
    assert found.format.id == name and (not archive or found.recording_id == "walk")
    (session,) = sessions_in(tmp_path / "place")
    assert not session.rejects
    # Which instants of the walk the format kept: all, or those with an image.
    t_ns, poses = session.t_ns, session.poses
    kept = np.arange(24) if len(t_ns) == 24 else np.flatnonzero(walk.has_image)
    assert len(t_ns) == len(kept)
    off = relative(walk.vio_T_cam[kept], poses)
    assert np.linalg.norm(off[:, :3, 3], axis=1).max() < 1e-6
    assert rotation_angle(off[:, :3, :3]).max() < 1e-6
    if writer.clock:
        np.testing.assert_allclose(t_ns, walk.t_ns[kept], atol=1000)
    if not writer.images:
        assert not session.images
        return
    for seen in session.images:
        index = int(np.argmin(np.abs(poses - there(seen.vio_T_cam)).sum(axis=(1, 2))))
        if writer.camera:
            camera = seen.camera
            assert (seen.check.width, seen.check.height) == (WIDTH, HEIGHT)
            np.testing.assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], walk.camera[kept[index]])
        stated_s = {"3d_scanner_app": 0.01, "scan_capture": 0.016}.get(name)
        assert seen.exposure_s == (stated_s and pytest.approx(stated_s))
    assert len(session.images) == (24 if name == "stray_scanner" else 12)


# Where the images are, by format.
IMAGES = {
    "3d_scanner_app": "frame_*.jpg",
    "record3d": "rgb/*.jpg",
    "polycam": "keyframes/images/*.jpg",
    "nerf_capture": "images/*.png",
    "frames_jsonl": "images/*",
    "arkit_scenes": "*wide/*.png",
    "tum": "rgb/*",
    "rtabmap": "scan_rgb/*",
    "kitti": "image_2/*",
    "seven_scenes": "*.color.png",
    "cambridge": "*.[jp][pn]g",
    "colmap": "images/*",
    "nerfstudio": "images/*",
}


def places(root: Path, name: str) -> list[Path]:
    return sorted(p for p in root.rglob("*") if p.is_file() and p.match(IMAGES[name]))


@pytest.mark.parametrize("name", IMAGES)
def test_each_image_is_read_or_a_reject(tmp_path: Path, name: str) -> None:
    """A suffix in capitals is read, or a reject where the log itself names the file; so are other names."""
    root = tmp_path / "place"
    WRITERS[name].write(root / "walk", make_walk(8, every=1))
    first, second, third, *rest = places(root, name)
    assert rest
    first.rename(first.with_suffix(first.suffix.upper()))
    second.rename(second.with_name(f"IMG_{second.name}"))
    third.with_name(f"copy{third.suffix.upper()}").write_bytes(third.read_bytes())
    third.with_name("live.HEIC").write_bytes(b"heic")
    expected = {f"IMG_{second.name}", f"copy{third.suffix.upper()}", "live.HEIC"}
    raw = read_one(root)
    rejected = {Path(reject.source).name for reject in raw.rejects}
    read = {f.image.path.name for f in raw.frames if isinstance(f.image, ImageFile) and f.image.path.is_file()}
    upper = first.with_suffix(first.suffix.upper()).name
    if name == "arkit_scenes":  # each image is a row
        rejected |= read
    assert expected <= rejected
    assert upper in read | rejected
    assert (upper in read) or name in ("frames_jsonl", "tum", "cambridge", "colmap", "nerfstudio", "nerf_capture")
    assert {p.name for p in rest} <= read


@pytest.mark.parametrize("name", [name for name in WRITERS if name not in ("colmap", "llff")])
def test_logs_in_utf16_are_read_and_empty_ones_refused(tmp_path: Path, name: str) -> None:
    WRITERS[name].write(tmp_path / "place" / "walk", make_walk(8))
    count = len(read_one(tmp_path / "place").frames)
    texts = (".csv", ".txt", ".json", ".jsonl", ".yaml", ".nvm", ".traj")
    logs = [path for path in (tmp_path / "place").rglob("*") if path.suffix in texts]
    for log in logs:
        log.write_bytes(log.read_text().encode("utf-16"))
    raw = read_one(tmp_path / "place")
    assert (raw.format, len(raw.frames)) == (name, count) and not raw.rejects
    for log in logs:
        log.write_bytes(b"")
    with pytest.raises(UserError):
        for session in sessions_in(tmp_path / "place"):
            assert not session.frames
            raise UserError("no sound row")


@pytest.mark.parametrize("name", ["arkit_scenes", "rtabmap", "seven_scenes", "cambridge", "tum", "kitti"])
def test_a_comma_for_a_decimal_point_is_named(tmp_path: Path, name: str) -> None:
    WRITERS[name].write(tmp_path / "place" / "walk", make_walk(8))
    for log in (path for path in (tmp_path / "place").rglob("*") if path.suffix in (".txt", ".traj")):
        log.write_text(re.sub(r"(\d)\.(\d)", r"\1,\2", log.read_text()))
    try:
        said = [reject.reason for reject in rejects_of(sessions_in(tmp_path / "place"))]
    except UserError as error:
        said = [str(error)]
    assert any("has a comma for a decimal point" in text for text in said)


def test_two_files_of_one_frame_number_are_named(tmp_path: Path) -> None:
    folder = tmp_path / "place" / "walk"
    WRITERS["3d_scanner_app"].write(folder, make_walk(8, every=1))
    for suffix in ("json", "jpg"):
        shutil.copy(folder / f"frame_00003.{suffix}", folder / f"frame_3.{suffix}")
    shutil.copy(folder / "frame_00004.jpg", folder / "frame_00004.JPEG")
    raw = read_one(tmp_path / "place")
    assert len(raw.frames) == 8
    assert {r.source for r in raw.rejects} == {"frame_3.json", "frame_3.jpg", "frame_00004.JPEG"}
    assert raw.rejects[0].reason == "frame_00003.json has the same frame number"


@pytest.mark.parametrize("kind", ["matrix", "name", "order"])
def test_lists_of_poses_are_joined_with_images_by_name_or_order(tmp_path: Path, kind: str) -> None:
    walk, root = make_walk(12, every=1), tmp_path / "place"
    t, q = tq_from_pose(walk.vio_T_cam)
    rows = {
        "matrix": [" ".join(map(str, pose[:3].ravel())) for pose in walk.vio_T_cam],
        "name": [f"images/shot{i}.png {' '.join(map(str, (*t[i], *q[i])))}" for i in reversed(range(12))],
        "order": [" ".join(map(str, (walk.t_ns[i] * 1e-9, *t[i], *q[i]))) for i in range(12)],
    }[kind]
    (root / "images").mkdir(parents=True)
    for i in range(12):
        # Numbers are no times, though some lie within the list's.
        (root / "images" / f"{'' if kind == 'order' else 'shot'}{i}.png").write_bytes(walk.png(i))
    (root / "poses.txt").write_text("\n".join(rows))
    raw = read_one(root)
    assert (raw.format, len(raw.frames), raw.rejects) == ("pose_list", 12, [])
    for frame in raw.frames:
        assert isinstance(frame.image, ImageFile)
        at = int(frame.image.path.stem.removeprefix("shot"))
        np.testing.assert_allclose(there(frame.vio_T_cam), walk.vio_T_cam[at], atol=1e-6)
    (root / "poses.txt").write_text("\n".join(rows[:-2]))
    if kind == "name":
        assert len(read_one(root).rejects) == 2  # images without a row
    else:
        with pytest.raises(UserError, match="10 rows, 12 images"):
            read_one(root)


def test_images_numbered_by_ten_digits_as_kittis_have_no_times(tmp_path: Path) -> None:
    walk = make_walk(12, every=1, start_s=0.0)
    write_pose_list(tmp_path / "walk", walk)
    for i, t_ns in enumerate(walk.t_ns):
        (tmp_path / "walk" / "images" / f"{t_ns}.png").rename(tmp_path / "walk" / "images" / f"{i:010d}.png")
    raw = read_one(tmp_path / "walk")
    assert not raw.clock.has_times
    np.testing.assert_allclose(poses_of(raw.frames), walk.vio_T_cam, atol=1e-6)


def test_images_whose_size_lies_behind_long_metadata_are_read(tmp_path: Path) -> None:
    walk, folder = make_walk(12), tmp_path / "walk"
    write_pose_list(folder, walk)
    (folder / "camera.txt").unlink()
    segment = b"\xff\xe2" + (65000).to_bytes(2, "big") + bytes(64998)
    for i in walk.seen:
        (folder / "images" / f"{walk.t_ns[i]}.png").unlink()
        start, rest = walk.jpeg(i)[:2], walk.jpeg(i)[2:]
        (folder / "images" / f"{walk.t_ns[i]}.jpg").write_bytes(start + 2 * segment + rest)
    raw = read_one(folder)
    sizes = {(there(f.intrinsics).width, there(f.intrinsics).height) for f in raw.frames if f.image is not None}
    assert sizes == {(WIDTH, HEIGHT)} and not raw.rejects


@pytest.mark.parametrize("name", ["polycam", "kitti", "seven_scenes"])
def test_missing_images_are_told(tmp_path: Path, name: str) -> None:
    WRITERS[name].write(tmp_path / "place" / "walk", make_walk(8, every=1))
    assert not any("have no image" in note for note in read_one(tmp_path / "place").notes)
    for path in places(tmp_path / "place", name)[:3]:
        path.unlink()
    assert any(note.startswith("3 of 8 poses have no image, such as ") for note in read_one(tmp_path / "place").notes)


@pytest.mark.parametrize("stated", [[-0.01, 0.03, -0.04, 0.006], [-0.01, 0.03, 0.0, 0.0, -0.04, 0.006]])
def test_a_fisheye_lens_of_rtabmap_is_read_as_one(tmp_path: Path, stated: list[float]) -> None:
    walk = make_walk(4)
    WRITERS["rtabmap"].write(tmp_path / "walk", walk)
    lens = f"data: {stated}\ndistortion_model: equidistant"
    for file in (tmp_path / "walk" / "scan_calib").iterdir():
        file.write_text(file.read_text().replace("data: [ 0., 0., 0., 0., 0. ]", lens))
    expected = fisheye_intrinsics(tuple(walk.camera[0].tolist()), WIDTH, HEIGHT, (-0.01, 0.03, -0.04, 0.006))
    assert read_one(tmp_path / "walk").frames[0].intrinsics == expected


def test_what_seems_to_be_a_recording_and_is_not_read_is_named(
    tmp_path: Path, place: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    walk = make_walk(6)
    for name in ("walk1", "no_log", "a/b/c/d/e/walk5"):
        WRITERS["frames_jsonl"].write(place / name, walk)
    (place / "no_log" / "frames.jsonl").unlink()
    write_stray_scanner(place / "no_odometry", walk)
    (place / "no_odometry" / "odometry.csv").unlink()
    write_record3d(tmp_path / "walk4", walk, archive=True)
    with zipfile.ZipFile(place / "download.zip", "w") as archive:
        archive.write(tmp_path / "walk4.r3d", "walk4.r3d")
    (place / "notes").mkdir()
    (place / "notes" / "todo.txt").write_text("none of it")
    (place / "freiburg1_xyz.tgz").touch()
    write_stray_scanner(place / "walk1" / "walk2", walk)
    said = list[str]()
    read_one(place, say=said.append)
    assert said == [
        "not read: a/b/c/d/e (recordings are looked for 5 folders deep), download/walk4 (an archive in an archive: "
        "unpack it), freiburg1_xyz (an archive, but no zip: unpack it), no_log/images (no known format), no_odometry "
        "(no known format), walk1/walk2 (inside another recording: move it out if it's one of its own)"
    ]
    # Also where the first recording can't be used, which stands for none of the others.
    WRITERS["frames_jsonl"].write(place / "walk0", walk)
    (place / "walk0" / "frames.jsonl").write_text("{}")
    lines = list(inspect_capture(place))
    assert lines[0] == said[0] and lines[1].startswith("walk0")
    imported(tmp_path)
    assert said[0] in capsys.readouterr().err


def test_the_video_of_spectacular_ai_is_a_mov_on_ios(tmp_path: Path) -> None:
    walk = make_walk(8)
    WRITERS["spectacular_ai"].write(tmp_path / "walk", walk)
    (tmp_path / "walk" / "data.mp4").rename(tmp_path / "walk" / "data.mov")
    (session,) = sessions_in(tmp_path / "walk")
    assert [image.t_ns for image in session.images] == pytest.approx(walk.t_ns[walk.has_image], abs=1000)


def test_a_second_export_of_rtabmap_in_a_folder_is_named(tmp_path: Path) -> None:
    WRITERS["rtabmap"].write(tmp_path / "walk", make_walk(6))
    shutil.copy(tmp_path / "walk" / "scan_camera_poses.txt", tmp_path / "walk" / "zoom_camera_poses.txt")
    raw = read_one(tmp_path / "walk")
    assert raw.notes == ["not read: zoom_camera_poses.txt; put each export into a folder of its own"]


def test_kitti_poses_beside_the_sequences_are_read(tmp_path: Path) -> None:
    walk, sequence = make_walk(), tmp_path / "place" / "sequences" / "07"
    WRITERS["kitti"].write(sequence, walk)
    (tmp_path / "place" / "poses").mkdir()
    (sequence / "poses.txt").rename(tmp_path / "place" / "poses" / "07.txt")
    raw = read_one(tmp_path / "place")
    assert raw.recording_id == "07" and not raw.is_gravity_aligned
    np.testing.assert_allclose(poses_of(raw.frames), walk.vio_T_cam, atol=1e-9)


@pytest.mark.parametrize(("name", "hidden"), [("stray_scanner", 0), ("stray_scanner", 1), ("scan_capture", 0)])
def test_video_frames_are_joined_to_their_own_poses(tmp_path: Path, place: Path, name: str, hidden: int) -> None:
    walk = make_walk(24)
    WRITERS[name].write(place / "walk", walk)
    if hidden:  # as the app writes it
        walk.write_video(place / "walk" / "rgb.mp4", walk.all, hidden)
    made = imported(tmp_path)
    for row in rows(made["frames"]):
        index = int(np.argmin(np.abs(walk.t_ns - row.t_ns)))
        written = decode_rgb((made.folder / row.image.removeprefix("import:")).read_bytes(), 1000)
        errors = [np.abs(written.astype(int) - image(i)[:, :, ::-1]).mean() for i in range(24)]
        assert int(np.argmin(errors)) == index and errors[index] < 20


def test_where_few_images_have_a_pose_it_is_said_how_all_are_read(tmp_path: Path) -> None:
    WRITERS["nerfstudio"].write(tmp_path / "place", make_walk(8, every=1))
    log = tmp_path / "place" / "transforms.json"
    content = json.loads(log.read_text())
    log.write_text(json.dumps(content | {"frames": content["frames"][:3]}))
    (note,) = (note for note in read_one(tmp_path / "place").notes if "no pose" in note)
    assert note.startswith("5 of 8 images have no pose") and 'format = "photos"' in note


@pytest.mark.parametrize("name", ["record3d", "polycam", "3d_scanner_app"])
def test_poses_made_of_a_recordings_images_yield_to_its_own(tmp_path: Path, name: str) -> None:
    """record3d2nerf.py of instant-ngp and Polycam's polyform write transforms.json into the recording's folder."""
    WRITERS[name].write(folder := tmp_path / "place" / "walk", make_walk(8))
    images = [path.relative_to(folder).as_posix() for path in places(tmp_path, name)]
    frames = [{"file_path": f"./{image}", "transform_matrix": np.eye(4).tolist()} for image in images]
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 300, "cx": 160, "cy": 120, "frames": frames}))
    raw = read_one(tmp_path / "place")
    assert raw.format == name and any("it is nerfstudio transforms.json, too" in note for note in raw.notes)
    assert read_one(tmp_path / "place", "nerfstudio").format == "nerfstudio"


def test_rows_that_only_add_a_tag_are_not_read(tmp_path: Path) -> None:
    walk = make_walk(12)
    WRITERS["arcore_logger"].write(tmp_path / "place", walk)
    file = tmp_path / "place" / "ARCore_sensor_pose.txt"
    comment, *rows = file.read_text().splitlines()
    turned = f"{rows[7].split()[0]} 0 0 -0.707107 0.707107 0 0 0"
    lost = f"{walk.t_ns[9] + 1} 0 0 0 1 0 0 0"
    rows[8:8] = [f"{rows[7]} TAG001 ", f"{turned} TAG001 TAG002"]
    rows[12:12] = [f"{lost} TAG001"]
    file.write_text("\n".join([comment, *rows]))
    (session,) = sessions_in(tmp_path / "place")
    np.testing.assert_allclose(session.poses, walk.vio_T_cam, atol=1e-9)
    assert "2 rows only add a tag" in session.recording.notes[1]
    # A tag without a pose of its time is no repetition: its row is told.
    assert [reject.source for reject in session.rejects] == ["ARCore_sensor_pose.txt line 14"]


def test_older_stray_scanner_has_one_camera_and_a_video_that_starts_elsewhere_is_not_joined(tmp_path: Path) -> None:
    walk, folder = make_walk(24), tmp_path / "place" / "walk"
    write_stray_scanner(folder, walk, per_frame=False)
    (session,) = sessions_in(tmp_path / "place")
    assert {image.camera.fx for image in session.images} == {walk.camera[-1, 0]}
    assert "last frame" in session.recording.notes[0]
    # One frame fewer at the end, besides the first, is told; frames missing in the middle are refused.
    walk.write_video(folder / "rgb.mp4", range(1, 23))
    log = (folder / "odometry.csv").read_text()
    (folder / "odometry.csv").write_text(log.replace(" 000005,", " -99,"))
    reasons = [r.reason for r in rejects_of(sessions_in(tmp_path / "place"))]
    assert reasons == ["video frame is missing or out of order", "video ends before this frame"]
    (folder / "odometry.csv").write_text(log)
    header, *rows = (folder / "odometry.csv").read_text().splitlines()
    numbered = [row.split(", ") for row in rows[:4] + rows[12:]]
    rows = [", ".join([time, f"{n:06d}", *rest]) for n, (time, _, *rest) in enumerate(numbered)]
    (folder / "odometry.csv").write_text("\n".join([header, *rows]))
    with pytest.raises(UserError, match="can't be joined"):
        sessions_in(tmp_path / "place")


def test_a_repeated_frame_number_costs_one_row(tmp_path: Path) -> None:
    write_stray_scanner(tmp_path / "walk", make_walk(24))
    log = tmp_path / "walk" / "odometry.csv"
    log.write_text(log.read_text().replace(" 000009,", " 000008,"))
    (session,) = sessions_in(tmp_path / "walk")
    assert [image.number for image in session.images] == [i for i in range(24) if i != 9]
    assert [reject.reason for reject in session.rejects] == ["odometry.csv line 10 has the same frame number"]


def test_public_data_sets_keep_their_split_and_have_no_vio(tmp_path: Path, place: Path) -> None:
    for n in (1, 2):
        WRITERS["seven_scenes"].write(place / f"seq-0{n}", make_walk(8, seed=n))
    (place / "TrainSplit.txt").write_text("sequence1\n")
    (place / "TestSplit.txt").write_text("sequence2\n")
    raws = [found.read(Limits()) for found in find_recordings(place, tmp_path / "unpacked", Limits())]
    assert [(raw.split, raw.pose_source, raw.is_gravity_aligned) for raw in raws] == [
        ("train", "reference", False),
        ("test", "reference", False),
    ]
    (place / "TestSplit.txt").unlink()
    unlisted = find_recordings(place, tmp_path / "unpacked", Limits())[1].read(Limits())
    assert unlisted.split is None
    assert "TestSplit.txt" in unlisted.notes[0]
    WRITERS["cambridge"].write(tmp_path / "church" / "seq1", make_walk(8))
    assert {frame.split for frame in read_one(tmp_path / "church").frames} == {"train"}


def test_positions_on_earth_are_read_where_they_are_stated(tmp_path: Path) -> None:
    """Of frames.jsonl, and of both versions of ios_logger."""
    WRITERS["frames_jsonl"].write(tmp_path / "place", make_walk(5))
    log = tmp_path / "place" / "frames.jsonl"
    header, *rows = map(json.loads, log.read_text().splitlines())
    rows[0] |= {"latitude_deg": 48.25, "longitude_deg": 11.5, "altitude_m": 515.0, "accuracy_m": 0.02}
    rows[1] |= {"latitude_deg": 48.25, "longitude_deg": 11.5}
    rows[2] |= {"latitude_deg": "north", "longitude_deg": 11.5}
    log.write_text("\n".join(map(json.dumps, [header, *rows])))
    fixes, rejects = there(read_one(tmp_path / "place").read_gps)()
    assert [fix.t_ns for fix in fixes] == [row["t_ns"] for row in rows[:2]] and len(rejects) == 1
    assert (fixes[0].altitude_m, fixes[0].accuracy_m) == (515.0, 0.02) and math.isnan(fixes[1].altitude_m)

    WRITERS["ios_logger"].write(tmp_path / "logger", make_walk(24))
    lines = ["5000,48.1,11.5,4.7,512,3,0,-1,-1", "5001,48.1,11.5", "5002,48.1,11.5,-1,0,-1,0,0,0", "5003,48.1"]
    (tmp_path / "logger" / "GPS.txt").write_text("\n".join(lines))
    (whole, bare), rejects = there(read_one(tmp_path / "logger").read_gps)()
    assert whole == GpsFix(5000 * 10**9, 48.1, 11.5, 512.0, 4.7, 3.0)
    assert (bare.t_ns, bare.latitude_deg, bare.longitude_deg) == (5001 * 10**9, 48.1, 11.5)
    assert np.isnan([bare.accuracy_m, bare.altitude_m, bare.altitude_sd_m]).all()
    assert [reject.source for reject in rejects] == ["GPS.txt line 3", "GPS.txt line 4"]
    assert "an accuracy of -1 m" in rejects[0].reason


def test_real_recordings_are_read(shared_captures: Path, shared_trajectories: Path, tmp_path: Path) -> None:
    found = find_recordings(shared_trajectories, tmp_path, Limits())
    rows = {f"{f.format.id} {f.recording_id}": f.read(Limits()) for f in found}
    assert {name.split()[0] for name in rows} == {"arkit_logger", "arcore_logger", "invisible_map", "spectacular_ai"}
    jumps = {}
    for name, raw in rows.items():
        sessions = sound_sessions(raw, lambda frames: [], 0.5)
        assert not rejects_of(sessions), name
        # ARCore turns its world by some degrees as it starts, hardly moving it.
        jumps[name] = [round(j.jump_m, 1) for s in sessions for j in s.jumps if j.jump_m > 0.1]
        first = sessions[0]
        # Phones are held so that the camera looks more or less ahead: its view axis is rarely vertical.
        assert abs(np.median(first.poses[:, 1, 2])) < 0.95, name
    assert {name: found for name, found in jumps.items() if found} == {
        "invisible_map floor_2_straight": [4.6],
        "arcore_logger arcore_walks-20250527143046-ARCore_sensor_pose": [4.4, 5.2],
    }
    assert len(found) == 23
