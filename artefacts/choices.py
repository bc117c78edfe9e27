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


class PairOrigin(StrEnum):
    """What proposed a pair of frames."""

    SEQUENCE = "sequence"
    VIO = "vio"
    RETRIEVAL = "retrieval"
    TRANSITIVE = "transitive"


class PairStatus(StrEnum):
    """Of a matched pair of frames; only verified ones go into mapping."""

    VERIFIED = "verified"
    TOO_FEW_INLIERS = "too_few_inliers"
    INCONSISTENT_WITH_VIO = "inconsistent_with_vio"


class PairInconsistency(StrEnum):
    """What of a pair's relative pose is inconsistent with VIO."""

    NONE = ""
    ROTATION = "rotation"
    GRAVITY = "gravity"
    DIRECTION = "direction of motion"


class AttemptName(StrEnum):
    """What an attempt at SfM models changes."""

    DEFAULT = "default"
    MORE_PAIRS = "more_pairs"
    STRICTER_PAIRS = "stricter_pairs"
    MORE_FEATURES = "more_features"
    OTHER_MAPPER = "other_mapper"
    VIO_START = "vio_start"


class AttemptOutcome(StrEnum):
    """Of an attempt at SfM models."""

    ACCEPTED = "accepted"
    NO_MODEL = "no_model"
    TOO_FEW_REGISTERED = "too_few_registered"
    FRAMES_MISSING = "frames_missing"
    INCONSISTENT_WITH_VIO = "inconsistent_with_vio"


class ResidualPattern(StrEnum):
    """What residuals are averaged over."""

    RADIUS = "radius"
    ROW = "row"
