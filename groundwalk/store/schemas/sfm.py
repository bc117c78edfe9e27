"""The structure-from-motion models: their frames, points and pairs, and what was built and tried on the way to them."""

from groundwalk.store.choices import (
    AttemptName,
    AttemptOutcome,
    CameraOrigin,
    NotRegistered,
    PairInconsistency,
    PairOrigin,
    PairStatus,
)
from groundwalk.store.schemas import Column, TableSchema, pose_columns

_HELD_OUT = [
    Column("held_out_matches", "int64", "verified matches that were left out of mapping and adjustment"),
    Column(
        "held_out_px", "float64", "median Sampson distance of held-out matches from the final poses", "px", "", True
    ),
    Column("fitted_px", "float64", "median Sampson distance of the matches that were adjusted to", "px", "", True),
]

TABLES = [
    TableSchema(
        "sfm",
        "images",
        "One row a frame of import.frames: where its model has its camera (sfm: COLMAP's arbitrary gauge and "
        "scale, its own for each model_id).",
        [
            Column("frame_id", "string", "<session>/<six digits>"),
            Column("registered", "bool", "the frame is in one of the selected models"),
            Column("not_registered", "string", "why it isn't", nullable=True, choices=NotRegistered),
            Column("model_id", "string", "the model that the pose is from: models.model_id", nullable=True),
            *pose_columns("sfm_cam", "adjusted sfm_T_cam", nullable=True),
            Column("fx", "float64", "focal length, x, adjusted with the pose", "px"),
            Column("fy", "float64", "focal length, y, adjusted with the pose", "px"),
            Column("cx", "float64", "principal point, x, as import has it", "px"),
            Column("cy", "float64", "principal point, y, as import has it", "px"),
            Column("distortion", "list<float64>", "OpenCV's k1, k2, p1, p2, k3, ... that go with the pose"),
            Column("readout_s", "float64", "rolling shutter: time from the first to the last row", "s"),
            *(
                Column(f"angular_{a}", "float64", f"angular velocity at the middle row, {a}, adjusted", "rad/s", "cam")
                for a in "xyz"
            ),
            *(
                Column(f"velocity_{a}", "float64", f"velocity by VIO, {a}; 0: unknown", "sfm units/s", "cam")
                for a in "xyz"
            ),
            Column(
                "camera_origin", "string", "where the lens is from, before the model adjusts it", choices=CameraOrigin
            ),
            Column("keypoints", "int64", "features found in the image"),
            Column("observations", "int64", "features that see a point of the model"),
            Column("track_length", "float64", "mean number of frames that see its points", "", "", True),
            Column("triangulation_deg", "float64", "median over its points of their widest angle", "deg", "", True),
            Column("reprojection_px", "float64", "mean distance of its features from their points", "px", "", True),
            *_HELD_OUT,
            Column(
                "covariance",
                "list<float64>",
                "6x6, row-major, of (rotation, position) with true rotation = exp(rotation) @ sfm_R_cam and true "
                "position = sfm_t_cam + position; relative to the model as a whole; null where it can't be had",
                "rad, sfm units",
                "sfm",
                True,
            ),
            Column(
                "motion_sd",
                "float64",
                "standard deviation of the motion to the frame 5 m on, or from that 5 m back, by VIO's path, as a "
                "fraction of its length: the larger",
                "",
                "",
                True,
            ),
        ],
        version="4.0",
    ),
    TableSchema(
        "sfm",
        "lenses",
        "The lenses and rolling shutters of each model, shared by the frames of a device, as adjusted with it.",
        [
            Column("model_id", "string", "the model: models.model_id"),
            Column("lens_id", "string", "device, image size and focal length in image widths"),
            Column("frames", "int64", "registered frames with this lens"),
            Column("k1", "float64", "radial distortion, OpenCV's convention"),
            Column("k1_sd", "float64", "standard deviation of k1", "", "", True),
            Column("k2", "float64", "radial distortion, OpenCV's convention"),
            Column("k2_sd", "float64", "standard deviation of k2", "", "", True),
            Column("k3", "float64", "radial distortion, OpenCV's convention"),
            Column("k3_sd", "float64", "standard deviation of k3", "", "", True),
            Column("readout_s", "float64", "rolling shutter: time from the first to the last row", "s"),
            Column("readout_sd_s", "float64", "standard deviation of the readout time", "s", "", True),
            Column("time_offset_s", "float64", "time stamps minus times of middle rows", "s", "", True),
            Column("time_offset_sd_s", "float64", "standard error of the time offset", "s", "", True),
            Column("time_offset_used", "bool", "held-out pairs accept the time offset: motion is taken there"),
            Column("stated_k1", "float64", "k1 that the capture states; 0: none"),
            Column("stated_k2", "float64", "k2 that the capture states; 0: none"),
            Column("origin", "string", "where k1 and k2 are from, before the model adjusts them", choices=CameraOrigin),
            Column("stated_is_wrong", "bool", "the images contradict the stated distortion (docs/explanation/sfm.md)"),
            Column("stated_is_undecided", "bool", "so they do, but not beyond chance: the stated one is held"),
            Column(
                "stated_readout_s",
                "float64",
                "readout time that the capture states; null: none, or a setting holds one",
                "s",
                "",
                True,
            ),
            Column("stated_readout_is_wrong", "bool", "the images contradict the stated readout time"),
            Column(
                "held_out_prior_px",
                "float64",
                "median Sampson distance in held-out pairs with the stated lens, where none is stated with "
                "phones' usual one, and with no rolling shutter but a stated one",
                "px",
                "",
                True,
            ),
            Column(
                "held_out_px",
                "float64",
                "median Sampson distance of the same matches with the lens estimated from pairs",
                "px",
                "",
                True,
            ),
        ],
        version="4.0",
    ),
    TableSchema(
        "sfm",
        "intrinsics",
        "Each session's focal lengths as adjusted with each model, against the logged ones.",
        [
            Column("model_id", "string", "the model: models.model_id"),
            Column("session_id", "string", "the session"),
            Column("frames", "int64", "registered frames of the session in the model"),
            Column("focal_scale", "float64", "factor from its logged focal lengths to the adjusted ones"),
            Column("focal_scale_sd", "float64", "standard deviation of focal_scale", "", "", True),
            Column("focus_sd", "float64", "standard deviation of a frame's focal length about it, as a fraction"),
            Column("angular_sd", "float64", "standard deviation of a frame's angular velocity by VIO", "rad/s"),
            Column(
                "focal_step",
                "float64",
                "factor by which the images' focal lengths step within the session where the logged ones don't "
                "(digital zoom, another lens); null: no such step",
                nullable=True,
            ),
            Column("focal_step_frame_id", "string", "first frame after the step", nullable=True),
        ],
        version="2.1",
    ),
    TableSchema(
        "sfm",
        "models",
        "Every model of the selected attempt, in the order in which mapping built it.",
        [
            Column("model_id", "string", "<mapping>/<number>"),
            Column(
                "mapping", "string", "the mapper, or continued: from the largest model, with fewer inliers an image"
            ),
            Column("selected", "bool", "some frames' poses are from this model"),
            Column("folder", "string", "folder of COLMAP's model: model (the largest), model_2, ...", nullable=True),
            Column("images", "int64", "registered frames"),
            Column("points", "int64", "points"),
            Column("observations", "int64", "features that see a point"),
            Column("mean_track_length", "float64", "observations a point"),
            Column("mean_reprojection_px", "float64", "mean distance of features from their points", "px"),
            *_HELD_OUT,
        ],
        version="3.0",
    ),
    TableSchema(
        "sfm",
        "attempts",
        "The attempts at models of enough frames whose motion is consistent with VIO, in order.",
        [
            Column("attempt", "string", "what it changes", choices=AttemptName),
            Column("mapper", "string", "the mapper's id"),
            Column("pairs", "int64", "pairs that were matched"),
            Column("verified", "int64", "pairs with enough inliers and a relative pose consistent with VIO"),
            Column("models", "int64", "selected models"),
            Column("largest", "int64", "frames of the largest model"),
            Column("registered", "int64", "frames in any of the models"),
            Column(
                "consistent_fraction",
                "float64",
                "fraction of registered frames whose motion is consistent with VIO, within its drift",
                "",
                "",
                True,
            ),
            Column("outcome", "string", "accepted, or what is wrong", choices=AttemptOutcome),
            Column("selected", "bool", "the stage's models are those of this attempt"),
        ],
        version="2.0",
    ),
    TableSchema(
        "sfm",
        "pairs",
        "Every pair of frames that was matched in the selected attempt.",
        [
            Column("frame_id_a", "string", "earlier row of import.frames"),
            Column("frame_id_b", "string", "later row of import.frames"),
            Column("origin", "string", "what proposed it first", choices=PairOrigin),
            Column("matches", "int64", "matched features"),
            Column("inliers", "int64", "matches that fit one relative pose; of weak pairs those of guided matching"),
            Column("status", "string", "whether it goes into mapping", choices=PairStatus),
            Column(
                "reason",
                "string",
                "what is inconsistent with VIO or neighbours; empty: nothing",
                choices=PairInconsistency,
            ),
            Column("rotation_deg", "float64", "angle between the rotations by images and by VIO", "deg", "", True),
            Column(
                "rotation_limit_deg", "float64", "limit of rotation_deg: VIO's drift over the path", "deg", "", True
            ),
            Column("direction_deg", "float64", "angle between the translations by images and by VIO", "deg", "", True),
            Column("direction_limit_deg", "float64", "limit of direction_deg, by VIO's drift", "deg", "", True),
            Column(
                "gravity_deg", "float64", "angle between gravity in a and in b, turned by the images", "deg", "", True
            ),
        ],
        version="2.1",
    ),
    TableSchema(
        "sfm",
        "points",
        "The points of the selected models.",
        [
            Column("model_id", "string", "the model that it belongs to"),
            Column("point_id", "int64", "COLMAP's id of the point"),
            Column("x", "float64", "position, x", "sfm units", "sfm"),
            Column("y", "float64", "position, y", "sfm units", "sfm"),
            Column("z", "float64", "position, z", "sfm units", "sfm"),
            Column("r", "int64", "colour, red, 0 to 255"),
            Column("g", "int64", "colour, green, 0 to 255"),
            Column("b", "int64", "colour, blue, 0 to 255"),
            Column("track_length", "int64", "frames that see it"),
            Column("reprojection_px", "float64", "mean distance of its features from it", "px"),
        ],
        version="1.1",
    ),
]
