"""What a capture consists of: its recordings as formats read them, and the sessions that checks leave of them.

Every format turns its poses into ours: ``vio_T_cam`` takes OpenCV camera axes (x right, y down, z forward) to a metric
world whose +y is up. What a row of the log can't be read from is a `Reject`, never a silent gap.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
    path: Path


@dataclass(frozen=True)
class VideoFrame:
    """The frame of a video with this index, counted from 0 in the order of display."""

    path: Path
    index: int


@dataclass(frozen=True)
class DepthFile:
    """A depth image of a frame, and the sensor's confidence in each of its pixels.

    `path` is a 16-bit PNG of one channel: millimetres along the camera's z axis, 0: none. It shows what the frame's
    image shows, at another resolution. `confidence` is an 8-bit PNG of the same size: 0, 1, 2 or 0, 127, 255 for low,
    medium and high. Import makes such PNGs of `.depth` and `.conf` (pixels row by row, compressed by LZFSE) and `.exr`,
    whose depth is in metres as float32, and of PNGs with another number of `units_per_m`.
    """

    path: Path
    confidence: Path | None = None
    units_per_m: int = 1000

    @classmethod
    def if_there(cls, path: Path, confidence: Path | None = None) -> "DepthFile | None":
        """The depth image at `path`, with its confidence where that is there; None where there is no depth image."""
        return cls(path, confidence if confidence and confidence.exists() else None) if path.exists() else None


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera in pixels, with (0, 0) the outer corner of the first pixel as in COLMAP.

    `width` and `height` are the size that the capture states for them; None where it states none. `distortion` holds
    OpenCV's coefficients k1, k2, p1, p2, k3, ...; empty where nothing is stated, zeros where it's stated to be none.
    `focal_sd` is the focal length's standard error as a fraction, where it isn't the camera's own: EXIF's, or a guess.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int | None = None
    height: int | None = None
    distortion: tuple[float, ...] = ()
    focal_sd: float = 0.0


@dataclass(frozen=True)
class RawFrame:
    """One logged instant: an image, a pose or both.

    `vio_T_cam` (4, 4) is None where the app logs poses apart from images: it's interpolated then. `quarters` is how
    many quarter turns clockwise EXIF or a video states for its stored pixels; its intrinsics are of the turned image.
    `camera_name` tells the cameras of a recording of several apart. `split` is what a public data set states that the
    image is for, where that differs within a recording. `number` becomes the frame's number, `source` names the row for
    the user: `parsing.read_rows` sets both, the number where the log has none of its own to the row's place.
    """

    t_ns: int
    vio_T_cam: Array | None = None
    image: ImageFile | VideoFrame | None = None
    intrinsics: Intrinsics | None = None
    tracking: Tracking = Tracking.UNKNOWN
    exposure_s: float | None = None
    depth: DepthFile | None = None
    quarters: int = 0
    camera_name: str = ""
    split: SessionSplit | None = None
    number: int = -1
    source: str = ""


@dataclass(frozen=True)
class Reject:
    """A row or file that is excluded, and why; `rejected` is what is lost by it, None for a row that can't be read."""

    source: str
    t_ns: int | None
    reason: str
    rejected: Rejected | None = None

    @classmethod
    def of(cls, frame: RawFrame, reason: str) -> "Reject":
        """Of a row that could be read."""
        return cls(frame.source, frame.t_ns, reason, Rejected.POSE if frame.image is None else Rejected.IMAGE)


@dataclass(frozen=True)
class GpsFix:
    """A position on earth (WGS84, degrees) that a phone states at a time on the clock of the poses.

    `altitude_m` is as stated, by phones above sea level. `accuracy_m` is the radius of a circle with 68 % of positions,
    `altitude_sd_m` one sigma; each is NaN where it isn't stated.
    """

    t_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float = math.nan
    accuracy_m: float = math.nan
    altitude_sd_m: float = math.nan


@dataclass(frozen=True)
class Accelerations:
    """What a phone's accelerometer logged: times (M,) on the clock of the poses, and the force that it felt, (M, 3),
    along the camera's OpenCV axes in any unit. At rest it points up."""

    t_ns: NDArray[np.int64]
    force_cam: Array


@dataclass(frozen=True)
class Recording:
    """One recording, in the order of its log.

    `pose_source`: the phone's odometry, a reference from elsewhere, as in public data sets, which must never pass for
    VIO, or none: then no row has a pose. `is_gravity_aligned` is False where the world's +y may not be up, `up_source`
    what says so: a format sets `STATED` where the capture itself does, and import tests the rest (`checks/gravity.py`).
    `is_metric` is False where a reference states no unit. `split` is what a public data set states that the recording
    is for. `first_row` is the side of the images that the sensor reads out first, `readout_s` the time from there to
    the last row, where the capture states them. `has_intrinsics` is False where it states no intrinsics: those of the
    frames are a guess, whose focal length import corrects by the poses. `read_gps` reads its positions on earth, and is
    called only where the user asks for them; None where it has none. `recording_id` and `format` are set by whoever
    calls a format's `read`.
    """

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
    has_intrinsics: bool = True
    accelerations: Accelerations | None = None
    read_gps: Callable[[], tuple[list[GpsFix], list[Reject]]] | None = None
    notes: Sequence[str] = field(default_factory=tuple)
    recording_id: str = ""
    format: str = ""


@dataclass(frozen=True)
class ImageCheck:
    """Size, sharpness, contrast (standard deviation of grey levels, of 255) and hashes of an image: of its file, and of
    that without metadata. A video's frame has no hash; `part` is how many cuts are before it."""

    width: int
    height: int
    sharpness: float
    contrast: float
    sha256: str
    content_sha256: str
    part: int = 0


@dataclass(frozen=True)
class Image(RawFrame):
    """A row of the log whose image is sound, with a pose and intrinsics, and what was measured of the image."""

    check: ImageCheck = field(kw_only=True)

    @property
    def camera(self) -> Intrinsics:
        """Its intrinsics, which no sound image lacks."""
        assert self.intrinsics is not None
        return self.intrinsics


@dataclass(frozen=True)
class Jump:
    """A step of the odometry to pose `index`, from the one before or, over untracked ones, the last tracked one, that
    its surroundings don't explain; `splits`: so large that the session ends there."""

    index: int
    t_ns: int
    dt_s: float
    jump_m: float
    jump_deg: float
    splits: bool


@dataclass(frozen=True)
class Session:
    """A recording, or the part of one between two large jumps of its odometry or two cuts, or of one camera of several.

    `frames` are all rows with a sound pose (all rows where none has one), in time order, those with a sound image as
    `Image`; `rejects` the other rows and images of the recording that fall into it.
    """

    session_id: str
    recording: Recording
    frames: list[RawFrame]
    jumps: Sequence[Jump] = ()
    rejects: Sequence[Reject] = ()

    @cached_property
    def images(self) -> list[Image]:
        """Those of its frames that have a sound image."""
        return [frame for frame in self.frames if isinstance(frame, Image)]

    def frame_id(self, number: int) -> str:
        """The id of its frame with this number in the log."""
        return f"{self.session_id}/{number:06d}"

    @property
    def t_ns(self) -> NDArray[np.int64]:
        """Times (N,) of its frames."""
        return np.array([frame.t_ns for frame in self.frames], dtype=np.int64)

    @property
    def poses(self) -> Array:
        """Poses (N, 4, 4) of its frames."""
        return poses_of(self.frames)

    def poses_at(self, frame_ids: Iterable[str]) -> Array:
        """Poses (N, 4, 4) of its images with these ids."""
        pose_of = {self.frame_id(image.number): image.vio_T_cam for image in self.images}
        return np.array([pose_of[frame_id] for frame_id in frame_ids], dtype=float).reshape(-1, 4, 4)

    @property
    def has_vio(self) -> bool:
        """Whether its poses are the phone's odometry."""
        return self.recording.pose_source == PoseSource.VIO

    @property
    def has_reference(self) -> bool:
        """Whether its poses are from elsewhere."""
        return self.recording.pose_source == PoseSource.REFERENCE

    @property
    def has_poses(self) -> bool:
        """Whether it has poses at all."""
        return self.recording.pose_source != PoseSource.NONE


def poses_of(frames: Iterable[RawFrame]) -> Array:
    """Poses (N, 4, 4) of rows; NaN of those that have none."""
    poses = [np.full((4, 4), np.nan) if frame.vio_T_cam is None else frame.vio_T_cam for frame in frames]
    return np.array(poses, dtype=float).reshape(-1, 4, 4)
