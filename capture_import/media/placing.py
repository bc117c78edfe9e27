"""Where the selected images are: in the capture as they are, or in the artefact."""

import hashlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from groundwalk.capture_import.capture import Image, ImageFile, PlacedImage, VideoFrame
from groundwalk.capture_import.media.blurring import Detector, Region, blur_people
from groundwalk.capture_import.media.images import decode_rgb, encode_jpeg, is_heic, without_metadata
from groundwalk.capture_import.media.placement import Placement
from groundwalk.capture_import.media.upright import turned_pixels
from groundwalk.capture_import.media.video import decode, rgb_pixels
from groundwalk.store.parallel import in_parallel
from groundwalk.store.progress import track


def place_images(
    images: Sequence[Image], where: Placement, detect: Detector | None, to_upright: int
) -> list[PlacedImage]:
    """Place a session's selected images, in order.

    Frames of a video, images from an archive or in HEIC, and images that are turned or blurred are always written to
    the artefact, without metadata; other files of the capture folder are left there, or copied. `detect` finds what is
    to be blurred, in images that `to_upright` quarter turns clockwise put upright.
    """

    def rendered(rgb: NDArray[np.uint8], quarters: int) -> tuple[NDArray[np.uint8], list[Region]]:
        rgb = turned_pixels(rgb, quarters)
        rgb, regions = blur_people(rgb, detect, to_upright) if detect is not None else (rgb, [])
        return turned_pixels(rgb, where.quarters), regions

    def written(image: Image, data: bytes, suffix: str) -> tuple[str, str]:
        return where.write(data, "images", image.frame.number, suffix), hashlib.sha256(data).hexdigest()

    def placed(entry: tuple[str, str], regions: list[Region]) -> PlacedImage:
        if detect is None:
            return PlacedImage(*entry)
        return PlacedImage(*entry, *(sum(region.kind == kind for region in regions) for kind in ("face", "plate")))

    def of_file(image: Image) -> PlacedImage:
        ref = image.frame.image
        assert isinstance(ref, ImageFile)  # a recording has files or a video, never both
        regions: list[Region] = []
        with ref.path.open("rb") as file:
            is_heic_file = is_heic(file.read(12))
        is_changed = where.quarters or image.frame.quarters or is_heic_file
        if is_changed or detect is not None:
            rgb, regions = rendered(decode_rgb(ref.path.read_bytes(), long_side=2**31), image.frame.quarters)
            if is_changed or regions:
                return placed(written(image, encode_jpeg(rgb), ".jpg"), regions)
        if where.stays(ref.path):
            return placed((ref.path.relative_to(where.root).as_posix(), image.check.sha256), regions)
        return placed(written(image, without_metadata(ref.path.read_bytes()), ref.path.suffix.lower()), regions)

    text = f"{where.session_id}: {'placing images' if detect is None else 'blurring faces and plates'}"
    video = next((ref.path for image in images if isinstance(ref := image.frame.image, VideoFrame)), None)
    if video is None:
        return list(track(in_parallel(of_file, images), text, len(images)))
    image_of = {ref.index: image for image in images if isinstance(ref := image.frame.image, VideoFrame)}
    decoded = decode(video, set(image_of), where.limits)
    of_video = in_parallel(
        lambda frame: (frame[0], rendered(rgb_pixels(frame[1]), image_of[frame[0]].frame.quarters)), decoded
    )
    done = {
        index: placed(written(image_of[index], encode_jpeg(rgb), ".jpg"), regions)
        for index, (rgb, regions) in track(of_video, text, len(image_of))
    }
    return [done[index] for index in image_of]
