"""The structure-from-motion model: its frames, points and pairs, and what was built on the way to it."""

from artefacts.schemas import Column, TableSchema, pose_columns

TABLES = [
    TableSchema(
        "sfm",
        "images",
        "One row a frame of import.frames: where the model has its camera (sfm: COLMAP's arbitrary gauge and scale).",
        [
            Column("frame_id", "string", "<session>/<six digits>"),
            Column("registered", "bool", "the frame is in the final model"),
            Column("model_id", "string", "the model that the pose is from: models.model_id", nullable=True),
            *pose_columns("sfm_cam", "adjusted sfm_T_cam", nullable=True),
            Column("keypoints", "int64", "features found in the image"),
            Column("observations", "int64", "features that see a point of the model"),
            Column("reprojection_px", "float64", "mean distance of its features from their points", "px", "", True),
            Column(
                "covariance",
                "list<float64>",
                "6x6, row-major, of (rotation, position) with true rotation = exp(rotation) @ sfm_R_cam and true "
                "position = sfm_t_cam + position; relative to the model as a whole; null where it can't be had",
                "rad, sfm units",
                "sfm",
                True,
            ),
        ],
    ),
    TableSchema(
        "sfm",
        "models",
        "Every model that mapping built, in the order in which it tried.",
        [
            Column("model_id", "string", "<attempt>/<number>"),
            Column("attempt", "string", "incremental, or continued: from the largest, with a lower bar for an image"),
            Column("chosen", "bool", "the final model, in the folder model/"),
            Column("images", "int64", "registered frames"),
            Column("points", "int64", "points"),
            Column("observations", "int64", "features that see a point"),
            Column("mean_track_length", "float64", "observations a point"),
            Column("mean_reprojection_px", "float64", "mean distance of features from their points", "px"),
        ],
    ),
    TableSchema(
        "sfm",
        "pairs",
        "Every pair of frames that was proposed and matched.",
        [
            Column("frame_id_a", "string", "earlier row of import.frames"),
            Column("frame_id_b", "string", "later row of import.frames"),
            Column("origin", "string", "who proposed it first: sequence, vio, retrieval or transitive"),
            Column("matches", "int64", "matched features"),
            Column("inliers", "int64", "of these, in agreement with one relative pose"),
            Column("verdict", "string", "verified, or rejected: too few inliers"),
        ],
    ),
    TableSchema(
        "sfm",
        "points",
        "The points of the final model.",
        [
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
    ),
]
