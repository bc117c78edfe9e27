"""JPEGs and thumbnails of the images that sampling will probably select, written while they are decoded for their
check.

Decoding is most of what import costs, and the selection is certain only when all images are measured. So the sharpest
of each group of candidates is written at once: a video's frame as JPEG, and a thumbnail for the Rerun recording. Other
selected images are decoded again.
"""

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import av
import numpy as np

from groundwalk.capture_import.capture import RawFrame, VideoFrame
from groundwalk.capture_import.images import encode_jpeg
from groundwalk.capture_import.scan import ImageScan
from groundwalk.capture_import.selection import cells_of, windows_of
from groundwalk.capture_import.settings import ImportSettings
from groundwalk.capture_import.thumbnails import encode_thumbnail, spread
from groundwalk.capture_import.video import rgb_pixels

# Files of larger groups aren't decoded in colour, as only one of them is needed.
_MAX_IN_COLOUR = 3


class Spool:
    """Takes the images of one recording in order, and writes the best of each group of candidates.

    `in_colour` are the places of the files to decode in colour.
    """

    def __init__(self, folder: Path, frames: Sequence[RawFrame], settings: ImportSettings) -> None:
        """`frames` are the rows of the log with an image, as they'll be scanned; `folder` needn't exist."""
        self._folder = folder
        self._frames = frames
        windows = windows_of(frames, settings)
        self._in_recording = set(spread(range(len(windows))))
        files = (
            window
            for number, window in enumerate(windows)
            if number in self._in_recording and len(window) <= _MAX_IN_COLOUR
        )
        self.in_colour = frozenset(int(i) for window in files for i in window)
        self._groups = [_Groups(windows, self._write_frame)]
        if settings.max_support_fraction and any(isinstance(frame.image, VideoFrame) for frame in frames):
            cells = cells_of(frames, frames, settings)
            borders = np.flatnonzero(np.diff(cells)) + 1
            self._groups.append(_Groups(np.split(np.arange(len(cells)), borders), self._write_support))

    def add(self, place: int, scan: ImageScan) -> None:
        """Add the image of the row at this place."""
        for groups in self._groups:
            groups.add(place, scan)

    def flush(self) -> None:
        """Write the best of the last groups."""
        for groups in self._groups:
            groups.flush()

    def _write_frame(self, window: int, place: int, scan: ImageScan) -> None:
        self._write_support(window, place, scan)
        colour = scan.colour
        if window in self._in_recording and colour is not None:
            rgb = rgb_pixels(colour) if isinstance(colour, av.VideoFrame) else colour
            thumbnail_path(self._folder, self._frames[place].number).write_bytes(encode_thumbnail(rgb))

    def _write_support(self, _: int, place: int, scan: ImageScan) -> None:
        """A video's frame as JPEG, unless it's there."""
        self._folder.mkdir(parents=True, exist_ok=True)
        image = self._frames[place].image
        if isinstance(scan.colour, av.VideoFrame) and isinstance(image, VideoFrame):
            path = spooled_path(self._folder, image)
            if not path.is_file():
                path.write_bytes(encode_jpeg(rgb_pixels(scan.colour)))


class _Groups:
    """Finds the sharpest scan of each group of places as they come in order, and hands it to `write`, with the
    number of its group and its place, when the group is over."""

    def __init__(self, groups: Iterable[Iterable[int]], write: Callable[[int, int, ImageScan], None]) -> None:
        self._group_of = {int(i): number for number, group in enumerate(groups) for i in group}
        self._write = write
        self._group = -1
        self._best: tuple[int, ImageScan] | None = None

    def add(self, place: int, scan: ImageScan) -> None:
        group = self._group_of.get(place, -1)
        if group != self._group:
            self.flush()
            self._group = group
        is_sharper = self._best is None or scan.check.sharpness > self._best[1].check.sharpness
        if group >= 0 and scan.colour is not None and is_sharper:
            self._best = (place, scan)

    def flush(self) -> None:
        if self._best is not None:
            self._write(self._group, *self._best)
        self._best = None


def spooled_path(folder: Path, frame: VideoFrame) -> Path:
    """Where a video frame's JPEG is, if it was written."""
    return folder / f"{frame.index:06d}.jpg"


def thumbnail_path(folder: Path, number: int) -> Path:
    """Where the thumbnail of the row with this number is, if it was written."""
    return folder / f"{number:06d}.small.jpg"
