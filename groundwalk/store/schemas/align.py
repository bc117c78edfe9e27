"""What the align stage writes: the ground truth, how VIO compares with it, and what was checked."""

from groundwalk.consistency.decisions import Status
from groundwalk.store.choices import (
    CameraOrigin,
    CheckName,
    CheckUnit,
    DriftDefinition,
    DriftInterval,
    FailureCause,
    GroundTruthChange,
    LengthUnit,
    QualityClass,
    ReferenceAlignment,
    RulerKind,
    RulerPart,
    Split,
    VerticalSource,
)
from groundwalk.store.schemas import Column, TableSchema, pose_columns

_SESSION = Column("session_id", "string", "capture session")
_SEGMENT = Column("segment", "int64", "part of the session between two VIO jumps, from 0")
_COMPONENT = Column("component", "int64", "SfM model that the poses are from, largest first, from 0", nullable=True)

TABLES = [
    TableSchema(
        "align",
        "versions",
        "What changed with each version of the ground truth, one row a session: version 1 was built as a whole, each "
        "further one adds recordings or takes some out. Frames of a session have the same rows in all versions that "
        "have it.",
        [
            Column("version", "int64", "from 1; a ground truth that is built anew begins with 1"),
            Column("change", "string", "what became of the session", choices=GroundTruthChange),
            _SESSION,
            Column("frames", "int64", "its frames"),
            Column("with_ground_truth", "int64", "those with ground truth"),
            *(Column(f"quality_{name}", "int64", f"those of class {name}") for name in "ABC"),
            Column("position_sd_m", "float64", "median of ground_truth.position_sd_m", "m", "map", True),
        ],
    ),
    TableSchema(
        "align",
        "ground_truth",
        "One row a frame: where its camera was in the map (metric, +y up). Frames without ground truth have quality "
        "'none' and a null pose.",
        [
            Column("frame_id", "string", "<session>/<six digits>"),
            _SESSION,
            Column("split", "string", "what the frame is for", choices=Split),
            Column("t_ns", "int64", "capture time on the session's clock", "ns"),
            *pose_columns("map_cam", "ground truth map_T_cam", nullable=True),
            Column(
                "component",
                "int64",
                "SfM model that the pose is from; all but 0 lie in the map by VIO; null without ground truth",
                nullable=True,
            ),
            Column(
                "covariance",
                "list<float64>",
                "6x6, row-major, of (rotation, position) with true rotation = exp(rotation) @ map_R_cam and true "
                "position = map_t_cam + position: SfM's part, the map's scale and vertical, and VIO's where it links "
                "models; null where SfM has none",
                "rad, m",
                "map",
                True,
            ),
            Column(
                "position_sd_m",
                "float64",
                "standard error in the least certain axis, without scale and vertical",
                "m",
                "map",
                True,
            ),
            Column(
                "rotation_sd_deg",
                "float64",
                "standard error about the least certain axis, without scale and vertical",
                "deg",
                "map",
                True,
            ),
            Column("quality", "string", "quality class (docs/explanation/ground-truth.md)", choices=QualityClass),
            Column("reason", "string", "why quality is B, C or none, with the figure and its limit; empty for A"),
            Column("gt_uses_vio", "bool", "VIO positions took part: in the bundle adjustment, or in placing its model"),
            Column(
                "scale_source",
                "string",
                "what gives it its metric scale: vio, ruler: names, or reference (import.reference, in metres); with "
                "', uncertain' where its standard error is above 2 %; none: all lengths are in SfM's unit; "
                "reference, unit unknown: all lengths are in the reference's unit; null without ground truth",
                nullable=True,
            ),
            Column(
                "vertical_source",
                "string",
                "what gave the map its +y: gravity; reference (whose +y is up); reference, up unknown: the map has "
                "the reference's axes; none: +y may point anywhere; null without ground truth",
                nullable=True,
                choices=VerticalSource,
            ),
            Column("fx", "float64", "focal length, x, that goes with the pose; as calibrated where SfM has none", "px"),
            Column("fy", "float64", "focal length, y, that goes with the pose; as calibrated where SfM has none", "px"),
            Column("cx", "float64", "principal point, x; the first pixel's outer corner is 0", "px"),
            Column("cy", "float64", "principal point, y; the first pixel's outer corner is 0", "px"),
            Column("distortion", "list<float64>", "OpenCV's k1, k2, p1, p2, k3, ... that go with the pose"),
            Column(
                "camera_origin", "string", "where the lens is from, before the model adjusts it", choices=CameraOrigin
            ),
        ],
        version="2.0",
    ),
    TableSchema(
        "align",
        "sessions",
        "One row a session, or a part of one between VIO jumps or in another SfM model: where its VIO frame lies in "
        "the map, and how well it fits. Null where the part has too few frames.",
        [
            _SESSION,
            _SEGMENT,
            _COMPONENT,
            Column(
                "vio_link_m",
                "float64",
                "VIO path without a registered frame over which this model is linked to the map; null for the first",
                "m",
                "vio",
                True,
            ),
            Column("t_start_ns", "int64", "first frame", "ns"),
            Column("t_end_ns", "int64", "last frame", "ns"),
            Column("frames", "int64", "frames of this part"),
            Column("registered", "int64", "frames that SfM registered"),
            Column("with_ground_truth", "int64", "frames with ground truth"),
            Column("path_m", "float64", "length of the VIO path through the frames", "m", "vio"),
            *pose_columns("map_vio", "map_T_vio, rigid fit", nullable=True),
            *pose_columns("map_vio_yaw", "map_T_vio, fit of yaw and translation only", nullable=True),
            Column("scale_source", "string", "what gives the map its metric scale, as in ground_truth"),
            Column("scale", "float64", "metres of this session's VIO per metre of the map", "", "", True),
            Column("scale_sd", "float64", "standard error of scale, by the scatter of its steps", "", "", True),
            Column(
                "up_error_deg", "float64", "angle between this session's vertical and the map's", "deg", "map", True
            ),
            Column("position_rms_m", "float64", "residual of the rigid fit", "m", "map", True),
            Column("position_median_m", "float64", "residual of the rigid fit", "m", "map", True),
            Column("position_max_m", "float64", "residual of the rigid fit", "m", "map", True),
            Column("rotation_rms_deg", "float64", "residual of the rigid fit", "deg", "map", True),
            Column("rotation_median_deg", "float64", "residual of the rigid fit", "deg", "map", True),
            Column("rotation_max_deg", "float64", "residual of the rigid fit", "deg", "map", True),
            Column("yaw_position_rms_m", "float64", "residual of the yaw and translation fit", "m", "map", True),
            Column("yaw_rotation_rms_deg", "float64", "residual of the yaw and translation fit", "deg", "map", True),
            Column("sim3_position_rms_m", "float64", "residual of a fit with scale, all frames", "m", "map", True),
            Column(
                "sim3_rotation_median_deg",
                "float64",
                "residual of a fit of rotations alone, all frames",
                "deg",
                "map",
                True,
            ),
        ],
        version="3.0",
    ),
    TableSchema(
        "align",
        "drift",
        "How far VIO moves away from the ground truth, one row a session, definition and interval; session 'all' pools "
        "the samples of all sessions.",
        [
            Column("session_id", "string", "capture session, or 'all'"),
            Column("definition", "string", "measure (docs/explanation/ground-truth.md)", choices=DriftDefinition),
            Column("interval", "float64", "length of the compared pieces; null for a whole path", "", "", True),
            Column("interval_unit", "string", "what the interval counts", choices=DriftInterval),
            Column("unit", "string", "unit of the samples: m, deg, %, deg/m, deg/min, deg/100m"),
            Column("samples", "int64", "number of compared pieces"),
            Column("mean", "float64", "mean of the samples"),
            Column("median", "float64", "median of the samples"),
            Column("rms", "float64", "root mean square of the samples"),
            Column("p95", "float64", "95th percentile of the samples"),
            Column("max", "float64", "largest sample"),
        ],
    ),
    TableSchema(
        "align",
        "checks",
        "Consistency checks before ground truth was given out: one row a check of the scene, a model, a session or a "
        "window.",
        [
            Column("check", "string", "name of the check", choices=CheckName),
            Column("session_id", "string", "capture session; empty for the scene"),
            Column("component", "int64", "SfM model, as in ground_truth; null for the scene", nullable=True),
            Column("t_start_ns", "int64", "first frame of the window", "ns", "", True),
            Column("t_end_ns", "int64", "last frame of the window", "ns", "", True),
            Column("frames", "int64", "frames under this check"),
            Column("value", "float64", "the estimate", "", "", True),
            Column("sd", "float64", "its standard error; null for counts and known lengths", "", "", True),
            Column(
                "limit", "float64", "largest value that passes; smallest for fractions of frames or steps that agree"
            ),
            Column("unit", "string", "unit of value, sd and limit", choices=CheckUnit),
            Column("status", "string", "passed or failed by two sd or more, else undecided", choices=Status),
            Column(
                "cause",
                "string",
                "what is wrong with the input (docs/reference/checks.md); null where it passed",
                nullable=True,
                choices=FailureCause,
            ),
            Column(
                "reason",
                "string",
                "the cause in words, with figures; where it passed empty, or of a ruler that sets the scale what VIO "
                "can't tell of its size",
            ),
            Column("advice", "string", "what to do where it failed; what would decide it where it is undecided"),
        ],
        version="3.0",
    ),
    TableSchema(
        "align",
        "rulers",
        "Rulers that the scene's file names: one row a ruler, model, and part of its corners (docs/how-to/ruler.md).",
        [
            Column("ruler", "string", "name"),
            Column("kind", "string", "kind of ruler", choices=RulerKind),
            _COMPONENT,
            Column("part", "string", "which of its corners are measured", choices=RulerPart),
            Column("used_for_scale", "bool", "this ruler (its part for_scale) sets the map's scale"),
            Column("frames", "int64", "frames that took part; where nothing is measured, those that see it"),
            Column("corners", "int64", "corners seen from two frames or more"),
            Column("outliers", "int64", "observations left out: wrong detections or poses"),
            Column("view_angle_deg", "float64", "largest angle between two views of its middle", "deg", "", True),
            Column("stated_mm", "float64", "size of a square or tag, or the distance, as stated", "mm"),
            Column("measured_mm", "float64", "that size as measured in the map", "mm", "map", True),
            Column(
                "scale_error_percent", "float64", "map's scale against the ruler; positive: too large", "%", "", True
            ),
            Column(
                "scale_sd_percent", "float64", "standard error of the ruler: measurement and stated size", "%", "", True
            ),
            Column("map_scale_sd_percent", "float64", "standard error of the map's scale", "%", "", True),
            Column("vio_scale_error_percent", "float64", "scale by VIO alone against the ruler", "%", "", True),
            Column("vio_scale_sd_percent", "float64", "standard error of the scale by VIO alone", "%", "", True),
            Column("reprojection_px", "float64", "triangulated corners from observations, RMS", "px", "", True),
            Column("corner_rms_mm", "float64", "triangulated corners from nominal ones, RMS", "mm", "", True),
            Column("flatness_mm", "float64", "corners from their best plane, RMS", "mm", "", True),
            Column("status", "string", "as in checks", choices=Status),
            Column("reason", "string", "why it failed or is undecided; remarks"),
        ],
        version="3.0",
    ),
    TableSchema(
        "align",
        "control",
        "Surveys of control points that the scene's file names, one row each (docs/how-to/control-points.md). Points "
        "are held out half by half: each one's error is by the fit of the other half.",
        [
            Column("control", "string", "name"),
            Column("points", "int64", "surveyed points"),
            Column("used", "int64", "of these, seen well enough and in agreement with the others"),
            Column("held_out", "int64", "of these, compared by a fit of others"),
            Column(
                "fit",
                "string",
                "of the map to the survey: se3, sim3 where the map has no scale, none where there are too few points",
                choices=ReferenceAlignment,
            ),
            Column("rms_m", "float64", "how far held-out points are off, RMS", "m", "survey", True),
            Column("worst_m", "float64", "how far the worst held-out point is off", "m", "survey", True),
            Column(
                "expected_rms_m", "float64", "what rms_m is expected to be by all standard errors", "m", "survey", True
            ),
            Column("within_bounds", "float64", "share of held-out points within their 95 % bounds", "", "", True),
            Column(
                "scale",
                "float64",
                "how much longer the map is than the survey, as a fraction; where it has no scale, metres of its unit",
                "",
                "",
                True,
            ),
            Column(
                "scale_sd", "float64", "standard error of scale, as the images and the survey give it", "", "", True
            ),
            Column("tilt_deg", "float64", "angle between the survey's vertical and the map's", "deg", "", True),
            Column("tilt_sd_deg", "float64", "standard error of tilt_deg, an axis", "deg", "", True),
            *pose_columns("survey_map", "survey_T_map by all points that are used", nullable=True),
            Column("map_scale", "float64", "what a length of the map is multiplied by before: 1 for se3", "", "", True),
            Column("rotation_sd_deg", "float64", "standard error of that pose about its worst axis", "deg", "", True),
            Column("position_sd_m", "float64", "standard error at the points' middle, worst axis", "m", "survey", True),
            Column("status", "string", "as in checks", choices=Status),
            Column("reason", "string", "why it failed or is undecided"),
        ],
        version="1.0",
    ),
    TableSchema(
        "align",
        "control_points",
        "Control points, one row a survey and point.",
        [
            Column("control", "string", "name of the survey"),
            Column("point", "string", "name of the point"),
            Column("used", "bool", "seen well enough, and in agreement with the others"),
            Column("frames", "int64", "frames of the map that see it"),
            *(Column(f"survey_{axis}", "float64", "as surveyed", "m", "survey") for axis in "xyz"),
            Column("survey_sd_m", "float64", "standard error of a surveyed coordinate", "m", "survey"),
            *(
                Column(f"map_{axis}", "float64", "as triangulated by the map's poses", "m", "map", True)
                for axis in "xyz"
            ),
            Column("map_sd_m", "float64", "standard error of that, root of the sum over axes", "m", "map", True),
            Column("error_m", "float64", "how far it is off by the fit of the other half", "m", "survey", True),
            Column("expected_m", "float64", "what error_m is expected to be, RMS", "m", "survey", True),
            Column("reason", "string", "why it isn't used; empty where it is"),
        ],
        version="1.0",
    ),
    TableSchema(
        "align",
        "reference_agreement",
        "How the poses of SfM in the map agree with the poses that a data set states (import.reference), one row a "
        "session and SfM model; no rows for phone captures.",
        [
            _SESSION,
            _COMPONENT,
            Column("frames", "int64", "frames of the session"),
            Column("compared_frames", "int64", "of these, in this model and with a reference pose"),
            Column(
                "fit",
                "string",
                "alignment before: the model's to the reference that gives the map (model_sim3), or the session's "
                "reference's to the map: se3, sim3 where its unit or the map's scale is unknown, none where there are "
                "too few poses",
                choices=ReferenceAlignment,
            ),
            Column("unit", "string", "unit of the positions: m, or the reference's unknown one", choices=LengthUnit),
            Column("position_rms_m", "float64", "distance between the positions", "m", "map", True),
            Column("position_median_m", "float64", "distance between the positions", "m", "map", True),
            Column("position_max_m", "float64", "distance between the positions", "m", "map", True),
            Column("rotation_median_deg", "float64", "angle between the rotations", "deg", "map", True),
            Column("rotation_max_deg", "float64", "angle between the rotations", "deg", "map", True),
            Column("scale", "float64", "reference's unit per metre of the map, by a fit of these frames", "", "", True),
            Column("scale_sd", "float64", "standard error of scale, for independent frames", "", "", True),
        ],
        version="2.0",
    ),
    TableSchema(
        "align",
        "depth_agreement",
        "How a phone's depth sensor agrees with the map, at the SfM points that its frames with ground truth see: "
        "one row a session, SfM model, distance and confidence; no rows without depth. Depth gives nothing to the map.",
        [
            _SESSION,
            _COMPONENT,
            Column("near_m", "float64", "depth by the map, from", "m"),
            Column("far_m", "float64", "depth by the map, below; null: no limit", "m", "", True),
            Column("confidence", "int64", "the sensor's: 0 low, 1 medium, 2 high; null: all, or unknown", "", "", True),
            Column("frames", "int64", "frames that the samples are from"),
            Column("samples", "int64", "points of SfM, each as often as a frame sees it, away from edges of depth"),
            Column("median_ratio", "float64", "median of the sensor's depth over the map's"),
            Column("mad", "float64", "median absolute deviation of that ratio from its median"),
            Column(
                "median_ratio_se",
                "float64",
                "standard error of the median, drawing whole frames; null for one frame",
                "",
                "",
                True,
            ),
        ],
    ),
    TableSchema(
        "align",
        "residuals",
        "One row a frame with ground truth and VIO: how far VIO is from the ground truth there.",
        [
            Column("frame_id", "string", "<session>/<six digits>"),
            _SESSION,
            _SEGMENT,
            _COMPONENT,
            Column("t_ns", "int64", "capture time on the session's clock", "ns"),
            Column("travelled_m", "float64", "VIO path length since the segment's first frame", "m"),
            Column("position_m", "float64", "after the segment's rigid fit", "m", "map", True),
            Column("rotation_deg", "float64", "after the segment's rigid fit", "deg", "map", True),
            Column("window_position_m", "float64", "after a rigid fit of the window around", "m", "map", True),
            Column("window_rotation_deg", "float64", "after a rigid fit of the window around", "deg", "map", True),
        ],
        version="1.1",
    ),
]
