"""What the fuse stage writes: what each method said about each frame, how wrong it was, and the figures."""

from groundwalk.store.schemas import tables

TABLES = tables(
    "fuse",
    """
poses 1.0: One row a frame, method and model. `status` and map_cam count a frame as reliable that a later frame
        confirmed (the paper's way); `live_status` and live_map_cam are what an app had in time.
    method (string): fusion method's id, as in fuse.methods
    options (string): the method's options, JSON
    model (string): the regressor whose predictions went in, as in train.predictions
    scene (string): scene of the frame; in a group of scenes its member
    frame_id (string): <session>/<six digits>
    session_id (string): capture session
    split (Split): what the frame is for
    t_ns (int64, ns): capture time on the session's clock
    status (string): reliable, optimised, aligning, predicted, fused, lost or none
    map_cam (pose?): map_T_cam, null where status is none
    live_status (string): the status in time: reliable, optimised, aligning, predicted, fused, lost or none
    live_map_cam (pose?): map_T_cam in time, null where live_status is none
    covariance (list<float64>?, rad, m in map): 6x6, row-major, of live_map_cam's error: rotation then translation; null
        where the method has none
    map_vio (pose?): alignment in force after the frame, null before there is one
    reasons (string): what led to the live status, codes joined by commas

errors 2.0: One row a frame with ground truth, method and model: how wrong the pose was. Null where there was none.
    = method options model scene frame_id session_id split t_ns
    quality (string?): class of the frame's ground truth: A, B or C; null where it states none
    status (string): reliable, optimised, aligning, predicted, fused, lost or none
    position_m (float64?, m in map): APE of map_cam
    rotation_deg (float64?, deg): AOE of map_cam
    live_status (string): the status in time: reliable, optimised, aligning, predicted, fused, lost or none
    live_position_m (float64?, m in map): APE of live_map_cam
    live_rotation_deg (float64?, deg): AOE of live_map_cam
    raw_position_m (float64?, m in map): APE of the frame's prediction
    raw_rotation_deg (float64?, deg): AOE of the frame's prediction

signals 1.0: The numbers behind the decisions: one row a frame, method, model and number.
    = method options model scene frame_id session_id split t_ns
    signal (string): rpe_m, roe_deg, similarity, ... (docs/explanation/fusion.md)
    value (float64): its value

summary 3.0: Errors by method, model, scene and subset of frames, for the method and for the raw regressor.
    = method options model scene
    subset (string): rp, opt, rp+opt (by `status`, the paper's); all (poses in time, no pose is a failure); common
        (frames that every causal method answered in time with this model)
    scored (string): whose poses: method, or raw: the predictions, of the same frames
    frames (int64): frames of the subset
    answered (int64): frames of the subset with a pose
    total (int64): all evaluated frames with ground truth; for a method that fuses, of walks with odometry
    frames_pct (float64, %): frames / total
    coverage_pct (float64?, %): answered / frames; null for an empty subset
    too_uncertain (int64): frames of the subset whose ground truth can't tell whether a pose is within a level (class
        C): counted in means and medians, left out of the levels
    position_mean_m (float64?, m): mean APE over the answered frames
    position_median_m (float64?, m): median APE over the subset, a frame without a pose counting as infinitely wrong;
        null where that is infinite
    rotation_mean_deg (float64?, deg): mean AOE over the answered frames
    rotation_median_deg (float64?, deg): median AOE over the subset, as position_median_m
    high_pct (float64?, %): frames of the subset within 0.25 m and 2 deg, of those not too uncertain
    medium_pct (float64?, %): the same within 0.5 m and 5 deg
    low_pct (float64?, %): the same within 5 m and 10 deg
    map_unit (MapUnit): what position errors are in

intervals 1.0: How far figures of fuse.summary would move with other walks: bootstrap over sessions, for the method's
        rows.
    = method options model scene
    subset (string): as in fuse.summary
    figure (string): a column of fuse.summary
    value (float64?): its value; null where that is infinite or there is none
    low (float64?): 2.5 % bound; null as value, and with a single session
    high (float64?): 97.5 % bound; null as low
    sessions (int64): sessions that were drawn from
    draws (int64): different draws that there are: 3 for two sessions, which says little

validation 1.0: Each causal method on the frames held out of training: which is ahead is told without the test walks.
        Missing where no frames were held out.
    = method model scene
    frames (int64): held-out frames with ground truth
    coverage_pct (float64, %): share of them that it answered
    = position_mean_m rotation_mean_deg
    ahead (bool): its geometric mean of both, over the coverage, is the least

sweep 2.0: The paper's rule with other thresholds, for each scene and model.
    = scene model
    varied (string): the threshold that isn't as in the settings
    n (int64): N
    d_th_m (float64, m): d_th
    o_th_deg (float64, deg): o_th
    gamma (float64): gamma
    subset (string): rp+opt (the paper's) or all (in time), as in fuse.summary
    = frames answered total frames_pct coverage_pct too_uncertain position_mean_m position_median_m rotation_mean_deg
        rotation_median_deg high_pct medium_pct low_pct

sessions 1.1: What a user of the method sees in one session, from the poses in time; a row each, in order of time,
        where the session's frames of a split are several stretches, with others between them.
    = method options model scene session_id split
    frames (int64): frames of the session
    answered (int64): frames with a pose
    first_fix_s (float64?, s): time to the first pose; null where there is none
    longest_outage_s (float64?, s): longest time without a pose after the first
    jitter_m (float64?, m): mean motion a frame beyond VIO's own
    jitter_deg (float64?, deg): mean rotation a frame beyond VIO's own
    recovery_s (float64?, s): after the longest time without a frame, of 10 s or more: until ten answers in a row are on
        average no worse than the raw regressor's over the walk; infinite where never, null without such a time

methods 2.0: What was run: one row a method.
    = method options
    label (string): the method as tables print it, behind the model's and a +
    fuses (bool): uses odometry; false: the raw regressor
    causal (bool): answers each frame from it and earlier ones; false: offline, sees whole walks
    meaning (string): the method in a few words
""",
)
