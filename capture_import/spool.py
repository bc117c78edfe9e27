"""Video frames that sampling will probably keep, written while the video is decoded for its check.

Decoding is most of what importing a video costs, and which frames are kept is known for sure only when all of them are
measured. So the sharpest of each group of candidates is written on the way; a kept frame that isn't here is decoded
again.
"""

from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
from numpy.typing import NDArray

from capture_import.capture import RawFrame, VideoFrame
from capture_import.images import encode_jpeg
from capture_import.sampling import motion_candidates, rate_candidates
from capture_import.settings import ImportSettings
from capture_import.video import rgb_pixels


class Spool:
    """Takes the frames of one video in order (`keep`), and writes the sharpest of each group of candidates."""

    def __init__(self, folder: Path, frames: Sequence[RawFrame], settings: ImportSettings) -> None:
        """`frames` are the rows of the log with an image, as they'll be scanned; `folder` needn't exist."""
        self.folder = folder
        self._frames = frames
        self._group_of = {int(i): g for g, group in enumerate(_candidates(frames, settings)) for i in group}
        self._group = -1
        self._best: tuple[float, int, av.VideoFrame] | None = None

    def keep(self, position: int, sharpness: float, frame: av.VideoFrame) -> None:
        """Take the frame of the row at this position."""
        group = self._group_of.get(position, -1)
        if group != self._group:
            self.flush()
            self._group = group
        if group >= 0 and (self._best is None or sharpness > self._best[0]):
            self._best = (sharpness, position, frame)

    def flush(self) -> None:
        """Write the best frame of the last group."""
        if self._best is None:
            return
        _, position, frame = self._best
        self._best = None
        image = self._frames[position].image
        assert isinstance(image, VideoFrame)
        self.folder.mkdir(parents=True, exist_ok=True)
        spooled_path(self.folder, image).write_bytes(encode_jpeg(rgb_pixels(frame)))


def spooled_path(folder: Path, frame: VideoFrame) -> Path:
    """Where a frame's JPEG is, if it was written."""
    return folder / f"{frame.index:06d}.jpg"


def _candidates(frames: Sequence[RawFrame], settings: ImportSettings) -> list[NDArray[np.int64]]:
    """Groups of frames of which sampling will keep the sharpest, should none be rejected."""
    if not frames or settings.sampling == "all":
        return [np.array([i]) for i in range(len(frames))]
    if settings.sampling == "rate":
        return rate_candidates(np.array([f.t_ns for f in frames], dtype=np.int64), settings.rate_hz)
    poses = np.array([f.vio_T_cam for f in frames], dtype=float)
    return motion_candidates(poses, settings.step_m, settings.step_deg)
