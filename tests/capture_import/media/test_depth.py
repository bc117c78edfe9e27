"""Depth images: found by each format, checked, and kept where images are kept."""

import zipfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.capture_import.capture_writers import WRITERS, Walk, imported, make_walk, read_one, write_record3d
from tests.known import read_picture, rows, there

SHAPE = (12, 16)  # that of the images, 72x96


def pixels_of(entry: str, folder: Path) -> np.ndarray:
    """A depth or confidence image of frames' table."""
    return read_picture(folder / entry.removeprefix("import:"), cv2.IMREAD_UNCHANGED)


def depth_mm(index: int) -> np.ndarray:
    return (500 + index + np.arange(SHAPE[0] * SHAPE[1]).reshape(SHAPE)).astype(np.uint16)


# Where each format has depth and confidence of a frame with this number and time, and how much confidence is 1.
PLACES: dict[str, tuple[str, str, int]] = {
    "3d_scanner_app": ("depth_{i:05d}.png", "conf_{i:05d}.png", 1),
    "stray_scanner": ("depth/{i:06d}.png", "confidence/{i:06d}.png", 1),
    "polycam": ("keyframes/depth/{us}.png", "keyframes/confidence/{us}.png", 127),
    "frames_jsonl": ("depth/{i}.png", "", 1),
    "rtabmap": ("scan_depth/{i}.png", "", 1),
}


def write_with_depth(folder: Path, walk: Walk, name: str = "3d_scanner_app", confidence: bool = True) -> None:
    WRITERS[name].write(folder, walk)
    of_depth, of_confidence, step = PLACES[name]
    for i, t_ns in enumerate(walk.t_ns.tolist()):
        pixels = {of_depth: depth_mm(i), of_confidence: np.full(SHAPE, step * (i % 3), np.uint8)}
        for place in (of_depth, of_confidence)[: 1 + (confidence and bool(of_confidence))]:
            path = folder / place.format(i=i, us=t_ns // 1000)
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), pixels[place])
    if name == "frames_jsonl":
        header, *lines = (folder / "frames.jsonl").read_text().splitlines()
        lines = [f'{line[:-1]}, "depth": "depth/{i}.png"}}' for i, line in enumerate(lines)]
        (folder / "frames.jsonl").write_text("\n".join([header, *lines]))


@pytest.mark.parametrize("name", PLACES)
def test_each_frame_has_its_own_depth(tmp_path: Path, name: str) -> None:
    write_with_depth(tmp_path / "place" / "walk", make_walk(8), name)
    frames = read_one(tmp_path / "place").frames
    assert len(frames) == (4 if name == "rtabmap" else 8)  # its export has no poses without an image
    for index, depth in ((there(frame.number), there(frame.depth)) for frame in frames):
        assert (read_picture(depth.path, cv2.IMREAD_UNCHANGED) == depth_mm(index)).all()
        if depth.confidence is not None:
            levels = read_picture(depth.confidence, cv2.IMREAD_UNCHANGED)
            assert set(levels.ravel()) == {(index % 3) * PLACES[name][2]}
        assert (depth.confidence is None) == (not PLACES[name][1])


def test_tum_depth_is_that_nearest_in_time_in_millimetres(tmp_path: Path, place: Path) -> None:
    walk = make_walk(8)
    WRITERS["tum"].write(place, walk)
    (place / "depth").mkdir()
    late_s = [0.015] * 6 + [0.025] * 2  # the last image's beyond what counts as the same time
    for i in range(8):
        cv2.imwrite(str(place / f"depth/{i}.png"), 5 * depth_mm(i))
    lines = [f"{t_ns * 1e-9 + late_s[i]:.6f} depth/{i}.png" for i, t_ns in enumerate(walk.t_ns.tolist())]
    (place / "depth.txt").write_text("# depth maps\n" + "\n".join(reversed(lines)))
    made = imported(tmp_path)
    assert made["rejects"].empty and made["frames"]["depth"].notna().tolist() == [True, True, True, False]
    for i, row in zip(walk.seen[:3], rows(made["frames"]), strict=False):
        assert (pixels_of(row.depth, made.folder) == depth_mm(i)).all()


@pytest.mark.parametrize("images", ["reference", "copy"])
def test_depth_goes_where_images_go(tmp_path: Path, place: Path, images: str) -> None:
    write_with_depth(place / "walk", make_walk(8))
    made = imported(tmp_path, f"images={images!r}")
    assert made["rejects"].empty and made["frames"][["depth", "depth_confidence"]].notna().all(axis=None)
    for row in rows(made["frames"]):
        entries = [row.depth.startswith("import:"), row.depth_confidence.startswith("import:")]
        assert entries == [images == "copy"] * 2
        pixels = pixels_of(row.depth, made.folder if images == "copy" else place)
        assert (pixels == depth_mm(int(row.frame_id[-6:]))).all()


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda p: p.write_bytes(p.read_bytes()[:60]), "can't be decoded"),
        (lambda p: p.write_bytes(b""), "empty"),
        (lambda p: cv2.imwrite(str(p), np.zeros(SHAPE, np.uint8)), "1 channels of 8 bits, not 1 of 16"),
        (lambda p: cv2.imwrite(str(p), np.zeros((16, 12), np.uint16)), "another shape"),
        (lambda p: (p.unlink(), p.symlink_to("/etc/hostname")), "leads out of the capture"),
    ],
)
def test_a_broken_depth_image_costs_the_depth_not_the_frame(
    tmp_path: Path, place: Path, damage: Callable[[Path], object], reason: str
) -> None:
    write_with_depth(place / "walk", make_walk(8), confidence=False)
    damage(place / "walk" / "depth_00002.png")
    made = imported(tmp_path)
    frames, rejects = made["frames"], made["rejects"]
    assert len(frames) == 4
    assert frames.loc[frames["depth"].isna(), "frame_id"].tolist() == ["walk/000002"]
    assert frames["depth_confidence"].isna().all()
    assert rejects["source"].tolist() == ["depth_00002.png"] and reason in rejects["reason"][0]


def depth_m(index: int) -> np.ndarray:
    """`depth_mm` as Record3D has it, with three pixels that have no depth."""
    metres = depth_mm(index).astype(np.float32) / 1000
    metres[0, :3] = [np.nan, np.inf, 100.0]
    return metres


def is_read(entry: str, folder: Path, index: int) -> bool:
    """A depth image that import wrote is `depth_m` in millimetres."""
    pixels = pixels_of(entry, folder)
    expected = depth_mm(index)
    expected[0, :3] = 0
    return pixels.dtype == np.uint16 and bool((pixels == expected).all())


def r3d(folder: Path, walk: Walk, compress: Callable[[bytes], bytes]) -> None:
    write_record3d(folder, walk, archive=True)
    with zipfile.ZipFile(folder.with_suffix(".r3d"), "a") as archive:
        for i in np.flatnonzero(walk.has_image).tolist():
            archive.writestr(f"rgbd/{i}.depth", compress(depth_m(i).tobytes()))
            archive.writestr(f"rgbd/{i}.conf", compress(np.full(SHAPE, i % 3, np.uint8).tobytes()))


def test_depth_of_an_r3d_archive_becomes_png(tmp_path: Path, place: Path) -> None:
    lzfse = pytest.importorskip("liblzfse", reason="pyliblzfse isn't installed (groundwalk[record3d])")
    r3d(place / "walk", make_walk(8, every=1), lzfse.compress)
    made = imported(tmp_path)
    assert made["rejects"].empty and len(made["frames"]) == 8
    for row in rows(made["frames"]):
        index = int(row.frame_id[-6:])
        confidence = pixels_of(row.depth_confidence, made.folder)
        assert is_read(row.depth, made.folder, index)
        assert (confidence == index % 3).all() and confidence.dtype == np.uint8


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda data, compress: compress(data)[: len(compress(data)) // 2], "can't be decoded"),
        (lambda data, compress: b"RVL" + compress(data), "isn't compressed by LZFSE"),
        (lambda data, compress: compress(data[:-4]), "shaped like 96x72"),
    ],
)
def test_broken_lzfse_costs_the_depth_not_the_frame(
    tmp_path: Path, place: Path, damage: Callable[[bytes, Callable[[bytes], bytes]], bytes], reason: str
) -> None:
    lzfse = pytest.importorskip("liblzfse", reason="pyliblzfse isn't installed (groundwalk[record3d])")
    r3d(place / "walk", make_walk(8), lambda data: damage(data, lzfse.compress))
    made = imported(tmp_path)
    assert len(made["frames"]) == 4 and made["frames"]["depth"].isna().all()
    assert made["rejects"]["reason"].str.contains(reason).all() and len(made["rejects"]) == 4


def test_depth_of_an_exported_folder_is_read_where_exr_is_turned_on(
    tmp_path: Path, place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = place / "walk"
    monkeypatch.setenv("OPENCV_IO_ENABLE_OPENEXR", "1")
    write_record3d(folder, make_walk(8))
    (folder / "depth").mkdir()
    for i in range(8):
        cv2.imwrite(str(folder / "depth" / f"{i}.exr"), depth_m(i), [cv2.IMWRITE_EXR_TYPE, cv2.IMWRITE_EXR_TYPE_FLOAT])
    monkeypatch.delenv("OPENCV_IO_ENABLE_OPENEXR")
    raw = read_one(folder)
    assert not any(frame.depth for frame in raw.frames)
    assert any("OPENCV_IO_ENABLE_OPENEXR=1" in note for note in raw.notes)
    monkeypatch.setenv("OPENCV_IO_ENABLE_OPENEXR", "1")
    made = imported(tmp_path)
    frames = made["frames"]
    assert made["rejects"].empty and frames["depth"].notna().all() and frames["depth_confidence"].isna().all()
    assert all(is_read(row.depth, made.folder, int(row.frame_id[-6:])) for row in rows(frames))


def test_without_a_decoder_the_note_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    r3d(tmp_path / "place" / "walk", make_walk(8), lambda data: b"bvx-" + data)
    monkeypatch.setattr("groundwalk.capture_import.media.depth.find_spec", lambda name: None)
    raw = read_one(tmp_path / "place")
    assert len(raw.frames) == 8 and not any(frame.depth for frame in raw.frames)
    assert any("pip install 'groundwalk[record3d]'" in note for note in raw.notes)


def test_the_real_phone_with_lidar_has_depth_of_all_images(shared_captures: Path) -> None:
    folder = shared_captures / "charuco" / "test-lowres"
    if not folder.is_dir():
        pytest.skip("no capture with depth")
    with_image = [frame for frame in read_one(folder).frames if frame.image is not None]
    assert len(with_image) == 31 and all(frame.depth and frame.depth.confidence for frame in with_image)
