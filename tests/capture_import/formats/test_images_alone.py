"""Photos and videos without poses: EXIF, cameras, turns, order, what is left out, and when they are looked for."""

import io
from collections.abc import Callable
from datetime import datetime, timedelta
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import PIL.ExifTags
import PIL.Image
import PIL.PngImagePlugin
import pillow_heif
import pytest

from groundwalk.capture_import.inspection import inspect_capture
from groundwalk.store import UserError
from groundwalk.store.images import image_file
from groundwalk.store.schemas import schema
from groundwalk.store.tables import read_table
from tests.capture_import.capture_writers import Imported, image, imported, read_one
from tests.known import there

WIDTH, HEIGHT = 320, 240
BASE: Any = PIL.ExifTags.Base


def write_photo(
    path: Path,
    index: int = 0,
    turns: int = 0,
    size: tuple[int, int] = (WIDTH, HEIGHT),
    xmp: bytes = b"",
    **exif: object,
) -> None:
    """A picture as it's to be seen, stored so many quarter turns anticlockwise; EXIF's tags by their names, and XMP."""
    path.parent.mkdir(parents=True, exist_ok=True)
    stored = np.rot90(image(index, *size)[..., ::-1], turns)
    content = PIL.Image.Exif()
    details = content.get_ifd(PIL.ExifTags.IFD.Exif)
    for name, value in exif.items():
        (content if name in ("Make", "Model", "Orientation") else details)[BASE[name]] = value
    content[BASE.ExifOffset] = details
    buffer = io.BytesIO()
    PIL.Image.fromarray(np.ascontiguousarray(stored)).save(
        buffer, "PNG" if path.suffix == ".png" else "JPEG", quality=95, exif=content, xmp=xmp
    )
    path.write_bytes(buffer.getvalue())


def images_of(made: Imported, place: Path) -> list[bytes]:
    """The images of the frames in their order."""
    return [image_file(entry, place, made.folder).read_bytes() for entry in made["frames"]["image"]]


def off(data: bytes, index: int, turns: int = 0) -> float:
    """How far an image is from the picture of this index, turned: of 80 grey levels where it is another one or turned
    otherwise, below 25 where it is this one, as JPEG and videos blur colours."""
    shown = there(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION))
    return float(np.abs(shown.astype(float) - np.rot90(image(index, WIDTH, HEIGHT), -turns)).mean())


@pytest.mark.parametrize(
    ("orientation", "turns", "first_row"), [(6, 1, "bottom"), (3, 2, "bottom"), (8, 3, "top")]
)  # of high images, as these are stored for (6, 1) and (8, 3), it's the right side
def test_orientation_is_applied_once(tmp_path: Path, place: Path, orientation: int, turns: int, first_row: str) -> None:
    for n in range(6):
        write_photo(place / f"IMG_{n}.jpg", n, turns, Orientation=orientation)
    tables = imported(tmp_path)
    frames = tables["frames"]
    assert len(frames) == 6 and set(zip(frames["width"], frames["height"], strict=True)) == {(WIDTH, HEIGHT)}
    assert (frames[["cx", "cy"]] == [WIDTH / 2, HEIGHT / 2]).all(axis=None) and set(frames["first_row"]) == {first_row}
    for n, data in enumerate(images_of(tables, place)):
        assert off(data, n) < 25
        with PIL.Image.open(io.BytesIO(data)) as shown:
            assert shown.getexif().get(BASE.Orientation, 1) == 1


def test_cameras_are_grouped_and_their_names_stay(tmp_path: Path, place: Path) -> None:
    secret: dict[str, Any] = {"Make": "Maker", "Model": "SecretPhone 7", "LensModel": "SecretLens"}
    for n in range(4):
        write_photo(place / f"a{n}.jpg", n, FocalLengthIn35mmFilm=26, **secret)
        write_photo(place / f"b{n}.jpg", 10 + n, turns=1, Orientation=6, FocalLengthIn35mmFilm=26, **secret)
        write_photo(place / f"c{n}.jpg", 20 + n, FocalLengthIn35mmFilm=13, DigitalZoomRatio=0.0, **secret)
        # 5 mm on a sensor of 500 pixels a centimetre, of which the photo is a copy of half the size.
        plane: dict[str, Any] = {"FocalPlaneXResolution": 500.0, "FocalPlaneResolutionUnit": 3, "ExifImageWidth": 640}
        write_photo(place / f"d{n}.jpg", 30 + n, Model="Other", FocalLength=10.0, ExifImageHeight=480, **plane)
        # Zoomed by pixels alone, of which some makers' focal lengths know nothing.
        write_photo(place / f"f{n}.jpg", 50 + n, FocalLengthIn35mmFilm=26, DigitalZoomRatio=3.0, **secret)
        # Cropped to another shape: EXIF says nothing of it.
        write_photo(
            place / f"e{n}.jpg", 40 + n, Model="Crop", FocalLengthIn35mmFilm=26, ExifImageWidth=400, ExifImageHeight=240
        )
    tables = imported(tmp_path)
    sessions, frames = tables["sessions"], tables["frames"]
    assert list(sessions["session_id"]) == ["place", *(f"place.camera{k}" for k in (2, 3, 4, 5))]
    assert list(sessions["frames"]) == [8, 4, 4, 4, 4]
    assert list(sessions["device"]) == [f"camera {k}" for k in (1, 2, 3, 4, 5)]
    assert set(sessions["pose_source"]) == {"none"} and sessions["reference_unit"].isna().all()
    assert len(tables["reference"]) == len(tables["vio"]) == 0 and frames["vio_cam_tx"].isna().all()
    diagonal = np.hypot(WIDTH, HEIGHT) / np.hypot(36, 24)
    guess = (1.2 * WIDTH, 0.5)
    for session, (focal_px, sd) in zip(
        sessions["session_id"], [(26 * diagonal, 0.05), (13 * diagonal, 0.05), (250.0, 0.05), guess, guess], strict=True
    ):
        rows = frames[frames["session_id"] == session]
        assert rows["fx"].to_numpy() == pytest.approx(focal_px) and set(rows["focal_sd"]) == {sd}
    run = tmp_path / "runs" / "tiny" / "place" / "import"
    assert not any(b"Secret" in path.read_bytes() for path in run.rglob("*") if path.is_file())


def test_dates_are_an_order_and_not_times(tmp_path: Path) -> None:
    start = datetime(2024, 5, 1, 12)
    for n in range(6):
        date = (start + timedelta(seconds=-n // 2)).strftime("%Y:%m:%d %H:%M:%S")
        write_photo(
            tmp_path / "dated" / f"{n}.jpg", n, Model="P", DateTimeOriginal=date, SubsecTimeOriginal=f"{9 - n}0"
        )
        dated_photo: dict[str, Any] = {"DateTimeOriginal": date} if n else {}
        write_photo(tmp_path / "names" / f"IMG_{n + 8}.jpg", n, Model="P", **dated_photo)
    dated, names = read_one(tmp_path / "dated"), read_one(tmp_path / "names")
    assert [frame.source for frame in dated.frames] == [f"{n}.jpg" for n in reversed(range(6))]
    assert [frame.source for frame in names.frames] == [f"IMG_{n}.jpg" for n in range(8, 14)]
    assert not dated.clock.has_times and "the order of their dates" in dated.notes[0]


def test_what_is_no_photo_is_named(tmp_path: Path) -> None:
    for n in range(4):
        write_photo(tmp_path / "place" / f"IMG_{n}.jpg", n, Model="P")
    write_photo(tmp_path / "place" / "Screenshot.png", 5)
    write_photo(tmp_path / "place" / "pano.jpg", 6, size=(900, 200), Model="P")
    write_photo(tmp_path / "place" / "selfie.jpg", 7, Model="P", Orientation=2)
    write_photo(tmp_path / "place" / "IMG_20.jpg", 8, size=(234, 507))
    write_photo(tmp_path / "place" / "IMG-WA1.jpg", 11, size=(320, 180))  # as messengers send photos
    write_photo(tmp_path / "place" / "short_pano.jpg", 9, size=(480, 240), Model="P", CustomRendered=6)
    write_photo(tmp_path / "place" / "PANO.jpg", 10, Model="P", xmp=b'<a GPano:ProjectionType="cylindrical"/>')
    for name in ("._IMG_1.jpg", "._IMG_1.MOV"):  # macOS's attributes
        (tmp_path / "place" / name).write_bytes(b"\0\5\x16\7")
    (tmp_path / "place" / "b.webp").touch()
    (tmp_path / "place" / "a.dng").touch()
    (tmp_path / "place" / "IMG_9.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    (tmp_path / "place" / "empty.jpg").touch()
    for name in ("IMG_1.MOV", "clips/IMG_2.MOV"):
        (tmp_path / "place" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "place" / name).touch()
    (tmp_path / "place" / "CameraTrajectory.txt").write_text("0.1,1,2,3,0,0,0,1\n")
    raw = read_one(tmp_path / "place")
    assert {frame.source for frame in raw.frames} == {"IMG-WA1.jpg", *(f"IMG_{n}.jpg" for n in range(4))}
    reasons = {reject.source: reject.reason for reject in raw.rejects}
    for name, part in {
        "Screenshot.png": "a screenshot",
        "IMG_20.jpg": "image of 234x507 without a camera in its EXIF",
        "pano.jpg": "is a panorama",
        "short_pano.jpg": "is a panorama",
        "PANO.jpg": "is a panorama",
        "selfie.jpg": "mirrored",
        "IMG_9.HEIC": "the HEIC can't be decoded",
        "empty.jpg": "image is empty",
    }.items():
        assert part in reasons.pop(name)
    assert not reasons and any("2 videos" in note and "2 pictures that" in note for note in raw.notes)
    assert "1 logs, such as CameraTrajectory.txt" in raw.notes[-1]


def test_a_png_with_a_text_named_xmp_is_read(tmp_path: Path) -> None:
    text = PIL.PngImagePlugin.PngInfo()
    text.add_text("xmp", "<x/>")
    (tmp_path / "place").mkdir()
    for n in range(3):
        PIL.Image.fromarray(image(n, WIDTH, HEIGHT)).save(tmp_path / "place" / f"{n}.png", pnginfo=text)
    raw = read_one(tmp_path / "place")
    assert len(raw.frames) == 3 and not raw.rejects


def test_of_copies_the_one_whose_focal_length_is_stated_is_kept(tmp_path: Path, place: Path) -> None:
    """As messengers send them, without EXIF, under names that come first."""
    for n in range(4):
        write_photo(place / f"IMG_{n}.jpg", n, Model="P", FocalLengthIn35mmFilm=26)
        write_photo(place / f"IMG-WA{n}.jpg", n)
    tables = imported(tmp_path)
    assert set(tables["frames"]["focal_sd"]) == {0.05} and len(tables["frames"]) == 4
    assert tables["rejects"]["source"].str.startswith("IMG-WA").all() and len(tables["rejects"]) == 4


def test_heic_is_read_upright_and_written_as_jpeg(tmp_path: Path, place: Path) -> None:
    place.mkdir()
    exif = PIL.Image.Exif()
    exif[BASE.Model], exif[BASE.Orientation] = "SecretPhone", 6
    exif.get_ifd(PIL.ExifTags.IFD.Exif)[BASE.FocalLengthIn35mmFilm] = 26
    for n in range(4):
        picture = PIL.Image.fromarray(np.ascontiguousarray(np.rot90(image(n, WIDTH, HEIGHT)[..., ::-1])))
        file = place / f"IMG_{n}.{'HEIC' if n else 'jpg'}"
        pillow_heif.from_pillow(picture).save(file, exif=exif.tobytes(), quality=95)
    (place / "IMG_9.HEIC").write_bytes((place / "IMG_1.HEIC").read_bytes()[:900])
    tables = imported(tmp_path)
    frames = tables["frames"]
    assert len(frames) == 4 and set(zip(frames["width"], frames["height"], strict=True)) == {(WIDTH, HEIGHT)}
    assert frames["fx"].to_numpy() == pytest.approx(26 * np.hypot(WIDTH, HEIGHT) / np.hypot(36, 24))
    assert "IMG_9.HEIC" in tables["rejects"]["source"][0]
    for n, data in enumerate(images_of(tables, place)):
        assert data.startswith(b"\xff\xd8") and b"Secret" not in data and off(data, n) < 25


@pytest.mark.parametrize("name", ["images", "input", "frames", "photos", "."])
def test_photos_are_found_in_the_usual_folders(tmp_path: Path, name: str) -> None:
    for n in range(3):
        write_photo(tmp_path / "walk" / name / f"{n}.jpg", n)
        write_photo(tmp_path / "walk" / "images_2" / f"{n}.jpg", n)
    raw = read_one(tmp_path / "walk")
    assert (raw.recording_id, raw.format, len(raw.frames)) == ("walk", "photos", 3)
    assert any("3 images of images_2/" in note for note in raw.notes)


def test_photos_beside_a_log_are_read_only_where_asked_for(tmp_path: Path) -> None:
    for n in range(3):
        write_photo(tmp_path / "walk" / f"{n}.jpg", n)
    (tmp_path / "walk" / "log.json").write_text('{"cameraPose": [1, 0, 0]}')
    with pytest.raises(UserError, match=r'(?s)log\.json seems to hold poses.*format = "photos"'):
        read_one(tmp_path / "walk")
    assert len(read_one(tmp_path / "walk", "photos").frames) == 3


def write_video(
    path: Path,
    times_s: list[float],
    rotation: int = 0,
    blur: float = 0.0,
    picture_of: Callable[[int], np.ndarray] = lambda n: image(n, WIDTH, HEIGHT),
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", format="mov") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "10"})
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.time_base = stream.time_base = Fraction(1, 600)
        stream.set_display_rotation(rotation)
        for n, time_s in enumerate(times_s):
            picture = picture_of(n)
            if blur:
                picture = cv2.GaussianBlur(picture, (0, 0), blur)
            frame = av.VideoFrame.from_ndarray(picture, "bgr24")
            frame.pts, frame.time_base = round(time_s * 600), Fraction(1, 600)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


@pytest.mark.parametrize(("rotation", "turns"), [(0, 0), (-90, 1), (180, 2)])
def test_a_video_is_turned_and_has_its_own_times(tmp_path: Path, place: Path, rotation: int, turns: int) -> None:
    times_s = [0.0, 0.4, 1.5, 1.6, 2.2, 3.9, 4.0, 5.5]  # of a variable rate
    write_video(place / "IMG_0001.MOV", times_s, rotation)
    tables = imported(tmp_path)
    frames = tables["frames"]
    size = (HEIGHT, WIDTH) if turns % 2 else (WIDTH, HEIGHT)
    assert set(zip(frames["width"], frames["height"], strict=True)) == {size} and set(frames["clock"]) == {"video"}
    assert list(tables["sessions"]["session_id"]) == ["IMG_0001"] and len(frames) == len(times_s)
    assert frames["t_ns"].to_numpy() * 1e-9 == pytest.approx(times_s, abs=0.002)
    assert all(off(data, n, turns) < 25 for n, data in enumerate(images_of(tables, place)))


@pytest.mark.parametrize("step_px", [1, 2])
def test_a_cut_in_a_video_begins_a_session(tmp_path: Path, place: Path, step_px: int) -> None:
    """Three places, panned slowly or fast with each image shown twice; a lamp that is turned on is no cut."""
    first = {0: 0, 24: 1, 50: 2}

    def picture(n: int) -> np.ndarray:
        seen = first[max(start for start in first if start <= n)]
        shown = np.roll(image(seen, WIDTH, HEIGHT), step_px * (n // 2), axis=1)
        return cv2.convertScaleAbs(shown, alpha=0.8, beta=40 if n % 30 > 10 else 0)

    write_video(place / "a.mp4", [n / 10 for n in range(80)], picture_of=picture)
    tables = imported(tmp_path)
    assert tables["sessions"]["session_id"].tolist() == ["a", "a.part2", "a.part3"]
    assert tables["sessions"]["device"].tolist() == ["camera 1"] * 3
    t_s = {str(name): rows["t_ns"].to_numpy(float) * 1e-9 for name, rows in tables["frames"].groupby("session_id")}
    assert t_s["a"].max() < 2.4 <= t_s["a.part2"].min() and t_s["a.part3"].min() >= 5
    said = "\n".join(inspect_capture(place))
    assert "2 cuts, at 2.4 s, 5.0 s" in said and "no scale and no vertical" in said


def test_photos_of_one_camera_share_it_across_folders_and_others_dont(tmp_path: Path, place: Path) -> None:
    for n in range(4):
        for folder, model in (("a", "P"), ("b", "Q"), ("c", "P"), ("d", ""), ("e", "")):
            write_photo(place / folder / f"{n}.jpg", 10 * ord(folder) + n, Model=model)
    write_video(place / "f.mp4", [n / 2 for n in range(4)])
    tables = imported(tmp_path)
    devices = tables["sessions"].set_index("session_id")["device"].str.removeprefix("camera ")
    assert devices.astype(int).to_dict() == {"a": 1, "b": 2, "c": 1, "d": 3, "e": 4, "f": 5}


def test_a_video_without_a_sharp_frame_is_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "walk" / "a.mp4", [n / 10 for n in range(10)], blur=4.0)
    unusable: list[str] = []
    lines = list(inspect_capture(tmp_path / "walk", unusable=unusable))
    assert unusable == ["a"] and any("none of 10 images is sharp" in line for line in lines)


def test_positions_on_earth_are_kept_only_where_they_are_asked_for(tmp_path: Path, place: Path) -> None:
    """South and west, below the sea, one without an altitude, one that is no position, one photo without any."""
    tag = PIL.ExifTags.GPS
    for n in range(5):
        write_photo(place / f"IMG_{n}.jpg", n)
        gps: dict[int, Any] = {
            tag.GPSLatitude: (33.0, 51.0, 24.5 + n),
            tag.GPSLatitudeRef: "S",
            tag.GPSLongitude: (151.0, 12.0, 55.0) if n != 3 else (200.0, 0.0, 0.0),
            tag.GPSLongitudeRef: "W",
            tag.GPSHPositioningError: 4.75,
        }
        gps |= {tag.GPSAltitude: 12.5, tag.GPSAltitudeRef: b"\x01"} if n != 1 else {}
        if n == 4:
            continue
        with PIL.Image.open(place / f"IMG_{n}.jpg") as photo:
            exif = photo.getexif()
            exif[BASE.GPSInfo] = gps
            photo.save(place / f"IMG_{n}.jpg", quality=95, exif=exif)
    assert "gps" not in imported(tmp_path).tables
    asked = imported(tmp_path, "gps=true")
    gps_table, rejects = (read_table(asked.folder / f"{t}.parquet", schema("import", t)) for t in ("gps", "rejects"))
    assert gps_table["t_ns"].tolist() == [0, 10**9, 2 * 10**9]
    assert gps_table["latitude_deg"].to_numpy() == pytest.approx([-33.8568056, -33.8570833, -33.8573611])
    assert gps_table["longitude_deg"].to_numpy() == pytest.approx(-151.2152778)
    assert gps_table["altitude_m"].fillna(0).tolist() == [-12.5, 0, -12.5] and (gps_table["accuracy_m"] == 4.75).all()
    assert rejects["source"].tolist() == ["IMG_3.jpg"] and "aren't a place on earth" in rejects["reason"][0]
