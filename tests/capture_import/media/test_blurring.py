"""What may tell who was there doesn't get into artefacts: metadata, and faces and plates where that is asked for."""

import io
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pandas as pd
import PIL.Image
import pytest

from groundwalk.capture_import.media.blurring import Blurring, FaceDetector, Region, blurred, read_boxes
from groundwalk.capture_import.media.images import decode_rgb
from groundwalk.geometry.poses import make_pose
from groundwalk.store import UserError
from groundwalk.store.images import without_metadata
from tests.capture_import.capture_writers import (
    Walk,
    image,
    imported,
    jpeg,
    make_walk,
    write_scanner_app,
    write_stray_scanner,
)
from tests.known import rows, there

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


def walk_with_faces(count: int, of: Sequence[int], quarters: int = 0) -> Walk:
    """A walk with a portrait in some of its images, as a sensor has them that is turned by so many quarters."""
    walk = make_walk(count, every=1)
    pictures = np.full((count, 360, 480, 3), 90, np.uint8)
    pictures[:, ::2, ::3] = 110
    pictures[:, :8, :8] = np.arange(count)[:, None, None, None]  # a camera that stands still is another matter
    pictures[[*of], 40:220, 160:314] = cv2.resize(portrait(), (154, 180), interpolation=cv2.INTER_AREA)[:, :, ::-1]
    camera = np.tile([400.0, 400.0, *([180.0, 240.0] if quarters else [240.0, 180.0])], (count, 1))
    clockwise = make_pose([[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0, 0, 0]) if quarters else np.eye(4)
    pictures = np.rot90(pictures, quarters, (1, 2))
    return replace(walk, vio_T_cam=walk.vio_T_cam @ clockwise, pictures=pictures, camera=camera)


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


@pytest.mark.parametrize("how", [{}, {"progressive": True}, {"restart_marker_blocks": 2}])
def test_what_lies_behind_a_jpegs_end_goes(how: dict[str, int]) -> None:
    """A phone's second picture, whose EXIF says where, or its video; a JPEG with nothing there stays to the byte."""
    picture, written, pair = PIL.Image.fromarray(portrait()), io.BytesIO(), io.BytesIO()
    picture.save(written, "JPEG", **how)
    data = written.getvalue()
    assert without_metadata(data) == data and without_metadata(data[:-2]) == data[:-2]
    assert without_metadata(data + b"\0\0\0\x18ftypmp42" + PLACE) == data
    assert without_metadata(data + jpeg_with_metadata(3)) == data
    picture.save(pair, "MPO", save_all=True, append_images=[picture], **how)
    assert without_metadata(pair.getvalue()).count(b"\xff\xd8\xff") == 1


def test_copied_images_tell_no_place(tmp_path: Path, place: Path) -> None:
    write_scanner_app(place / "walk", make_walk())
    for path in (place / "walk").glob("*.jpg"):
        path.write_bytes(jpeg_with_metadata(int(path.stem[-5:])))
    made = imported(tmp_path, "images='copy'")
    assert len(list((made.folder / "images").rglob("*.jpg"))) == 12
    assert not any(PLACE in path.read_bytes() for path in made.folder.rglob("*") if path.is_file())
    assert made["frames"][["blurred_faces", "blurred_plates"]].isna().all(axis=None)


@pytest.mark.parametrize("quarters", [0, 1, 2, 3])
def test_what_a_detector_finds_is_erased_where_it_is(quarters: int) -> None:
    upright = np.random.default_rng(5).integers(0, 255, (300, 400, 3), dtype=np.uint8)
    stored = np.ascontiguousarray(np.rot90(upright, quarters))

    def detect(rgb: np.ndarray) -> list[Region]:
        np.testing.assert_array_equal(rgb, upright)
        return [Region("face", 120, 80, 60, 50), Region("face", 390, 290, 40, 40)]

    regions = there(Blurring(detect).regions("walk/000000", stored, quarters))
    erased = blurred(stored, regions)
    assert erased.shape == stored.shape
    back = np.rot90(erased, -quarters)
    inside = np.zeros((300, 400), bool)
    inside[70:140, 108:192] = True  # widened by a fifth
    inside[282:, 382:] = True
    np.testing.assert_array_equal(back[~inside], upright[~inside])
    # What is left of the face is as smooth as a few averaged colours.
    assert np.abs(np.diff(back[80:130, 120:180].astype(int), axis=1)).mean() < 4
    assert np.abs(np.diff(upright[80:130, 120:180].astype(int), axis=1)).mean() > 60


def test_boxes_corrected_by_hand_are_blurred_and_no_others(tmp_path: Path, place: Path) -> None:
    """What import found is in a table; a row taken out isn't blurred again, one put in is, as a spreadsheet writes it;
    detectors look at images that the table doesn't list."""
    write_scanner_app(place / "walk", walk_with_faces(6, (1, 3, 5)))
    found = pd.read_csv(imported(tmp_path, "blur=true").folder / "blurred.csv", keep_default_na=False)
    with_face = found.loc[found["kind"] == "face", "frame_id"].str[-1]
    assert found["frame_id"].nunique() == 6 and set(with_face) == {"1", "3", "5"}
    rows = found[(found["frame_id"] != "walk/000005") & (found["kind"] == "")].to_dict("records")
    rows += [{"frame_id": "walk/000001", "kind": ""}]  # not this one
    rows += [{"frame_id": "walk/000003", "kind": "plate", "x": 300, "y": 250, "width": 80, "height": 30}]
    rows += [{"frame_id": "walk/999999", "kind": "face", "x": 1, "y": 1, "width": 8, "height": 8}]
    pd.DataFrame(rows).to_csv(tmp_path / "boxes.csv", sep=";", index=False, encoding="utf-8-sig")
    made = imported(tmp_path, "blur=true", "blur_boxes=boxes.csv")
    frames = made["frames"]
    assert frames["blurred_faces"].tolist()[:5] == [0] * 5 and frames["blurred_faces"].tolist()[5] > 0
    assert frames["blurred_plates"].tolist() == [0, 0, 0, 1, 0, 0]
    assert [entry.startswith("import:") for entry in frames["image"]] == [False, False, False, True, False, True]
    shown = decode_rgb((made.folder / frames["image"][3].removeprefix("import:")).read_bytes(), 1000).astype(int)
    assert np.abs(np.diff(shown[255:275, 310:370], axis=0)).mean() < 4 < np.abs(np.diff(shown[60:200, 180:300])).mean()
    alone = imported(tmp_path, "blur_boxes=boxes.csv")["frames"]
    assert alone["blurred_plates"].isna().tolist() == [False] * 5 + [True]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("frame_id,kind\n", "no column x"),
        ("frame_id,kind,x,y,width,height\na/000001,nose,1,1,5,5\n", "line 2: nose"),
        ("frame_id,kind,x,y,width,height\na/000001,face,1,1,,5\n", "line 2: face, 1, 1, , 5"),
        ("frame_id,kind,x,y,width,height\na/000001,face\n", "line 2: face, None"),
        ("frame_id;kind;x;y;width;height\na/000001;face;1,5;1;5;5\n", "line 2: face, 1,5, 1, 5, 5"),
        ("", "no column frame_id"),
    ],
)
def test_a_table_of_boxes_that_cannot_be_read_is_named(tmp_path: Path, text: str, said: str) -> None:
    (tmp_path / "boxes.csv").write_text(text)
    with pytest.raises(UserError, match=said):
        read_boxes(tmp_path / "boxes.csv")


@pytest.mark.parametrize(
    ("write", "quarters"), [(write_scanner_app, 0), (write_stray_scanner, 0), (write_scanner_app, 1)]
)
def test_the_blurring_of_a_face_is_in_the_artefact(
    tmp_path: Path, place: Path, write: Callable[[Path, Walk], object], quarters: int
) -> None:
    """The whole way with the real detector: found in what gravity says is upright, counted at its frame, erased in the
    image that is written, which stays as the sensor has it."""
    write(place / "walk", walk_with_faces(10, (2, 7), quarters))
    made = imported(tmp_path, "blur=true")
    frames = made["frames"]
    assert np.flatnonzero(frames["blurred_faces"] > 0).tolist() == [2, 7]
    assert made.figures["blurred_faces"] == frames["blurred_faces"].sum()
    detect = FaceDetector()
    for row in rows(frames):
        assert row.image.startswith("import:") == (row.blurred_faces > 0 or write is write_stray_scanner)
        if row.blurred_faces:
            written = decode_rgb((made.folder / row.image.removeprefix("import:")).read_bytes(), 1000)
            upright = np.ascontiguousarray(np.rot90(written, -quarters))
            assert upright.shape == (360, 480, 3) and not detect(upright)


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
            box = [-4.0, 20, 60, 80, *[0.0] * 10, 0.75]
            return 1, np.array([box], np.float32) if bgr.shape[1] == self.width > 64 and bgr[0, 0, 0] > 200 else None

    monkeypatch.setattr(cv2.FaceDetectorYN, "create", lambda *_: Faces())
    detect = FaceDetector(tmp_path / "yunet.onnx")
    assert not detect(decode_rgb(jpeg_with_metadata(0), 2**31))
    blue = np.full((360, 480, 3), (0, 0, 255), np.uint8)
    assert detect(blue) == [Region("face", -4, 20, 60, 80, 0.75)]
    blue[20:100:2] = 0
    erased = blurred(blue, detect(blue))
    assert np.abs(np.diff(erased[30:90, 5:50].astype(int), axis=0)).max() < 60


@pytest.mark.parametrize("content", [None, b"no network"])
def test_a_face_model_that_cannot_be_used_is_named(tmp_path: Path, place: Path, content: bytes | None) -> None:
    write_scanner_app(place / "walk", make_walk())
    if content:
        (tmp_path / "yunet.onnx").write_bytes(content)
    with pytest.raises(UserError, match="face detector's file can't be used" if content else "settings of scene place"):
        imported(tmp_path, "blur=true", "face_model=yunet.onnx")
    assert not (tmp_path / "runs" / "tiny" / "place" / "import").exists()
