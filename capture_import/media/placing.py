"""Where the selected images are: in the capture as they are, or in the artefact."""

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Image, ImageFile, Session, VideoFrame
from groundwalk.capture_import.media.blurring import Blurring, Region, blurred
from groundwalk.capture_import.media.images import decode_rgb, encode_jpeg, is_heic, turned_pixels
from groundwalk.capture_import.media.reading import ImageReader, video_of
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
    session: Session
    copies: bool
    reader: ImageReader

    def stays(self, file: Path) -> bool:
        """Whether a file is used where the capture has it."""
        return not self.copies and file.is_relative_to(self.root)

    def write(self, data: bytes, kind: str, number: int, suffix: str) -> str:
        """Write a frame's file into the artefact; returns its entry."""
        target = self.work / kind / f"{self.session.frame_id(number)}{suffix}"
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
        return f"import:{target.relative_to(self.work).as_posix()}"


class Placed(NamedTuple):
    """A frame's columns `image`, `image_sha256`, `blurred_faces` and `blurred_plates` of import.frames, and the regions
    of its image that are blurred; None where nothing looked for any."""

    columns: dict[str, Any]
    regions: list[Region] | None


def place_images(images: Sequence[Image], where: Placement, blurring: Blurring, to_upright: int) -> list[Placed]:
    """Place a session's selected images, in order.

    Frames of a video, images from an archive or in HEIC, and images that are turned or blurred are always written to
    the artefact, without metadata; other files of the capture folder are left there, or copied. `blurring` says what is
    to be blurred, by detectors in images that `to_upright` quarter turns clockwise put upright.
    """

    def rendered(image: Image, rgb: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], list[Region] | None]:
        rgb = turned_pixels(rgb, image.quarters)
        regions = blurring.regions(where.session.frame_id(image.number), rgb, to_upright)
        return (blurred(rgb, regions) if regions else rgb), regions

    def placed(entry: str, sha256: str, regions: list[Region] | None) -> Placed:
        counts = {
            f"blurred_{kind}s": math.nan if regions is None else sum(region.kind == kind for region in regions)
            for kind in ("face", "plate")
        }
        return Placed({"image": entry, "image_sha256": sha256, **counts}, regions)

    def written(image: Image, data: bytes, suffix: str, regions: list[Region] | None) -> Placed:
        entry = where.write(data, "images", image.number, suffix)
        return placed(entry, hashlib.sha256(data).hexdigest(), regions)

    def of_file(image: Image) -> Placed:
        ref = image.image
        assert isinstance(ref, ImageFile)  # a recording has files or a video, never both
        regions: list[Region] | None = None
        with ref.path.open("rb") as file:
            is_changed = image.quarters or is_heic(file.read(12))
        if is_changed or blurring.looks_at(where.session.frame_id(image.number)):
            rgb, regions = rendered(image, decode_rgb(ref.path.read_bytes(), long_side=2**31))
            if is_changed or regions:
                return written(image, encode_jpeg(rgb), ".jpg", regions)
        if where.stays(ref.path):
            return placed(ref.path.relative_to(where.root).as_posix(), image.check.sha256, regions)
        return written(image, without_metadata(ref.path.read_bytes()), ref.path.suffix.lower(), regions)

    text = f"{where.session.session_id}: {'placing images' if blurring.detect is None else 'blurring faces'}"
    video = video_of(images)
    if video is None:
        return list(track(in_parallel(of_file, images), text, len(images)))
    image_of = {ref.index: image for image in images if isinstance(ref := image.image, VideoFrame)}
    decoded = decode(video, set(image_of), where.reader.limits)

    def of_frame(frame: tuple[int, av.VideoFrame]) -> tuple[int, bytes, list[Region] | None]:
        rgb, regions = rendered(image_of[frame[0]], rgb_pixels(frame[1]))
        return frame[0], encode_jpeg(rgb), regions

    of_video = track(in_parallel(of_frame, decoded), text, len(image_of))
    done = {index: written(image_of[index], data, ".jpg", regions) for index, data, regions in of_video}
    return [done[index] for index in image_of]
