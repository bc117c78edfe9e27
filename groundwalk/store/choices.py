"""What text columns of tables can hold, one enumeration each; writing a table checks them. Where names are all that one
is made of, their lower case is the text."""

from enum import StrEnum

Split = StrEnum("Split", "TRAIN VAL TEST")
"""What a frame is for. `val` is held out of the training walks, to choose the epoch."""

SessionSplit = StrEnum("SessionSplit", "TRAIN TEST MIXED UNUSED")
"""What a session is for; `mixed`: parts of it for each."""

Rejected = StrEnum("Rejected", "IMAGE POSE DEPTH RECORDING")
"""What of a capture was rejected."""

Tracking = StrEnum("Tracking", "NORMAL LIMITED LOST UNKNOWN")
"""The odometry's state, as the app says."""
UNTRACKED = (Tracking.LIMITED, Tracking.LOST)
"""A phone that calls its tracking so may stand still in VIO while it moves."""

ImageSide = StrEnum("ImageSide", "TOP RIGHT BOTTOM LEFT")
"""A side of an image."""


class Clock(StrEnum):
    """What times count from. `frame_index`: from the first frame, at the rate that the capture states for all of them.
    `name_order`: nothing; images without times, which stand 1 s apart in the order of their names, or EXIF's dates."""

    BOOT = "boot"
    UNIX = "unix"
    VIDEO = "video"
    FRAME_INDEX = "frame_index"
    NAME_ORDER = "name_order"

    @property
    def has_times(self) -> bool:
        """Whether differences of times are durations. Where False, no speed, rate or distance in seconds means
        anything, and images next to each other needn't be near in time or place."""
        return self is not Clock.NAME_ORDER


PoseSource = StrEnum("PoseSource", "VIO REFERENCE NONE")
"""Whose poses a capture has: the phone's odometry, a data set's reference, or none, as photos and videos."""

CameraOrigin = StrEnum("CameraOrigin", "STATED ESTIMATED PRIOR")
"""Where a lens is from: what the capture states, an estimate from the images, or what phones usually have."""


class QualityClass(StrEnum):
    """Of a frame's ground truth."""

    A = "A"
    B = "B"
    C = "C"
    NONE = "none"


Environment = StrEnum("Environment", "OUTDOOR INDOOR UNKNOWN")
"""Of a scene."""

PairOrigin = StrEnum("PairOrigin", "SEQUENCE VIO RETRIEVAL TRANSITIVE EXHAUSTIVE")
"""What proposed a pair of frames."""

PairStatus = StrEnum("PairStatus", "VERIFIED TOO_FEW_INLIERS INCONSISTENT_WITH_VIO INCONSISTENT_WITH_NEIGHBOURS")
"""Of a matched pair of frames; only verified ones go into mapping."""


class PairInconsistency(StrEnum):
    """What of a pair is inconsistent with VIO or, without it, with the map that neighbouring images make."""

    NONE = ""
    ROTATION = "rotation"
    GRAVITY = "gravity"
    DIRECTION = "direction of motion"
    NEIGHBOURS = "points in the map of neighbours"


AttemptName = StrEnum("AttemptName", "DEFAULT MORE_PAIRS STRICTER_PAIRS MORE_FEATURES VIO_START ADDED")
"""What an attempt at SfM models changes."""

AttemptOutcome = StrEnum("AttemptOutcome", "ACCEPTED NO_MODEL TOO_FEW_REGISTERED FRAMES_MISSING INCONSISTENT_WITH_VIO")
"""Of an attempt at SfM models."""


class NotRegistered(StrEnum):
    """Why SfM has no pose for a frame."""

    NO_VERIFIED_PAIRS = "no verified pairs"
    MISPLACED = "its verified matches contradict the pose that mapping gave it"
    NOT_MAPPED = "mapping found too few points of the model in it"


class ScaleSource(StrEnum):
    """What gives a map its metric scale. A table's text may name rulers or a survey instead (`ruler: <names>`,
    `control: <name>`), and end with `, uncertain`."""

    VIO = "vio"
    REFERENCE = "reference"
    REFERENCE_UNIT_UNKNOWN = "reference, unit unknown"
    GPS = "gps"
    NONE = "none"


GroundTruthChange = StrEnum("GroundTruthChange", "BUILT ADDED REMOVED")
"""What made a version of a ground truth."""


class MapUnit(StrEnum):
    """What a map's lengths are in: metres, unless nothing gave it metric scale."""

    METRE = "metres"
    SFM = "SfM's unit"
    REFERENCE = "a reference's unknown unit"

    @property
    def symbol(self) -> str:
        """As it stands behind a number or in a heading."""
        return "m" if self is MapUnit.METRE else "map units"


class VerticalSource(StrEnum):
    """What gives a map its +y."""

    GRAVITY = "gravity"
    REFERENCE = "reference"
    REFERENCE_UP_UNKNOWN = "reference, up unknown"
    CONTROL = "control points"
    LINES = "lines in the images"
    GPS = "gps"
    NONE = "none"

    @property
    def is_known(self) -> bool:
        """The map's +y is up."""
        return self not in (VerticalSource.REFERENCE_UP_UNKNOWN, VerticalSource.NONE)


class LengthUnit(StrEnum):
    """Of poses that a data set states."""

    METRE = "m"
    UNKNOWN = "unknown"


class UpAxis(StrEnum):
    """Of the world that a capture's poses are in."""

    Y = "+y"
    UNKNOWN = "unknown"


class UpSource(StrEnum):
    """What says whether +y is up in the world that a capture's poses are in."""

    FORMAT = "format"
    STATED = "stated"
    START_POSE = "start pose"
    ACCELEROMETER = "accelerometer"
    LINES = "lines in the images"


CheckName = StrEnum(
    "CheckName",
    "REGISTERED SESSION_REGISTERED COMPONENT_SCALE COMPONENT_LINK MAP_SCALE MAP_VERTICAL REFERENCE_SCALE "
    "REFERENCE_VERTICAL RULER_SCALE CONTROL_POINTS SESSION_FOCAL_LENGTH SESSION_MOTION SESSION_TURNS "
    "SESSION_ALIASING SESSION_SCALE SESSION_VERTICAL SESSION_REFERENCE SESSION_DEPTH_SCALE SESSION_DEPTH_BY_DISTANCE "
    "WINDOW_POSITION WINDOW_ROTATION",
)
"""A consistency check of align."""


class FailureCause(StrEnum):
    """What a failed check says is wrong with the input; where several fail, the first of these names the run."""

    MIRRORED_IMAGES = "mirrored images"
    MISMATCHED_IMAGES = "images and poses mismatched"
    WRONG_INTRINSICS = "wrong intrinsics"
    PERCEPTUAL_ALIASING = "perceptual aliasing"
    WRONG_VIO_SCALE = "wrong VIO scale"
    WRONG_VIO_GRAVITY = "wrong VIO gravity"
    OTHER_SCENE = "images of another scene"
    DISCONNECTED_SESSION = "disconnected session"
    TOO_FEW_REGISTERED = "too few frames registered"
    VIO_INCONSISTENT = "SfM and VIO inconsistent"
    REFERENCE_INCONSISTENT = "SfM and reference inconsistent"
    RULER_INCONSISTENT = "ruler and map inconsistent"
    CONTROL_INCONSISTENT = "control points and map inconsistent"
    DEPTH_INCONSISTENT = "depth sensor and map inconsistent"
    UNCERTAIN = "uncertain"


class CheckUnit(StrEnum):
    """Of a check's value, standard error and limit."""

    FRACTION = "fraction"
    METRES = "m"
    DEGREES = "deg"
    FRAMES = "frames"


RulerKind = StrEnum("RulerKind", "CHARUCO APRILTAG DISTANCE")
"""A printed board, printed tags, or two points a known distance apart."""

RulerPart = StrEnum("RulerPart", "ALL FOR_SCALE HELD_OUT")
"""Corners of a ruler: all; of one that sets the scale those that may, and those that judge it."""

ReferenceAlignment = StrEnum("ReferenceAlignment", "MODEL_SIM3 SE3 SIM3 NONE")
"""The transform between a map and reference poses before they are compared."""

DriftDefinition = StrEnum(
    "DriftDefinition",
    "PAPER_RPE PAPER_ROE RELATIVE_POSITION RELATIVE_ROTATION DISTANCE_POSITION DISTANCE_ROTATION YAW_RATE ATE_SE3 "
    "ATE_YAW ATE_SIM3",
)
"""A measure of VIO drift (docs/explanation/ground-truth.md)."""


class DriftInterval(StrEnum):
    """What the interval of a drift measure counts."""

    SECONDS = "s"
    METRES = "m"
    PAIR = "pair"
    PATH = "path"


Refusal = StrEnum("Refusal", "BAD_INPUT IMAGE_SIZE FEW_FEATURES FEW_MATCHES NO_POSE THIN_EVIDENCE")
"""Why a structure localiser gives no pose."""
