"""What may tell who was there doesn't get into artefacts: metadata, and faces and plates where that is asked for."""

import struct
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pandas as pd
import pytest

from groundwalk.capture_import.definition import STAGE
from groundwalk.capture_import.media.blurring import PeopleDetector, Region, blur_people
from groundwalk.capture_import.media.images import decode_rgb
from groundwalk.geometry.poses import make_pose
from groundwalk.store import DataRoot, UserError, execute
from groundwalk.store.images import without_metadata
from groundwalk.store.manifests import load_manifest
from tests.capture_import.capture_writers import (
    Walk,
    image,
    jpeg,
    make_walk,
    write_scanner_app,
    write_stray_scanner,
)
from tests.known import rows

PLACE = b"48.123456N 11.654321E"


def jpeg_with_metadata(index: int) -> bytes:
    """A JPEG with Exif, XMP, IPTC and a comment, all of which name a place, and with a colour profile."""
    data = jpeg(index)
    segments = [
        (0xE1, b"Exif\0\0" + PLACE),
        (0xE1, b"http://ns.adobe.com/xap/1.0/\0" + PLACE),
        (0xE2, b"MPF\0" + PLACE),
        (0xE2, b"ICC_PROFILE\0\1\1kept"),
        (0xED, b"Photoshop 3.0\0" + PLACE),
        (0xFE, PLACE),
    ]
    extra = b"".join(struct.pack(">BBH", 0xFF, marker, len(body) + 2) + body for marker, body in segments)
    return data[:2] + extra + data[2:]


def portrait() -> np.ndarray:
    """A face (H, W, 3): public domain, of matplotlib's sample data."""
    return decode_rgb((Path(matplotlib.get_data_path()) / "sample_data/grace_hopper.jpg").read_bytes(), 2**31)


def png_with_metadata(index: int) -> bytes:
    data = cv2.imencode(".png", image(index))[1].tobytes()
    chunks = b""
    for name in (b"tEXt", b"eXIf", b"iTXt"):
        body = name + b"where\0" + PLACE
        chunks += struct.pack(">I", len(body) - 4) + body + struct.pack(">I", zlib.crc32(body))
    header_end = 8 + 25
    return data[:header_end] + chunks + data[header_end:]


@pytest.mark.parametrize("write", [jpeg_with_metadata, png_with_metadata])
def test_metadata_goes_and_pixels_stay(write: Callable[[int], bytes]) -> None:
    data = write(3)
    bare = without_metadata(data)
    assert PLACE in data and PLACE not in bare
    assert b"ICC_PROFILE" in bare or write is png_with_metadata
    np.testing.assert_array_equal(decode_rgb(bare, 1000), decode_rgb(data, 1000))
    assert without_metadata(bare) == bare


def test_copied_images_tell_no_place(tmp_path: Path) -> None:
    folder = tmp_path / "captures" / "place" / "walk"
    write_scanner_app(folder, make_walk())
    for path in folder.glob("*.jpg"):
        path.write_bytes(jpeg_with_metadata(int(path.stem[-5:])))
    artefact = execute(STAGE, "place", "tiny", DataRoot(tmp_path), ["images='copy'"])
    assert len(list((artefact / "images").rglob("*.jpg"))) == 12
    assert not any(PLACE in path.read_bytes() for path in artefact.rglob("*") if path.is_file())
    frames = pd.read_parquet(artefact / "frames.parquet")
    assert frames[["blurred_faces", "blurred_plates"]].isna().all(axis=None)


@pytest.mark.parametrize("quarters", [0, 1])
def test_what_a_detector_finds_is_erased_where_it_is(quarters: int) -> None:
    upright = np.random.default_rng(5).integers(0, 255, (300, 400, 3), dtype=np.uint8)
    stored = np.ascontiguousarray(np.rot90(upright, quarters))
    region = Region("face", 120, 80, 60, 50)

    def detect(rgb: np.ndarray) -> list[Region]:
        np.testing.assert_array_equal(rgb, upright)
        return [region, Region("plate", 390, 290, 40, 40)]

    blurred, regions = blur_people(stored, detect, quarters)
    assert regions[0] == region and blurred.shape == stored.shape
    back = np.rot90(blurred, -quarters)
    inside = np.zeros((300, 400), bool)
    inside[70:140, 108:192] = True  # widened by a fifth
    inside[282:, 382:] = True
    np.testing.assert_array_equal(back[~inside], upright[~inside])
    # What is left of the face is as smooth as a few averaged colours.
    assert np.abs(np.diff(back[80:130, 120:180].astype(int), axis=1)).mean() < 4
    assert np.abs(np.diff(upright[80:130, 120:180].astype(int), axis=1)).mean() > 60


@pytest.mark.parametrize(
    ("write", "quarters"), [(write_scanner_app, 0), (write_stray_scanner, 0), (write_scanner_app, 1)]
)
def test_the_blurring_of_a_face_is_in_the_artefact(
    tmp_path: Path, write: Callable[[Path, Walk], object], quarters: int
) -> None:
    """The whole way with the real detector: found in what gravity says is upright, counted at its frame, erased in the
    image that is written, which stays as the sensor has it."""
    walk = make_walk(10, every=1)
    pictures = np.full((10, 360, 480, 3), 90, np.uint8)
    pictures[:, ::2, ::3] = 110
    for i in (2, 7):
        pictures[i, 40:220, 160:314] = cv2.resize(portrait(), (154, 180), interpolation=cv2.INTER_AREA)[:, :, ::-1]
    camera = np.tile([400.0, 400.0, *([180.0, 240.0] if quarters else [240.0, 180.0])], (10, 1))
    clockwise = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0, 0, 0]) if quarters else np.eye(4)
    pictures, walk = np.rot90(pictures, quarters, (1, 2)), replace(walk, vio_T_cam=walk.vio_T_cam @ clockwise)
    write(tmp_path / "captures" / "place" / "walk", replace(walk, pictures=pictures, camera=camera))
    artefact = execute(STAGE, "place", "tiny", DataRoot(tmp_path), ["blur=true"])
    frames = pd.read_parquet(artefact / "frames.parquet")
    assert np.flatnonzero(frames["blurred_faces"] > 0).tolist() == [2, 7]
    assert load_manifest(artefact)["figures"]["blurred_faces"] == frames["blurred_faces"].sum()
    detect = PeopleDetector()
    for row in rows(frames):
        assert row.image.startswith("import:") == (row.blurred_faces > 0 or write is write_stray_scanner)
        if row.blurred_faces:
            written = decode_rgb((artefact / row.image.removeprefix("import:")).read_bytes(), 1000)
            upright = np.ascontiguousarray(np.rot90(written, -quarters))
            assert upright.shape == (360, 480, 3) and not [r for r in detect(upright) if r.kind == "face"]


def test_blur_without_detectors_stops_before_any_work(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_scanner_app(tmp_path / "captures" / "place" / "walk", make_walk(6))
    monkeypatch.setattr(cv2.data, "haarcascades", str(tmp_path))
    with pytest.raises(UserError, match="detectors that blur needs"):
        execute(STAGE, "place", "tiny", DataRoot(tmp_path), ["blur=true"])


def test_a_drawn_plate_is_found() -> None:
    rgb = np.full((800, 1200, 3), (40, 45, 60), np.uint8)
    rgb[400:440, 500:686] = 245
    cv2.putText(rgb, "M AB 1234", (510, 432), cv2.FONT_HERSHEY_SIMPLEX, 0.95, (15, 15, 15), 3, cv2.LINE_AA)
    found = PeopleDetector()(rgb)
    assert any(r.kind == "plate" and r.x < 593 < r.x + r.width and r.y < 420 < r.y + r.height for r in found)


def test_a_turn_in_a_pngs_exif_is_left_out() -> None:
    data = cv2.imencode(".png", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
    turned = b"MM\0*" + struct.pack(">IHHHIHHI", 8, 1, 0x0112, 3, 1, 6, 0, 0)
    chunk = struct.pack(">I", len(turned)) + b"eXIf" + turned + struct.pack(">I", zlib.crc32(b"eXIf" + turned))
    assert decode_rgb(data[:33] + chunk + data[33:], 1000).shape == (48, 64, 3)


def test_faces_are_found_by_a_named_model_in_place_of_cascades(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Faces:
        def setInputSize(self, size: tuple[int, int]) -> None:
            self.width = size[0]

        def detect(self, bgr: np.ndarray) -> tuple[int, np.ndarray | None]:
            box = [-4.0, 20, 60, 80, *[0.0] * 10, 0.9]
            return 1, np.array([box], np.float32) if bgr.shape[1] == self.width > 64 and bgr[0, 0, 0] > 200 else None

    monkeypatch.setattr(cv2.FaceDetectorYN, "create", lambda *_: Faces())
    detect = PeopleDetector(tmp_path / "yunet.onnx")
    assert not detect(decode_rgb(jpeg_with_metadata(0), 2**31))
    blue = np.full((360, 480, 3), (0, 0, 255), np.uint8)
    assert detect(blue) == [Region("face", -4, 20, 60, 80)]
    blue[20:100:2] = 0
    erased, _ = blur_people(blue, detect, quarters=0)
    assert np.abs(np.diff(erased[30:90, 5:50].astype(int), axis=0)).max() < 60


@pytest.mark.parametrize("content", [None, b"no network"])
def test_a_face_model_that_cannot_be_used_is_named(tmp_path: Path, content: bytes | None) -> None:
    write_scanner_app(tmp_path / "captures" / "place" / "walk", make_walk())
    if content:
        (tmp_path / "yunet.onnx").write_bytes(content)
    with pytest.raises(UserError, match="face detector's file can't be used" if content else "settings of scene place"):
        execute(STAGE, "place", "tiny", DataRoot(tmp_path), ["blur=true", "face_model=yunet.onnx"])
    assert not (tmp_path / "runs" / "tiny" / "place" / "import").exists()
