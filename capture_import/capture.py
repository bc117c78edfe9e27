"""What a format's reader returns: a session of logged instants, in one convention whatever the app that wrote it.

Every reader turns its poses into ours: ``vio_T_cam`` takes OpenCV camera axes (x right, y down, z forward) to a metric
world whose +y is up. What a row of the log can't be read from is a `Reject`, never a silent gap.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from groundwalk.geometry.poses import Array
from groundwalk.store.choices import Clock, ImageSide, PoseSource, Rejected, SessionSplit, Tracking, UpSource


@dataclass(frozen=True)
class Limits:
    """How much of a capture is read before it counts as hostile."""

    max_megapixels: float = 100.0
    max_archive_bytes: int = 64 * 2**30  # of all archives of a capture together, unpacked
    max_archive_files: int = 500_000
    max_archive_ratio: float = 20.0  # logs shrink to a tenth, images and videos hardly; beyond the first 100 MiB
    max_text_bytes: int = 1 << 30
    max_rows: int = 500_000  # of a log: more than two hours at 60 Hz
    max_parsed_bytes: int = 512 << 20  # memory for a log's lines, or for what a JSON file holds


@dataclass(frozen=True)
class ImageFile:
    """An image that is a file of the capture."""

    path: Path


@dataclass(frozen=True)
class VideoFrame:
    """The frame of a video with this index, counted from 0 in the order of display."""

    path: Path
    index: int


ImageRef = ImageFile | VideoFrame


@dataclass(frozen=True)
class DepthFile:
    """A depth image of a frame, and the sensor's confidence in each of its pixels.

    `path` is a 16-bit PNG of one channel: millimetres along the camera's z axis, 0: none. It shows what the frame's
    image shows, at another resolution. `confidence` is an 8-bit PNG of the same size: 0, 1, 2 or 0, 127, 255 for low,
    medium and high. Import makes such PNGs of `.depth` and `.conf` (pixels row by row, compressed by LZFSE) and `.exr`,
    whose depth is in metres as float32.
    """

    path: Path
    confidence: Path | None = None

    @classmethod
    def if_there(cls, path: Path, confidence: Path) -> "DepthFile | None":
        """The depth image at `path`, with its confidence where that is there; None where there is no depth image."""
        return cls(path, confidence if confidence.exists() else None) if path.exists() else None


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera in pixels, with (0, 0) the outer corner of the first pixel as in COLMAP.

    `width` and `height` are the size that the capture states for them; None where it states none. `distortion` holds
    OpenCV's coefficients k1, k2, p1, p2, k3, ...; empty for an image that is already a pinhole image.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int | None = None
    height: int | None = None
    distortion: tuple[float, ...] = ()

    @classmethod
    def of(cls, fx_fy_cx_cy: Iterable[float], width: int | None = None, height: int | None = None) -> "Intrinsics":
        """From the four numbers as most logs have them in a row."""
        fx, fy, cx, cy = fx_fy_cx_cy
        return cls(fx, fy, cx, cy, width, height)


@dataclass(frozen=True)
class RawFrame:
    """One logged instant: an image, a pose or both.

    `number` is the row's place in the log and becomes the frame's number; `source` names the row for the user.
    `vio_T_cam` (4, 4) is None where the app logs poses apart from images: it's interpolated then. `split` is what a
    public data set states that the image is for, where that differs within a recording.
    """

    number: int
    source: str
    t_ns: int
    vio_T_cam: Array | None
    image: ImageRef | None = None
    intrinsics: Intrinsics | None = None
    tracking: Tracking = Tracking.UNKNOWN
    exposure_s: float | None = None
    depth: DepthFile | None = None
    split: SessionSplit | None = None

    @property
    def content(self) -> Rejected:
        """What is lost where the row is rejected."""
        return Rejected.POSE if self.image is None else Rejected.IMAGE


@dataclass(frozen=True)
class Reject:
    """A row or file that is excluded, and why; `rejected` is what is lost by it, None for a row that can't be read."""

    session_id: str
    source: str
    t_ns: int | None
    reason: str
    rejected: Rejected | None = None


@dataclass(frozen=True)
class RawSession:
    """One recording, in the order of its log.

    `pose_source`: the phone's odometry, or a reference from elsewhere, as in public data sets, which must never pass
    for VIO. `is_gravity_aligned` is False where the world's +y may not be up, `up_source` what says so: a format sets
    `STATED` where the capture itself does, and import tests the rest (`checks/gravity.py`). `is_metric` is False where
    a reference states no unit. `split` is what a public data set states that the recording is for. `first_row` is the
    side of the images that the sensor reads out first, `readout_s` the time from there to the last row, where the
    capture states them.
    """

    session_id: str
    format: str
    device: str
    clock: Clock
    folder: Path
    frames: Sequence[RawFrame]
    rejects: Sequence[Reject] = ()
    pose_source: PoseSource = PoseSource.VIO
    is_gravity_aligned: bool = True
    up_source: UpSource = UpSource.FORMAT
    is_metric: bool = True
    split: SessionSplit | None = None
    first_row: ImageSide | None = None
    readout_s: float | None = None
    notes: Sequence[str] = field(default_factory=tuple)
