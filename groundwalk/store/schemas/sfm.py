"""The structure-from-motion models: their frames, points and pairs, and what was built and tried on the way to them."""

from groundwalk.store.schemas import tables

TABLES = tables(
    "sfm",
    """
images 5.0: One row a frame of import.frames: where its model has its camera (sfm: COLMAP's arbitrary gauge and scale,
        its own for each model_id).
    frame_id (string): <session>/<six digits>
    registered (bool): the frame is in one of the selected models
    not_registered (NotRegistered?): why it isn't
    model_id (string?): the model that the pose is from: models.model_id
    sfm_cam (pose?): adjusted sfm_T_cam
    f{xy} (float64, px): focal length, {}, adjusted with the pose
    c{xy} (float64, px): principal point, {}, adjusted with the pose
    distortion (list<float64>): OpenCV's k1, k2, p1, p2, k3, ... that go with the pose
    readout_s (float64, s): rolling shutter: time from the first to the last row
    angular_{xyz} (float64, rad/s in cam): angular velocity at the middle row, {}, adjusted
    velocity_{xyz} (float64, sfm units/s in cam): velocity by VIO, {}; 0: unknown
    camera_origin (CameraOrigin): where the lens is from; estimated: by the model's images; prior: phones' usual one
    keypoints (int64): features found in the image
    observations (int64): features that see a point of the model
    track_length (float64?): mean number of frames that see its points
    reprojection_px (float64?, px): mean distance of its features from their points
    held_out_matches (int64): verified matches that were left out of mapping and adjustment
    held_out_px (float64?, px): median Sampson distance of held-out matches from the final poses
    fitted_px (float64?, px): median Sampson distance of the matches that were adjusted to
    covariance (list<float64>?, rad, sfm units in sfm): 6x6, row-major, of (rotation, position) with true rotation =
        exp(rotation) @ sfm_R_cam and true position = sfm_t_cam + position; relative to the model as a whole; the
        rotation is that of the pixels' rays: a principal point that is off (lenses) turns cameras, but not these; null
        where it can't be had

lenses 6.0: The lenses and rolling shutters of each model, shared by the frames of a device, as adjusted with it.
    model_id (string): the model: models.model_id
    lens_id (string): device, image size and focal length in image widths
    frames (int64): registered frames with this lens
    k1 (float64): radial distortion, OpenCV's convention
    k1_sd (float64?): standard deviation of k1
    k2 (float64): radial distortion, OpenCV's convention
    k2_sd (float64?): standard deviation of k2
    k3 (float64): radial distortion, OpenCV's convention
    k3_sd (float64?): standard deviation of k3
    readout_s (float64, s): rolling shutter: time from the first to the last row
    readout_sd_s (float64?, s): standard deviation of the readout time
    centre_{xy} (float64, px): how far its principal point is from import's, {}, in images that aren't turned
    centre_{xy}_sd (float64?, px): standard deviation of that
    stated_k1 (float64): k1 that the capture states; 0: none
    stated_k2 (float64): k2 that the capture states; 0: none
    origin (CameraOrigin): stated: as stated; estimated: by the model's images; prior: phones' usual one
    stated_is_wrong (bool): the images contradict the stated distortion (docs/explanation/sfm.md)
    stated_is_undecided (bool): so they do, but not beyond chance: the stated one is held
    stated_readout_s (float64?, s): readout time that the capture states; null: none, or a setting holds one
    stated_readout_is_wrong (bool): the images contradict the stated readout time
    held_out_stated_px (float64?, px): median Sampson distance of matches that took no part in mapping, in the model
        adjusted with what is stated; null where nothing is stated
    held_out_free_px (float64?, px): the same with what the images say instead

intrinsics 3.0: Each session's focal lengths as adjusted with each model, against the logged ones.
    model_id (string): the model: models.model_id
    session_id (string): the session
    frames (int64): registered frames of the session in the model
    focal_scale (float64): factor from its logged focal lengths to the adjusted ones
    focal_scale_sd (float64?): standard deviation of focal_scale
    focus_sd (float64): standard deviation of a frame's focal length about it, as a fraction
    angular_sd (float64, rad/s): standard deviation of a frame's angular velocity by VIO

models 3.0: Every model of the selected attempt, in the order in which mapping built it.
    model_id (string): <mapping>/<number>
    mapping (string): the mapper, or continued: from the largest model, with fewer inliers an image
    selected (bool): some frames' poses are from this model
    folder (string?): folder of COLMAP's model: model (the largest), model_2, ...
    images (int64): registered frames
    points (int64): points
    observations (int64): features that see a point
    mean_track_length (float64): observations a point
    mean_reprojection_px (float64, px): mean distance of features from their points
    = held_out_matches held_out_px fitted_px

attempts 2.1: The attempts at models of enough frames whose motion is consistent with VIO, in order.
    attempt (AttemptName): what it changes
    mapper (string): the mapper's id
    max_features (int64): features per image
    max_image_size (int64, px): longest side of images for features
    pairs (int64): pairs that were matched
    verified (int64): pairs with enough inliers and a relative pose consistent with VIO
    models (int64): selected models
    largest (int64): frames of the largest model
    registered (int64): frames in any of the models
    consistent_fraction (float64?): fraction of registered frames whose motion is consistent with VIO, within its drift
    outcome (AttemptOutcome): accepted, or what is wrong
    selected (bool): the stage's models are those of this attempt

pairs 2.1: Every pair of frames that was matched in the selected attempt.
    frame_id_a (string): earlier row of import.frames
    frame_id_b (string): later row of import.frames
    origin (PairOrigin): what proposed it first
    matches (int64): matched features
    inliers (int64): matches that fit one relative pose; of weak pairs those of guided matching
    status (PairStatus): whether it goes into mapping
    reason (PairInconsistency): what is inconsistent with VIO or neighbours; empty: nothing
    rotation_deg (float64?, deg): angle between the rotations by images and by VIO
    rotation_limit_deg (float64?, deg): limit of rotation_deg: VIO's drift over the path
    direction_deg (float64?, deg): angle between the translations by images and by VIO
    direction_limit_deg (float64?, deg): limit of direction_deg, by VIO's drift
    gravity_deg (float64?, deg): angle between gravity in a and in b, turned by the images

points 1.1: The points of the selected models.
    model_id (string): the model that it belongs to
    point_id (int64): COLMAP's id of the point
    {xyz} (float64, sfm units in sfm): position, {}
    r (int64): colour, red, 0 to 255
    g (int64): colour, green, 0 to 255
    b (int64): colour, blue, 0 to 255
    track_length (int64): frames that see it
    reprojection_px (float64, px): mean distance of its features from it
""",
)
