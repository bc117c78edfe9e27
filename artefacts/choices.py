"""What text columns of tables can hold, one enumeration each; writing a table checks them."""

from enum import StrEnum


class Split(StrEnum):
    """What a frame is for. `val` is held out of the training walks, to choose the epoch."""

    TRAIN = "train"
    VAL = "val"
    TEST = "test"


class SessionSplit(StrEnum):
    """What a session is for; `mixed`: parts of it for each."""

    TRAIN = "train"
    TEST = "test"
    MIXED = "mixed"
    UNUSED = "unused"


class Tracking(StrEnum):
    """The odometry's state, as the app says."""

    NORMAL = "normal"
    LIMITED = "limited"
    LOST = "lost"
    UNKNOWN = "unknown"


class Clock(StrEnum):
    """What times count from."""

    BOOT = "boot"
    UNIX = "unix"
    VIDEO = "video"
    FRAME_INDEX = "frame_index"


class PoseSource(StrEnum):
    """Whose poses a capture has: the phone's odometry, or a data set's reference."""

    VIO = "vio"
    REFERENCE = "reference"


class CameraOrigin(StrEnum):
    """Where a lens is from: what the capture states, an estimate from the images, or what phones usually have."""

    STATED = "stated"
    ESTIMATED = "estimated"
    PRIOR = "prior"


class QualityClass(StrEnum):
    """Of a frame's ground truth."""

    A = "A"
    B = "B"
    C = "C"
    NONE = "none"


class Environment(StrEnum):
    """Of a scene."""

    OUTDOOR = "outdoor"
    INDOOR = "indoor"
    UNKNOWN = "unknown"
