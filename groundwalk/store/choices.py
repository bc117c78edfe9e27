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


class Rejected(StrEnum):
    """What of a capture was rejected."""

    IMAGE = "image"
    POSE = "pose"
    DEPTH = "depth"


class Tracking(StrEnum):
    """The odometry's state, as the app says."""

    NORMAL = "normal"
    LIMITED = "limited"
    LOST = "lost"
    UNKNOWN = "unknown"


class ImageSide(StrEnum):
    """A side of an image."""

    TOP = "top"
    RIGHT = "right"
    BOTTOM = "bottom"
    LEFT = "left"


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


class PoseSource(StrEnum):
    """Whose poses a capture has: the phone's odometry, a data set's reference, or none, as photos and videos."""

    VIO = "vio"
    REFERENCE = "reference"
    NONE = "none"


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


class Appearance(StrEnum):
    """What a simulated place looks like on its test walks, beside the training walks."""

    SAME = "same"
    OTHER_HOUR = "other_hour"
    EVENING = "evening"
    OTHER_MONTH = "other_month"


class PairOrigin(StrEnum):
    """What proposed a pair of frames."""

    SEQUENCE = "sequence"
    VIO = "vio"
    RETRIEVAL = "retrieval"
    TRANSITIVE = "transitive"
    EXHAUSTIVE = "exhaustive"


class PairStatus(StrEnum):
    """Of a matched pair of frames; only verified ones go into mapping."""

    VERIFIED = "verified"
    TOO_FEW_INLIERS = "too_few_inliers"
    INCONSISTENT_WITH_VIO = "inconsistent_with_vio"
    INCONSISTENT_WITH_NEIGHBOURS = "inconsistent_with_neighbours"


class PairInconsistency(StrEnum):
    """What of a pair is inconsistent with VIO or, without it, with the map that neighbouring images make."""

    NONE = ""
    ROTATION = "rotation"
    GRAVITY = "gravity"
    DIRECTION = "direction of motion"
    NEIGHBOURS = "points in the map of neighbours"


class AttemptName(StrEnum):
    """What an attempt at SfM models changes."""

    DEFAULT = "default"
    MORE_PAIRS = "more_pairs"
    STRICTER_PAIRS = "stricter_pairs"
    MORE_FEATURES = "more_features"
    ADDED = "added"


class AttemptOutcome(StrEnum):
    """Of an attempt at SfM models."""

    ACCEPTED = "accepted"
    NO_MODEL = "no_model"
    TOO_FEW_REGISTERED = "too_few_registered"
    FRAMES_MISSING = "frames_missing"
    INCONSISTENT_WITH_VIO = "inconsistent_with_vio"


class NotRegistered(StrEnum):
    """Why SfM has no pose for a frame."""

    NO_VERIFIED_PAIRS = "no verified pairs"
    MISPLACED = "its verified matches contradict the pose that mapping gave it"
    NOT_MAPPED = "mapping found too few points of the model in it"


class ScaleSource(StrEnum):
    """What gives a map its metric scale. A table's text may name rulers instead (`ruler: <names>`), and end with
    `, uncertain`."""

    VIO = "vio"
    REFERENCE = "reference"
    REFERENCE_UNIT_UNKNOWN = "reference, unit unknown"
    NONE = "none"


class GroundTruthChange(StrEnum):
    """What made a version of a ground truth."""

    BUILT = "built"
    ADDED = "added"
    REMOVED = "removed"


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
    NONE = "none"

    @property
    def is_known(self) -> bool:
        """The map's +y is up."""
        return self in (VerticalSource.GRAVITY, VerticalSource.REFERENCE)


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


class CheckName(StrEnum):
    """A consistency check of align."""

    REGISTERED = "registered"
    SESSION_REGISTERED = "session_registered"
    COMPONENT_SCALE = "component_scale"
    COMPONENT_LINK = "component_link"
    MAP_SCALE = "map_scale"
    MAP_VERTICAL = "map_vertical"
    REFERENCE_SCALE = "reference_scale"
    REFERENCE_VERTICAL = "reference_vertical"
    RULER_SCALE = "ruler_scale"
    CONTROL_POINTS = "control_points"
    SESSION_FOCAL_LENGTH = "session_focal_length"
    SESSION_MOTION = "session_motion"
    SESSION_TURNS = "session_turns"
    SESSION_ALIASING = "session_aliasing"
    SESSION_SCALE = "session_scale"
    SESSION_VERTICAL = "session_vertical"
    SESSION_UNCERTAIN = "session_uncertain"
    SESSION_REFERENCE = "session_reference"
    SESSION_DEPTH_SCALE = "session_depth_scale"
    SESSION_DEPTH_BY_DISTANCE = "session_depth_by_distance"
    WINDOW_POSITION = "window_position"
    WINDOW_ROTATION = "window_rotation"


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


class RulerKind(StrEnum):
    """A printed board, printed tags, or two points a known distance apart."""

    CHARUCO = "charuco"
    APRILTAG = "apriltag"
    DISTANCE = "distance"


class RulerPart(StrEnum):
    """Corners of a ruler: all; of one that sets the scale those that may, and those that judge it."""

    ALL = "all"
    FOR_SCALE = "for_scale"
    HELD_OUT = "held_out"


class ReferenceAlignment(StrEnum):
    """The transform between a map and reference poses before they are compared."""

    MODEL_SIM3 = "model_sim3"
    SE3 = "se3"
    SIM3 = "sim3"
    NONE = "none"


class DriftDefinition(StrEnum):
    """A measure of VIO drift (docs/explanation/ground-truth.md)."""

    PAPER_RPE = "paper_rpe"
    PAPER_ROE = "paper_roe"
    RELATIVE_POSITION = "relative_position"
    RELATIVE_ROTATION = "relative_rotation"
    DISTANCE_POSITION = "distance_position"
    DISTANCE_ROTATION = "distance_rotation"
    YAW_RATE = "yaw_rate"
    ATE_SE3 = "ate_se3"
    ATE_YAW = "ate_yaw"
    ATE_SIM3 = "ate_sim3"


class DriftInterval(StrEnum):
    """What the interval of a drift measure counts."""

    SECONDS = "s"
    METRES = "m"
    PAIR = "pair"
    PATH = "path"


class Refusal(StrEnum):
    """Why a structure localiser gives no pose."""

    BAD_INPUT = "bad_input"
    IMAGE_SIZE = "image_size"
    FEW_FEATURES = "few_features"
    FEW_MATCHES = "few_matches"
    NO_POSE = "no_pose"
    THIN_EVIDENCE = "thin_evidence"
