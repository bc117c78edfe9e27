"""Images of import.frames: which file each is, its pixels, and its bytes without metadata."""

import contextlib
import math
import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from groundwalk.store.errors import UserError
from groundwalk.store.files import IMPORTED, hash_files, leads_outside

Image = NDArray[np.uint8]

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
JPEG_SIGNATURE = b"\xff\xd8\xff"
_START_OF_SCAN, _END, _COMMENT, _ADOBE = 0xDA, 0xD9, 0xFE, 0xEE
# Ends a scan: in its data 00 behind FF makes that a byte, D0 to D7 restart the coder, and another FF fills.
_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
# How many times smaller a JPEG can be decoded at once.
_REDUCED = {
    8: cv2.IMREAD_REDUCED_COLOR_8,
    4: cv2.IMREAD_REDUCED_COLOR_4,
    2: cv2.IMREAD_REDUCED_COLOR_2,
    1: cv2.IMREAD_COLOR_BGR,
}
_PNG_METADATA = (b"eXIf", b"tEXt", b"zTXt", b"iTXt", b"tIME")


def image_file(image: str, captures: Path, imported: Path) -> Path:
    """The file of a `frames.image` entry: relative to the capture folder, or to the import artefact where import copied
    the image (`import:` in front). UserError for one that leads out of that folder."""
    if leads_outside(image):
        raise UserError("an image's path leads out of its folder", where=captures, found=repr(image))
    if image.startswith(IMPORTED):
        return imported / image.removeprefix(IMPORTED)
    return captures / image


def verify_images(captures: Path, imported: Path) -> None:
    """UserError where an image of import's frames isn't the one that import saw, by the hash that it noted; those that
    it copied are among its outputs, and verified as these."""
    # Here, so that whoever only reads an image needs no pandas.
    from groundwalk.store.tables import table_of

    frames = table_of(imported.parent, "import", "frames")
    frames = frames[~frames["image"].str.startswith(IMPORTED)]
    expected = dict(zip(frames["image"], frames["image_sha256"], strict=True))
    hashes = hash_files(captures, [captures / name for name in expected if (captures / name).is_file()])
    wrong = [name for name, digest in expected.items() if hashes.get(Path(name).as_posix()) != digest]
    if wrong:
        raise UserError(
            f"{len(wrong)} of {len(expected)} images aren't as import saw them",
            where=captures / wrong[0],
            found="another sha256 than in import.frames" if (captures / wrong[0]).is_file() else "no such file",
            do="put the image back, or import the scene again",
        )


def read_image(path: Path, *, reduced: int = 1) -> Image:
    """An image file as RGB (H, W, 3), as the sensor has it (a turn in the file's EXIF is left out, since poses and
    intrinsics are the sensor's); `reduced` so many times (1, 2, 4 or 8) smaller. UserError where it isn't there or
    can't be decoded."""
    # OpenCV prints a warning of its own for a file that isn't there.
    is_there = path.exists()
    image = cv2.imread(str(path), _REDUCED[reduced] | cv2.IMREAD_IGNORE_ORIENTATION) if is_there else None
    if image is None:
        actual = "a file that isn't an image" if is_there else "no such file"
        raise UserError("an image can't be read", where=path, found=actual, do="import the capture again")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def read_grey_image(path: Path) -> Image:
    """An image file in grey (H, W); as `read_image`."""
    return np.asarray(cv2.cvtColor(read_image(path), cv2.COLOR_RGB2GRAY), np.uint8)


def small_jpeg(path: Path, long_side: int, gravity_x: float, gravity_y: float) -> bytes:
    """A small JPEG of an image file, turned by quarters so that gravity (camera axes, x right, y down; NaN: unknown)
    points down in it as far as it can."""
    import PIL.Image  # here, as a phone's runtime reads images without it

    size = long_side
    with contextlib.suppress(OSError), PIL.Image.open(path) as opened:
        size = max(opened.size)
    reduced = next((times for times in _REDUCED if size >= times * long_side), 1)
    image = cv2.cvtColor(read_image(path, reduced=reduced), cv2.COLOR_RGB2BGR)
    scale = min(1.0, long_side / max(image.shape[:2]))
    image = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    if not math.isnan(gravity_x + gravity_y):
        quarters = round(math.degrees(math.atan2(gravity_x, gravity_y)) / 90)
        image = np.ascontiguousarray(np.rot90(image, -quarters))
    done, jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 70])
    if not done:
        raise RuntimeError(f"no JPEG of {path}")
    return jpeg.tobytes()


def exif_orientation(path: Path) -> int:
    """How EXIF says that an image's pixels are turned, 1 to 8 (TIFF 6.0, Orientation); 1, as they are, where it
    doesn't."""
    import PIL.ExifTags
    import PIL.Image

    try:
        with PIL.Image.open(path) as image:
            orientation = image.getexif().get(PIL.ExifTags.Base.Orientation, 1)
    except (OSError, ValueError, SyntaxError, TypeError):
        return 1
    return orientation if orientation in range(1, 9) else 1


def without_metadata(data: bytes) -> bytes:
    """A JPEG or PNG without what may say where, when and by whom it was taken; its pixels and colour profile stay. What
    lies behind a JPEG's end, such as a phone's second picture or its video, goes.

    Data that isn't laid out as expected comes back as it is, from where it isn't.
    """
    if data.startswith(JPEG_SIGNATURE):
        kept, at = [data[:2]], 2
        while at + 2 <= len(data) and data[at] == 0xFF:
            if data[at + 1] == 0xFF:  # fills
                at += 1
                continue
            marker, end = data[at + 1], at + 2 + int.from_bytes(data[at + 2 : at + 4], "big")
            if marker == _END:
                return b"".join([*kept, data[at : at + 2]])
            if marker == _START_OF_SCAN:
                scan_end = _MARKER.search(data, end)
                end = scan_end.start() if scan_end else len(data)
            is_personal = marker == _COMMENT or (0xE1 <= marker <= 0xEF and marker != _ADOBE)
            if not is_personal or data[at + 4 : end].startswith(b"ICC_PROFILE"):
                kept.append(data[at:end])
            at = end
        return b"".join([*kept, data[at:]])
    elif data.startswith(PNG_SIGNATURE):
        kept, at = [data[:8]], 8
        while at + 12 <= len(data):
            end = at + 12 + int.from_bytes(data[at : at + 4], "big")
            if data[at + 4 : at + 8] not in _PNG_METADATA:
                kept.append(data[at:end])
            at = end
        return b"".join(kept)
    return data
