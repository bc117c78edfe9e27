"""Where the selected images are: in the capture as they are, or in the artefact."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Image, ImageFile, VideoFrame
from groundwalk.capture_import.media.blurring import Detector, Region, blur_people
from groundwalk.capture_import.media.images import decode_rgb, encode_jpeg, is_heic
from groundwalk.capture_import.media.reading import ImageReader, video_of
from groundwalk.capture_import.media.upright import turned_pixels
from groundwalk.capture_import.media.video import decode, rgb_pixels
from groundwalk.store.images import without_metadata
from groundwalk.store.parallel import in_parallel
from groundwalk.store.progress import track


@dataclass(frozen=True)
class Placement:
    """How a session's files are placed.

    `root` is the capture folder, `work` the artefact's. `copies`: files of the capture are copied. `reader` reads them.
    """

    root: Path
    work: Path
    session_id: str
    copies: bool
    reader: ImageReader

    def stays(self, file: Path) -> bool:
        """Whether a file is used where the capture has it."""
        return not self.copies and file.is_relative_to(self.root)

    def write(self, data: bytes, kind: str, number: int, suffix: str) -> str:
        """Write a frame's file into the artefact; returns its entry."""
        target = self.work / kind / self.session_id / f"{number:06d}{suffix}"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
        return f"import:{target.relative_to(self.work).as_posix()}"


def place_images(
    images: Sequence[Image], where: Placement, detect: Detector | None, to_upright: int
) -> list[dict[str, Any]]:
    """Place a session's selected images: their columns `image`, `image_sha256`, `blurred_faces` and `blurred_plates` of
    import.frames, in order.

    Frames of a video, images from an archive or in HEIC, and images that are turned or blurred are always written to
    the artefact, without metadata; other files of the capture folder are left there, or copied. `detect` finds what is
    to be blurred, in images that `to_upright` quarter turns clockwise put upright.
    """

    def rendered(rgb: NDArray[np.uint8], quarters: int) -> tuple[NDArray[np.uint8], list[Region]]:
        rgb = turned_pixels(rgb, quarters)
        return blur_people(rgb, detect, to_upright) if detect is not None else (rgb, [])

    def placed(entry: str, sha256: str, regions: list[Region]) -> dict[str, Any]:
        kinds = ("face", "plate")
        counts = {f"blurred_{k}s": sum(r.kind == k for r in regions) if detect is not None else math.nan for k in kinds}
        return {"image": entry, "image_sha256": sha256, **counts}

    def written(image: Image, data: bytes, suffix: str, regions: list[Region]) -> dict[str, Any]:
        entry = where.write(data, "images", image.number, suffix)
        return placed(entry, hashlib.sha256(data).hexdigest(), regions)

    def of_file(image: Image) -> dict[str, Any]:
        ref = image.image
        assert isinstance(ref, ImageFile)  # a recording has files or a video, never both
        regions: list[Region] = []
        with ref.path.open("rb") as file:
            is_heic_file = is_heic(file.read(12))
        is_changed = image.quarters or is_heic_file
        if is_changed or detect is not None:
            rgb, regions = rendered(decode_rgb(ref.path.read_bytes(), long_side=2**31), image.quarters)
            if is_changed or regions:
                return written(image, encode_jpeg(rgb), ".jpg", regions)
        if where.stays(ref.path):
            return placed(ref.path.relative_to(where.root).as_posix(), image.check.sha256, regions)
        return written(image, without_metadata(ref.path.read_bytes()), ref.path.suffix.lower(), regions)

    text = f"{where.session_id}: {'placing images' if detect is None else 'blurring faces and plates'}"
    video = video_of(images)
    if video is None:
        return list(track(in_parallel(of_file, images), text, len(images)))
    image_of = {ref.index: image for image in images if isinstance(ref := image.image, VideoFrame)}
    decoded = decode(video, set(image_of), where.reader.limits)
    of_video = in_parallel(
        lambda frame: (frame[0], rendered(rgb_pixels(frame[1]), image_of[frame[0]].quarters)), decoded
    )
    done = {
        index: written(image_of[index], encode_jpeg(rgb), ".jpg", regions)
        for index, (rgb, regions) in track(of_video, text, len(image_of))
    }
    return [done[index] for index in image_of]
