"""What the align stage writes: the ground truth, how VIO compares with it, and what was checked."""

from groundwalk.store.schemas import tables

TABLES = tables(
    "align",
    """
versions 1.0: What changed with each version of the ground truth, one row a session: version 1 was built as a whole,
        each further one adds recordings or takes some out. Frames of a session have the same rows in all versions that
        have it.
    version (int64): from 1; a ground truth that is built anew begins with 1
    change (GroundTruthChange): what became of the session
    session_id (string): capture session
    frames (int64): its frames
    with_ground_truth (int64): those with ground truth
    quality_{ABC} (int64): those of class {}
    position_sd_m (float64?, m in map): median of ground_truth.position_sd_m

ground_truth 2.0: One row a frame: where its camera was in the map (metric, +y up). Frames without ground truth have
        quality 'none' and a null pose.
    frame_id (string): <session>/<six digits>
    session_id (string): capture session
    split (Split): what the frame is for
    t_ns (int64, ns): capture time on the session's clock
    map_cam (pose?): ground truth map_T_cam
    component (int64?): SfM model that the pose is from; all but 0 lie in the map by VIO; null without ground truth
    covariance (list<float64>?, rad, m in map): 6x6, row-major, of (rotation, position) with true rotation =
        exp(rotation) @ map_R_cam and true position = map_t_cam + position: SfM's part, the map's scale and vertical,
        and VIO's where it links models; null where SfM has none
    position_sd_m (float64?, m in map): standard error in the least certain axis, without scale and vertical
    rotation_sd_deg (float64?, deg in map): standard error about the least certain axis, without scale and vertical
    quality (QualityClass): quality class (docs/explanation/ground-truth.md)
    reason (string): why quality is B, C or none, with the figure and its limit; empty for A
    gt_uses_vio (bool): VIO positions took part: in the bundle adjustment, or in placing its model
    scale_source (string?): what gives it its metric scale: vio, ruler: names, control: a survey's name, gps, or
        reference (import.reference, in metres); with ', uncertain' where its standard error is above 2 %; none: all
        lengths are in SfM's unit; reference, unit unknown: all lengths are in the reference's unit; null without ground
        truth
    vertical_source (VerticalSource?): what gave the map its +y: gravity; reference (whose +y is up); control points;
        lines in the images; gps; reference, up unknown: the map has the reference's axes; none: +y may point anywhere;
        null without ground truth
    f{xy} (float64, px): focal length, {}, that goes with the pose; as calibrated where SfM has none
    c{xy} (float64, px): principal point, {}; the first pixel's outer corner is 0
    distortion (list<float64>): OpenCV's k1, k2, p1, p2, k3, ... that go with the pose
    camera_origin (CameraOrigin): where the lens is from; estimated: by the model's images; prior: phones' usual one

sessions 4.0: One row a session, or a part of one between VIO jumps or in another SfM model: where its VIO frame lies in
        the map, and how well it fits. Null where the part has too few frames.
    session_id (string): capture session
    segment (int64): part of the session between two VIO jumps, from 0
    component (int64?): SfM model that the poses are from, largest first, from 0
    vio_link_m (float64?, m in vio): VIO path without a registered frame over which this model is linked to the map;
        null for the first
    t_start_ns (int64, ns): first frame
    t_end_ns (int64, ns): last frame
    frames (int64): frames of this part
    registered (int64): frames that SfM registered
    with_ground_truth (int64): frames with ground truth
    path_m (float64, m in vio): length of the VIO path through the frames
    map_vio (pose?): map_T_vio, rigid fit
    scale_source (string): what gives the map its metric scale, as in ground_truth
    scale (float64?): metres of this session's VIO per metre of the map
    scale_sd (float64?): standard error of scale, by the scatter of its steps
    up_error_deg (float64?, deg in map): angle between this session's vertical and the map's
    position_rms_m (float64?, m in map): residual of the rigid fit
    position_median_m (float64?, m in map): residual of the rigid fit
    position_max_m (float64?, m in map): residual of the rigid fit
    rotation_rms_deg (float64?, deg in map): residual of the rigid fit
    rotation_median_deg (float64?, deg in map): residual of the rigid fit
    rotation_max_deg (float64?, deg in map): residual of the rigid fit
    sim3_position_rms_m (float64?, m in map): residual of a fit with scale, all frames
    sim3_rotation_median_deg (float64?, deg in map): residual of a fit of rotations alone, all frames

drift 1.0: How far VIO moves away from the ground truth, one row a session, definition and interval; session 'all' pools
        the samples of all sessions.
    session_id (string): capture session, or 'all'
    definition (DriftDefinition): measure (docs/explanation/ground-truth.md)
    interval (float64?): length of the compared pieces; null for a whole path
    interval_unit (DriftInterval): what the interval counts
    unit (string): unit of the samples: m, deg, %, deg/m, deg/min, deg/100m
    samples (int64): number of compared pieces
    mean (float64): mean of the samples
    median (float64): median of the samples
    rms (float64): root mean square of the samples
    p95 (float64): 95th percentile of the samples
    max (float64): largest sample

checks 3.0: Consistency checks before ground truth was given out: one row a check of the scene, a model, a session or a
        window.
    check (CheckName): name of the check
    session_id (string): capture session; empty for the scene
    component (int64?): SfM model, as in ground_truth; null for the scene
    t_start_ns (int64?, ns): first frame of the window
    t_end_ns (int64?, ns): last frame of the window
    frames (int64): frames under this check
    value (float64?): the estimate
    sd (float64?): its standard error; null for counts and known lengths
    limit (float64): largest value that passes; smallest for fractions of frames or steps that agree
    unit (CheckUnit): unit of value, sd and limit
    status (Status): passed or failed by two sd or more, else undecided
    cause (FailureCause?): what is wrong with the input (docs/reference/checks.md); null where it passed
    reason (string): the cause in words, with figures; where it passed empty, or of a ruler that sets the scale what VIO
        can't tell of its size
    advice (string): what to do where it failed; what would decide it where it is undecided

rulers 3.0: Rulers that the scene's file names: one row a ruler, model, and part of its corners (docs/how-to/ruler.md).
    ruler (string): name
    kind (RulerKind): kind of ruler
    component (int64?): SfM model that the poses are from, largest first, from 0
    part (RulerPart): which of its corners are measured
    used_for_scale (bool): this ruler (its part for_scale) sets the map's scale
    frames (int64): frames that took part; where nothing is measured, those that see it
    corners (int64): corners seen from two frames or more
    outliers (int64): observations left out: wrong detections or poses
    view_angle_deg (float64?, deg): largest angle between two views of its middle
    stated_mm (float64, mm): size of a square or tag, or the distance, as stated
    measured_mm (float64?, mm in map): that size as measured in the map
    scale_error_percent (float64?, %): map's scale against the ruler; positive: too large
    scale_sd_percent (float64?, %): standard error of the ruler: measurement and stated size
    map_scale_sd_percent (float64?, %): standard error of the map's scale
    vio_scale_error_percent (float64?, %): scale by VIO alone against the ruler
    vio_scale_sd_percent (float64?, %): standard error of the scale by VIO alone
    reprojection_px (float64?, px): triangulated corners from observations, RMS
    corner_rms_mm (float64?, mm): triangulated corners from nominal ones, RMS
    flatness_mm (float64?, mm): corners from their best plane, RMS
    status (Status): as in checks
    reason (string): why it failed or is undecided; remarks

control 1.0: Surveys of control points that the scene's file names, one row each (docs/how-to/control-points.md). Points
        are held out half by half: each one's error is by the fit of the other half.
    control (string): name
    points (int64): surveyed points
    used (int64): of these, seen well enough and in agreement with the others
    held_out (int64): of these, compared by a fit of others
    fit (ReferenceAlignment): of the map to the survey: se3, sim3 where the map has no scale, none where there are too
        few points
    rms_m (float64?, m in survey): how far held-out points are off, RMS
    worst_m (float64?, m in survey): how far the worst held-out point is off
    expected_rms_m (float64?, m in survey): what rms_m is expected to be by all standard errors
    within_bounds (float64?): share of held-out points within their 95 % bounds
    scale (float64?): how much longer the map is than the survey, as a fraction; where it has no scale, metres of its
        unit
    scale_sd (float64?): standard error of scale, as the images and the survey give it
    tilt_deg (float64?, deg): angle between the survey's vertical and the map's
    tilt_sd_deg (float64?, deg): standard error of tilt_deg, an axis
    survey_map (pose?): survey_T_map by all points that are used
    map_scale (float64?): what a length of the map is multiplied by before: 1 for se3
    rotation_sd_deg (float64?, deg): standard error of that pose about its worst axis
    position_sd_m (float64?, m in survey): standard error at the points' middle, worst axis
    status (Status): as in checks
    reason (string): why it failed or is undecided

control_points 1.0: Control points, one row a survey and point.
    control (string): name of the survey
    point (string): name of the point
    used (bool): seen well enough, and in agreement with the others
    frames (int64): frames of the map that see it
    survey_{xyz} (float64, m in survey): as surveyed
    survey_sd_m (float64, m in survey): standard error of a surveyed coordinate
    map_{xyz} (float64?, m in map): as triangulated by the map's poses
    map_sd_m (float64?, m in map): standard error of that, root of the sum over axes
    error_m (float64?, m in survey): how far it is off by the fit of the other half
    expected_m (float64?, m in survey): what error_m is expected to be, RMS
    reason (string): why it isn't used; empty where it is

reference_agreement 2.0: How the poses of SfM in the map agree with the poses that a data set states (import.reference),
        one row a session and SfM model; no rows for phone captures.
    session_id (string): capture session
    component (int64?): SfM model that the poses are from, largest first, from 0
    frames (int64): frames of the session
    compared_frames (int64): of these, in this model and with a reference pose
    fit (ReferenceAlignment): alignment before: the model's to the reference that gives the map (model_sim3), or the
        session's reference's to the map: se3, sim3 where its unit or the map's scale is unknown, none where there are
        too few poses
    unit (LengthUnit): unit of the positions: m, or the reference's unknown one
    position_rms_m (float64?, m in map): distance between the positions
    position_median_m (float64?, m in map): distance between the positions
    position_max_m (float64?, m in map): distance between the positions
    rotation_median_deg (float64?, deg in map): angle between the rotations
    rotation_max_deg (float64?, deg in map): angle between the rotations
    scale (float64?): reference's unit per metre of the map, by a fit of these frames
    scale_sd (float64?): standard error of scale, for independent frames

depth_agreement 1.0: How a phone's depth sensor agrees with the map, at the SfM points that its frames with ground truth
        see: one row a session, SfM model, distance and confidence; no rows without depth. Depth gives nothing to the
        map.
    session_id (string): capture session
    component (int64?): SfM model that the poses are from, largest first, from 0
    near_m (float64, m): depth by the map, from
    far_m (float64?, m): depth by the map, below; null: no limit
    confidence (int64?): the sensor's: 0 low, 1 medium, 2 high; null: all, or unknown
    frames (int64): frames that the samples are from
    samples (int64): points of SfM, each as often as a frame sees it, away from edges of depth
    median_ratio (float64): median of the sensor's depth over the map's
    mad (float64): median absolute deviation of that ratio from its median
    median_ratio_se (float64?): standard error of the median, drawing whole frames; null for one frame

residuals 1.1: One row a frame with ground truth and VIO: how far VIO is from the ground truth there.
    frame_id (string): <session>/<six digits>
    session_id (string): capture session
    segment (int64): part of the session between two VIO jumps, from 0
    component (int64?): SfM model that the poses are from, largest first, from 0
    t_ns (int64, ns): capture time on the session's clock
    travelled_m (float64, m): VIO path length since the segment's first frame
    position_m (float64?, m in map): after the segment's rigid fit
    rotation_deg (float64?, deg in map): after the segment's rigid fit
    window_position_m (float64?, m in map): after a rigid fit of the window around
    window_rotation_deg (float64?, deg in map): after a rigid fit of the window around
""",
)
