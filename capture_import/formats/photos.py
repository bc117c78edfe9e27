"""A folder of photos by any camera, without poses: JPEG or PNG, as they come from a phone.

EXIF is documented in CIPA DC-008. What matters:

- pixels are stored as the sensor has them; `Orientation` says how to turn them, and import does;
- `FocalLengthIn35mmFilm` has the diagonal's field of view of a 24x36 mm film, in whole millimetres; cameras with a
  large sensor state `FocalLength` and the sensor's pixels a unit (`FocalPlaneXResolution`). Both are of the whole
  picture: a cropped one says nothing, a smaller one still holds;
- dates are of a clock that anybody may set, in whole seconds mostly: an order, not times;
- `DigitalZoomRatio` makes a camera of its own, whose focal length isn't known: of some makers the stated one has the
  zoom in it, of others it hasn't;
- cameras are told apart by maker, model, lens, focal length, zoom and size; their names don't leave import;
- the GPS directory has latitude and longitude as degrees, minutes and seconds, altitude, and in `GPSHPositioningError`
  the accuracy in metres. It is read only where import is asked for GPS.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import PIL.ExifTags
import PIL.Image

from groundwalk.capture_import.capture import GpsFix, ImageFile, Intrinsics, Limits, RawFrame, Recording, Reject
from groundwalk.capture_import.data_sets import guessed_intrinsics, images_alone
from groundwalk.capture_import.formats import Format
from groundwalk.capture_import.media.images import BadImage, image_size
from groundwalk.capture_import.media.video import is_video
from groundwalk.capture_import.parsing import BadRow, images_in, in_order, read_fixes, read_rows, seconds_to_ns
from groundwalk.store.choices import Clock
from groundwalk.store.tables import GUESS_SD
from groundwalk.store.text import name_list, printable

_FOLDERS = ("images", "input", "frames", "photos")
_MIN_PHOTOS = 3
# EXIF's orientations that are quarter turns clockwise; the others are mirrored.
_QUARTERS = {1: 0, 6: 1, 3: 2, 8: 3}
# Of a focal length by EXIF: whole millimetres of 24 to 28, and some makers mean the width, not the diagonal.
_EXIF_SD = 0.05
_FILM_DIAGONAL_MM = math.hypot(36, 24)
_MM_OF_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}
_MAX_ASPECT = 2.4  # of a camera's picture; panoramas are wider
_PANORAMA = 6  # what iPhones say in CustomRendered; others' panoramas have Google's XMP
_SCREEN_ASPECT = 1.9  # screens are longer; what messengers send without EXIF is as phones take it, 16:9 at most
_OTHERS = (".webp", ".tif", ".tiff", ".dng", ".gif", ".bmp", ".avif")
_LOGS = (".txt", ".csv", ".json", ".jsonl", ".tum", ".yaml", ".yml")
_SAME_ASPECT = 0.02


class _Photo(NamedTuple):
    """A photo's file, size in pixels as stored, turns, focal length in pixels (None: not stated), camera and date, and
    whether the file says that it is a panorama."""

    file: Path
    width: int
    height: int
    orientation: int
    focal_px: float | None
    camera: str
    has_maker: bool
    date: str
    is_panorama: bool


def detect(path: Path) -> bool:
    return path.is_dir() and len(images_in(_images_folder(path))) >= _MIN_PHOTOS


def read(path: Path, limits: Limits) -> Recording:
    """The photos in the order in which they were taken, where all are dated and of one camera, or of their names."""
    folder = _images_folder(path)
    read, rejects = list[_Photo](), list[Reject]()
    for file in images_in(folder):
        try:
            read.append(_photo(file))
        except BadRow as error:
            rejects.append(Reject(file.name, None, str(error)))
    has_makers = sum(photo.has_maker for photo in read) >= len(read) / 2
    dated = all(photo.date for photo in read) and len({photo.camera.partition("|")[0] for photo in read}) == 1
    photos = sorted(read, key=lambda photo: photo.date) if dated else read
    rows = [(photo.file.name, photo) for photo in photos]
    frames, bad = read_rows(rows, lambda place, photo: _row(place, photo, has_makers))
    recording = images_alone(Clock.NAME_ORDER, path, frames, [*rejects, *bad], _notes(path, folder, frames, dated))
    return replace(recording, read_gps=partial(read_fixes, [(photo.file.name, photo.file) for photo in photos], _fix))


def _images_folder(path: Path) -> Path:
    inside = (path / name for name in _FOLDERS)
    return path if images_in(path) else next((folder for folder in inside if images_in(folder)), path)


def _photo(file: Path) -> _Photo:
    if not file.is_file():  # a pipe has no end
        raise BadRow("image is no file")
    try:
        with file.open("rb") as opened:
            start = opened.read(64)
        with PIL.Image.open(file) as image:
            if isinstance(xmp := image.info.get("xmp"), str):  # a PNG's text of that name
                image.info["xmp"] = xmp.encode()
            (width, height), exif = image.size, image.getexif()
            details = exif.get_ifd(PIL.ExifTags.IFD.Exif)
            has_gpano = b"GPano:ProjectionType" in (image.info.get("xmp") or b"")
    except PIL.UnidentifiedImageError:
        try:
            image_size(start)
        except BadImage as error:
            raise BadRow(f"image {error}") from None
        raise BadRow("image is broken") from None
    except (OSError, ValueError, SyntaxError, TypeError, PIL.Image.DecompressionBombError) as error:
        raise BadRow(f"image can't be read: {error}") from None
    base = PIL.ExifTags.Base
    maker = [_text(exif.get(tag)) for tag in (base.Make, base.Model)]
    focal_mm = [_number(details.get(tag)) for tag in (base.FocalLengthIn35mmFilm, base.FocalLength)]
    size = f"{max(width, height)}x{min(width, height)}"
    zoom = round(max(1.0, _number(details.get(base.DigitalZoomRatio))), 1)
    lens = (_text(details.get(base.LensModel)), f"{focal_mm[0] or focal_mm[1]:g}", f"{zoom:g}", size)
    date = _text(details.get(base.DateTimeOriginal))
    return _Photo(
        file=file,
        width=width,
        height=height,
        orientation=int(_number(exif.get(base.Orientation)) or 1),
        focal_px=_focal_px(details, width, height) if zoom == 1 else None,
        camera="|".join([" ".join(maker), *lens]),
        has_maker=any(maker),
        date=f"{date}.{_text(details.get(base.SubsecTimeOriginal))}" if date else "",
        is_panorama=has_gpano or details.get(base.CustomRendered) == _PANORAMA,
    )


def _row(place: int, photo: _Photo, has_makers: bool) -> RawFrame:
    width, height = photo.width, photo.height
    aspect = max(width, height) / min(width, height)
    if photo.is_panorama or aspect > _MAX_ASPECT:
        raise BadRow(f"image of {width}x{height} is a panorama: no lens has such a projection")
    is_png = photo.file.suffix.lower() == ".png"
    if has_makers and not photo.has_maker and (is_png or aspect > _SCREEN_ASPECT):
        what = "PNG" if is_png else f"image of {width}x{height}"
        raise BadRow(f"{what} without a camera in its EXIF, among photos that have one: a screenshot or a drawing")
    if photo.orientation not in _QUARTERS:
        raise BadRow(f"EXIF says that the image is stored mirrored (orientation {photo.orientation})")
    quarters = _QUARTERS[photo.orientation]
    if quarters % 2:
        width, height = height, width
    f = photo.focal_px
    camera = guessed_intrinsics(width, height, GUESS_SD)
    if f is not None:
        camera = Intrinsics(f, f, width / 2, height / 2, width, height, focal_sd=_EXIF_SD)
    return RawFrame(
        seconds_to_ns(place),
        image=ImageFile(photo.file),
        intrinsics=camera,
        quarters=quarters,
        camera_name=photo.camera,
    )


def _focal_px(details: dict[int, Any], width: int, height: int) -> float | None:
    """The focal length in pixels of an image of this size; None where EXIF doesn't say, or it isn't plausible."""
    base = PIL.ExifTags.Base
    whole = [_number(details.get(tag)) for tag in (base.ExifImageWidth, base.ExifImageHeight)]
    if all(whole) and abs(max(whole) / min(whole) / (max(width, height) / min(width, height)) - 1) > _SAME_ASPECT:
        return None
    tags = (base.FocalLengthIn35mmFilm, base.FocalLength, base.FocalPlaneXResolution)
    film_mm, focal_mm, density = (_number(details.get(tag)) for tag in tags)
    if film_mm:
        focal_px = film_mm * math.hypot(width, height) / _FILM_DIAGONAL_MM
    else:
        unit_mm = _MM_OF_UNIT.get(int(_number(details.get(base.FocalPlaneResolutionUnit)) or 2), 25.4)
        focal_px = focal_mm * density / unit_mm * (max(width, height) / max(whole) if all(whole) else 1.0)
    return focal_px if 0.3 < focal_px / max(width, height) < 20 else None


def _fix(place: int, file: Path) -> GpsFix | None:
    """The position on earth that a photo's EXIF states, at the photo's time; None where there is none."""
    tag = PIL.ExifTags.GPS
    try:
        with PIL.Image.open(file) as image:
            gps = image.getexif().get_ifd(PIL.ExifTags.IFD.GPSInfo)
        if tag.GPSLatitude not in gps or tag.GPSLongitude not in gps:
            return None
        latitude, longitude = (_degrees(gps[name]) for name in (tag.GPSLatitude, tag.GPSLongitude))
        altitude, accuracy = (float(gps.get(name, math.nan)) for name in (tag.GPSAltitude, tag.GPSHPositioningError))
        below = gps.get(tag.GPSAltitudeRef) in (1, b"\x01")
    except (OSError, ValueError, SyntaxError, TypeError, ZeroDivisionError):
        raise BadRow("GPS: EXIF has a position that can't be read") from None
    return GpsFix(
        seconds_to_ns(place),
        -latitude if _text(gps.get(tag.GPSLatitudeRef)) == "S" else latitude,
        -longitude if _text(gps.get(tag.GPSLongitudeRef)) == "W" else longitude,
        -altitude if below else altitude,
        accuracy,
    )


def _degrees(value: Any) -> float:
    degrees, minutes, seconds = (float(part) for part in value)
    return degrees + minutes / 60 + seconds / 3600


def _number(value: Any) -> float:
    """A number of EXIF; 0 where there is none, or it means none."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return number if math.isfinite(number) and number > 0 else 0.0


def _text(value: Any) -> str:
    return str(value).strip("\0 ") if value is not None else ""


def _notes(path: Path, folder: Path, frames: Sequence[RawFrame], dated: bool) -> list[str]:
    cameras = Counter(frame.camera_name for frame in frames)
    stated = sum(frame.intrinsics is not None and frame.intrinsics.focal_sd < GUESS_SD for frame in frames)
    notes = [
        f"{len(frames)} photos without poses, by {len(cameras)} camera{'s' * (len(cameras) != 1)} (maker, lens, zoom, "
        f"size), in the order of {'their dates' if dated else 'their names'}; focal length by EXIF of {stated}, "
        f"unknown of {len(frames) - stated}"
    ]
    others = [f"{len(images_in(p))} images of {p.name}/" for p in path.glob("*/") if p != folder and images_in(p)]
    if videos := [p.name for p in path.rglob("*") if is_video(p)]:
        others.append(f"{len(videos)} videos (--format video reads them alone)")
    if kinds := in_order(p for p in folder.iterdir() if p.suffix.lower() in _OTHERS):
        others.append(f"{len(kinds)} pictures that are no JPEG, PNG or HEIC, such as {printable(kinds[0].name)}")
    beside = {p for place in (path, folder) for p in place.iterdir()}
    if logs := in_order(p for p in beside if p.suffix.lower() in _LOGS and p.is_file()):
        others.append(f"{len(logs)} logs, such as {printable(logs[0].name)}")
    return [*notes, f"not read: {name_list(others, 4)}"] if others else notes


FORMAT = Format(
    id="photos",
    label="photos",
    meaning="images",
    files=("*.jpg|*.png",),
    looks_for="three photos or more, in a folder or its images/, input/, frames/ or photos/, and no log of poses",
    detect=detect,
    read=read,
    is_images_alone=True,
)
