"""What the fuse stage writes: what each method said about each frame, how wrong it was, and the figures."""

from groundwalk.store.choices import MapUnit, Split
from groundwalk.store.schemas import Column, TableSchema, pose_columns

_METHOD = Column("method", "string", "fusion method's id, as in fuse.methods")
_OPTIONS = Column("options", "string", "the method's options, JSON")
_MODEL = Column("model", "string", "the regressor whose predictions went in, as in train.predictions")
_SCENE = Column("scene", "string", "scene of the frame; in a group of scenes its member")
_SESSION = Column("session_id", "string", "capture session")
_STATUS = "reliable, optimised, aligning, predicted, fused, lost or none"

_KEYS = [
    _METHOD,
    _OPTIONS,
    _MODEL,
    _SCENE,
    Column("frame_id", "string", "<session>/<six digits>"),
    _SESSION,
    Column("split", "string", "what the frame is for", choices=Split),
    Column("t_ns", "int64", "capture time on the session's clock", "ns"),
]

_UNCERTAIN = (
    "frames of the subset whose ground truth can't tell whether a pose is within a level (class C): counted in means "
    "and medians, left out of the levels"
)

_SUMMARY_FIGURES = [
    Column("frames", "int64", "frames of the subset"),
    Column("answered", "int64", "frames of the subset with a pose"),
    Column("total", "int64", "all evaluated frames with ground truth; for a method that fuses, of walks with odometry"),
    Column("frames_pct", "float64", "frames / total", "%"),
    Column("coverage_pct", "float64", "answered / frames; null for an empty subset", "%", "", True),
    Column("too_uncertain", "int64", _UNCERTAIN),
    Column("position_mean_m", "float64", "mean APE over the answered frames", "m", "", True),
    Column(
        "position_median_m",
        "float64",
        "median APE over the subset, a frame without a pose counting as infinitely wrong; null where that is infinite",
        "m",
        "",
        True,
    ),
    Column("rotation_mean_deg", "float64", "mean AOE over the answered frames", "deg", "", True),
    Column("rotation_median_deg", "float64", "median AOE over the subset, as position_median_m", "deg", "", True),
    Column(
        "high_pct", "float64", "frames of the subset within 0.25 m and 2 deg, of those not too uncertain", "%", "", True
    ),
    Column("medium_pct", "float64", "the same within 0.5 m and 5 deg", "%", "", True),
    Column("low_pct", "float64", "the same within 5 m and 10 deg", "%", "", True),
]

TABLES = [
    TableSchema(
        "fuse",
        "poses",
        "One row a frame, method and model. `status` and map_cam count a frame as reliable that a later frame "
        "confirmed (the paper's way); `live_status` and live_map_cam are what an app had in time.",
        [
            *_KEYS,
            Column("status", "string", _STATUS),
            *pose_columns("map_cam", "map_T_cam, null where status is none", nullable=True),
            Column("live_status", "string", f"the status in time: {_STATUS}"),
            *pose_columns("live_map_cam", "map_T_cam in time, null where live_status is none", nullable=True),
            Column(
                "covariance",
                "list<float64>",
                "6x6, row-major, of live_map_cam's error: rotation then translation; null where the method has none",
                "rad, m",
                "map",
                True,
            ),
            *pose_columns("map_vio", "alignment in force after the frame, null before there is one", nullable=True),
            Column("reasons", "string", "what led to the live status, codes joined by commas"),
        ],
    ),
    TableSchema(
        "fuse",
        "errors",
        "One row a frame with ground truth, method and model: how wrong the pose was. Null where there was none.",
        [
            *_KEYS,
            Column(
                "quality",
                "string",
                "class of the frame's ground truth: A, B or C; null where it states none",
                nullable=True,
            ),
            Column("status", "string", _STATUS),
            Column("position_m", "float64", "APE of map_cam", "m", "map", True),
            Column("rotation_deg", "float64", "AOE of map_cam", "deg", "", True),
            Column("live_status", "string", f"the status in time: {_STATUS}"),
            Column("live_position_m", "float64", "APE of live_map_cam", "m", "map", True),
            Column("live_rotation_deg", "float64", "AOE of live_map_cam", "deg", "", True),
            Column("raw_position_m", "float64", "APE of the frame's prediction", "m", "map", True),
            Column("raw_rotation_deg", "float64", "AOE of the frame's prediction", "deg", "", True),
        ],
        version="2.0",
    ),
    TableSchema(
        "fuse",
        "signals",
        "The numbers behind the decisions: one row a frame, method, model and number.",
        [
            *_KEYS,
            Column("signal", "string", "rpe_m, roe_deg, similarity, ... (docs/explanation/fusion.md)"),
            Column("value", "float64", "its value"),
        ],
    ),
    TableSchema(
        "fuse",
        "summary",
        "Errors by method, model, scene and subset of frames, for the method and for the raw regressor.",
        [
            _METHOD,
            _OPTIONS,
            _MODEL,
            _SCENE,
            Column(
                "subset",
                "string",
                "rp, opt, rp+opt (by `status`, the paper's); all (poses in time, no pose is a failure); common (frames "
                "that every causal method answered in time with this model)",
            ),
            Column("scored", "string", "whose poses: method, or raw: the predictions, of the same frames"),
            *_SUMMARY_FIGURES,
            Column("map_unit", "string", "what position errors are in", choices=MapUnit),
        ],
        version="3.0",
    ),
    TableSchema(
        "fuse",
        "intervals",
        "How far figures of fuse.summary would move with other walks: bootstrap over sessions, for the method's rows.",
        [
            _METHOD,
            _OPTIONS,
            _MODEL,
            _SCENE,
            Column("subset", "string", "as in fuse.summary"),
            Column("figure", "string", "a column of fuse.summary"),
            Column("value", "float64", "its value; null where that is infinite or there is none", "", "", True),
            Column("low", "float64", "2.5 % bound; null as value, and with a single session", "", "", True),
            Column("high", "float64", "97.5 % bound; null as low", "", "", True),
            Column("sessions", "int64", "sessions that were drawn from"),
            Column("draws", "int64", "different draws that there are: 3 for two sessions, which says little"),
        ],
    ),
    TableSchema(
        "fuse",
        "validation",
        "Each causal method on the frames held out of training: which is ahead is told without the test walks. Missing "
        "where no frames were held out.",
        [
            _METHOD,
            _MODEL,
            _SCENE,
            Column("frames", "int64", "held-out frames with ground truth"),
            Column("coverage_pct", "float64", "share of them that it answered", "%"),
            Column("position_mean_m", "float64", "mean APE over the answered frames", "m", "", True),
            Column("rotation_mean_deg", "float64", "mean AOE over the answered frames", "deg", "", True),
            Column("ahead", "bool", "its geometric mean of both, over the coverage, is the least"),
        ],
    ),
    TableSchema(
        "fuse",
        "sweep",
        "The paper's rule with other thresholds, for each scene and model.",
        [
            _SCENE,
            _MODEL,
            Column("varied", "string", "the threshold that isn't as in the settings; empty in a full grid"),
            Column("n", "int64", "N"),
            Column("d_th_m", "float64", "d_th", "m"),
            Column("o_th_deg", "float64", "o_th", "deg"),
            Column("gamma", "float64", "gamma"),
            Column("subset", "string", "rp+opt (the paper's) or all (in time), as in fuse.summary"),
            *_SUMMARY_FIGURES,
        ],
        version="2.0",
    ),
    TableSchema(
        "fuse",
        "sessions",
        "What a user of the method sees in one session, from the poses in time.",
        [
            _METHOD,
            _OPTIONS,
            _MODEL,
            _SCENE,
            _SESSION,
            Column("split", "string", "what the frame is for", choices=Split),
            Column("frames", "int64", "frames of the session"),
            Column("answered", "int64", "frames with a pose"),
            Column("first_fix_s", "float64", "time to the first pose; null where there is none", "s", "", True),
            Column("longest_outage_s", "float64", "longest time without a pose after the first", "s", "", True),
            Column("jitter_m", "float64", "mean motion a frame beyond VIO's own", "m", "", True),
            Column("jitter_deg", "float64", "mean rotation a frame beyond VIO's own", "deg", "", True),
            Column(
                "recovery_s",
                "float64",
                "after the longest time without a frame, of 10 s or more: until ten answers in a row are on average no "
                "worse than the raw regressor's over the walk; infinite where never, null without such a time",
                "s",
                "",
                True,
            ),
        ],
        version="1.1",
    ),
    TableSchema(
        "fuse",
        "methods",
        "What was run: one row a method.",
        [
            _METHOD,
            _OPTIONS,
            Column("label", "string", "the method as tables print it, behind the model's and a +"),
            Column("fuses", "bool", "uses odometry; false: the raw regressor"),
            Column("causal", "bool", "answers each frame from it and earlier ones; false: offline, sees whole walks"),
            Column("meaning", "string", "the method in a few words"),
        ],
        version="2.0",
    ),
]
