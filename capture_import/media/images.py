"""Images of unknown origin: full decode check, size, sharpness and hash."""

import hashlib
import io
import math
import struct
from typing import Any

import cv2
import numpy as np
import pi_heif
import PIL.Image
import simplejpeg
from numpy.typing import NDArray

from groundwalk.capture_import.capture import ImageCheck, Session, poses_of
from groundwalk.geometry.gravity import gravity_in_camera
from groundwalk.store.images import JPEG_SIGNATURE, PNG_SIGNATURE, without_metadata

pi_heif.register_heif_opener()

Gray = NDArray[np.uint8]

# Sharpness is measured on images of this long side, so that it doesn't depend on the camera's resolution.
WORKING_LONG_SIDE = 480
_REBLUR = 9


class BadImage(ValueError):
    """An image that can't be used; the message says what it is or has: "is empty"."""


def check_image(data: bytes, max_megapixels: float) -> ImageCheck:
    """Decode an image wholly and measure it.

    Raises BadImage for one that is empty, no JPEG, PNG or HEIC, larger than the limit, truncated or corrupt.
    """
    width, height = image_size(data, max_megapixels)
    gray = decode_gray(data)
    whole, content = hashlib.sha256(data).hexdigest(), without_metadata(data)
    return measured(gray, width, height, whole, whole if content == data else hashlib.sha256(content).hexdigest())


def measured(gray: Gray, width: int, height: int, sha256: str = "", content_sha256: str = "") -> ImageCheck:
    """What is measured of an image of this size by its grey levels (H, W) in the working size."""
    return ImageCheck(width, height, sharpness(gray), float(cv2.meanStdDev(gray)[1][0, 0]), sha256, content_sha256)


def image_size(data: bytes, max_megapixels: float = math.inf) -> tuple[int, int]:
    """(width, height) from the header of a JPEG or PNG, or of a whole HEIC; BadImage where there is none, or it's
    larger than the limit."""
    if not data:
        raise BadImage("is empty")
    if data.startswith(JPEG_SIGNATURE):
        try:
            height, width, *_ = simplejpeg.decode_jpeg_header(data)
        except ValueError as error:
            raise BadImage(f"is broken: {error}") from None
    elif data.startswith(PNG_SIGNATURE) and len(data) >= 33:
        width, height = struct.unpack(">II", data[16:24])
    elif is_heic(data):
        width, height = _opened_heic(data).size
    else:
        raise BadImage("is neither JPEG nor PNG")
    if width * height > max_megapixels * 1e6:
        raise BadImage(f"of {width}x{height} is larger than {max_megapixels:g} megapixels")
    return int(width), int(height)


def is_heic(start: bytes) -> bool:
    """Whether an image that begins so is one of HEIC's family, which no other stage reads."""
    return start[4:8] == b"ftyp"


def _opened_heic(data: bytes, colours: str = "") -> PIL.Image.Image:
    """A HEIC image, turned as it says, and decoded where colours are named."""
    try:
        image = PIL.Image.open(io.BytesIO(data), formats=("HEIF",))
        return image.convert(colours) if colours else image
    except (OSError, ValueError, SyntaxError, EOFError, RuntimeError, PIL.Image.DecompressionBombError):
        raise BadImage("is broken: the HEIC can't be decoded") from None


def decode_rgb(data: bytes, long_side: int) -> NDArray[np.uint8]:
    """An image (H, W, 3), scaled down to the long side where it's larger."""
    return _decode(data, "RGB", long_side)


def decode_gray(data: bytes) -> Gray:
    """An image (H, W), scaled down to the working size where it's larger."""
    return _decode(data, "GRAY", WORKING_LONG_SIDE)


def _decode(data: bytes, colours: str, long_side: int) -> Any:
    width, height = image_size(data)
    is_gray = colours == "GRAY"
    if data.startswith(JPEG_SIGNATURE):
        # The decoder scales while it decodes, which is faster; it still reads every byte, and strict mode reports what
        # an ordinary decoder paints grey.
        scale = min(1.0, long_side / max(width, height))
        least = {"min_height": int(height * scale), "min_width": int(width * scale)}
        try:
            image = simplejpeg.decode_jpeg(data, colours, **least, min_factor=1, strict=True)
        except ValueError as error:
            raise BadImage(f"is broken: {error}") from None
        image = image[:, :, 0] if is_gray else image
    elif is_heic(data):
        image = np.asarray(_opened_heic(data, "L" if is_gray else "RGB"))
    else:
        image = decoded(data, cv2.IMREAD_GRAYSCALE if is_gray else cv2.IMREAD_COLOR)
        image = image if is_gray else cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return shrunk(image, long_side)


def encode_jpeg(rgb: NDArray[np.uint8], quality: int = 95) -> bytes:
    return bytes(simplejpeg.encode_jpeg(np.ascontiguousarray(rgb), quality=quality, colorsubsampling="420"))


def sharpness(gray: Gray) -> float:
    """How sharp an image (H, W) is: 1 - the blur measure of Crete et al., 0 (blurred) to 1.

    Blurring an image again changes neighbouring differences much where it was sharp and little where it was blurred;
    the ratio doesn't depend on brightness or contrast. The worse of the two image directions counts, as motion blurs
    along one. (F. Crete et al., "The blur effect: perception and estimation with a new no-reference perceptual blur
    metric", Human Vision and Electronic Imaging XII, 2007.)
    """
    image, before = shrunk(gray, WORKING_LONG_SIDE), _REBLUR // 2
    sharp = []
    for along in (image, np.ascontiguousarray(image.T)):
        # Where a pixel, its neighbour and the means around both are inside.
        count = len(along) - _REBLUR
        if count < 1:
            return 0.0
        parts = {start: along[start : start + count] for start in (0, before, before + 1, _REBLUR)}
        differences = cv2.absdiff(parts[before + 1], parts[before])
        # Two neighbouring means differ by the pixel that comes in and the one that goes out.
        blurred = cv2.absdiff(parts[_REBLUR], parts[0])
        # Unsigned: a difference that grew counts as none lost.
        lost = cv2.addWeighted(differences, _REBLUR, blurred, -1, 0, dtype=cv2.CV_16U)
        total = _REBLUR * cv2.sumElems(differences)[0]
        sharp.append(float(cv2.sumElems(lost)[0] / total) if total > 0 else 0.0)
    return min(sharp)


def decoded(data: bytes, flags: int) -> NDArray[Any]:
    """Pixels by OpenCV; BadImage where it can't decode them."""
    try:
        pixels = cv2.imdecode(np.frombuffer(data, np.uint8), flags | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error:
        pixels = None
    if pixels is None:
        raise BadImage("is broken: it can't be decoded")
    return pixels


def shrunk(image: Any, long_side: int) -> Any:
    """`image` (H, W) or (H, W, 3), scaled down to the long side where it's larger."""
    height, width = image.shape[:2]
    scale = long_side / max(width, height)
    if scale >= 1:
        return image
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    # Means of 2x2 pixels are far quicker than those of larger areas.
    while max(image.shape[:2]) >= 2 * long_side:
        half = (max(1, round(image.shape[1] / 2)), max(1, round(image.shape[0] / 2)))
        image = cv2.resize(image, half, interpolation=cv2.INTER_AREA)
    # Down to half the size every pixel still counts in a linear interpolation, which is the faster one.
    return image if image.shape[1::-1] == size else cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)


def quarters_to_upright(session: Session) -> int:
    """How many quarter turns clockwise (0 to 3) put gravity down in most of a session's images. One answer a session;
    0 where up is unknown."""
    if not session.recording.is_gravity_aligned or not session.images:
        return 0
    x, y, _ = gravity_in_camera(poses_of(session.images)).sum(axis=0)
    # What was right is down after a turn clockwise, what was down left.
    return int(np.argmax([y, x, -y, -x]))


def turned_pixels(image: NDArray[np.uint8], quarters: int) -> NDArray[np.uint8]:
    """An image (H, W) or (H, W, 3) turned by quarters clockwise."""
    return np.ascontiguousarray(np.rot90(image, -quarters))
