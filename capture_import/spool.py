"""What will probably be needed of the images that sampling keeps, written while they are decoded for their check.

Decoding is most of what import costs, and which images are kept is known for sure only when all of them are measured.
So the sharpest of each group of candidates is written on the way: a video's frame as JPEG, and a thumbnail of what the
recording will show. What isn't here in the end is decoded again.
"""

from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from capture_import.capture import RawFrame, VideoFrame
from capture_import.images import encode_jpeg
from capture_import.sampling import motion_candidates, rate_candidates
from capture_import.scan import Look
from capture_import.settings import ImportSettings
from capture_import.thumbnails import encode_thumbnail, spread
from capture_import.video import rgb_pixels

# Files of larger groups aren't decoded in colour, as only one of them is needed.
_FEW = 3


class Spool:
    """Takes the images of one recording in order, and writes the best of each group of candidates.

    `in_colour` are the places of the files that are wanted in colour.
    """

    def __init__(self, folder: Path, frames: Sequence[RawFrame], settings: ImportSettings) -> None:
        """`frames` are the rows of the log with an image, as they'll be scanned; `folder` needn't exist."""
        self._folder = folder
        self._frames = frames
        groups = _candidates(frames, settings)
        self._group_of = {int(i): number for number, group in enumerate(groups) for i in group}
        self._shown = set(spread(range(len(groups))))
        files = (group for number, group in enumerate(groups) if number in self._shown and len(group) <= _FEW)
        self.in_colour = frozenset(int(i) for group in files for i in group)
        self._group = -1
        self._best: tuple[int, Look] | None = None

    def take(self, place: int, look: Look) -> None:
        """Take what the image of the row at this place looks like."""
        group = self._group_of.get(place, -1)
        if group != self._group:
            self.flush()
            self._group = group
        better = self._best is None or look.check.sharpness > self._best[1].check.sharpness
        if group >= 0 and look.picture is not None and better:
            self._best = (place, look)

    def flush(self) -> None:
        """Write the best of the last group."""
        if self._best is None:
            return
        place, look = self._best
        self._best = None
        frame, picture = self._frames[place], look.picture
        self._folder.mkdir(parents=True, exist_ok=True)
        if isinstance(picture, av.VideoFrame):
            assert isinstance(frame.image, VideoFrame)
            picture = rgb_pixels(picture)
            spooled_path(self._folder, frame.image).write_bytes(encode_jpeg(picture))
        if self._group in self._shown and picture is not None:
            thumbnail_path(self._folder, frame.number).write_bytes(encode_thumbnail(picture))


def spooled_path(folder: Path, frame: VideoFrame) -> Path:
    """Where a video frame's JPEG is, if it was written."""
    return folder / f"{frame.index:06d}.jpg"


def thumbnail_path(folder: Path, number: int) -> Path:
    """Where the thumbnail of the row with this number is, if it was written."""
    return folder / f"{number:06d}.small.jpg"


def _candidates(frames: Sequence[RawFrame], settings: ImportSettings) -> list[NDArray[np.int64]]:
    """Groups of frames of which sampling will keep the sharpest, should none be rejected."""
    if not frames or settings.sampling == "all":
        return [np.array([i]) for i in range(len(frames))]
    if settings.sampling == "rate":
        return rate_candidates(np.array([f.t_ns for f in frames], dtype=np.int64), settings.rate_hz)
    poses = np.array([f.vio_T_cam for f in frames], dtype=float)
    return motion_candidates(poses, settings.step_m, settings.step_deg)
