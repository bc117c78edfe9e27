"""The structure-from-motion models: their frames, points and pairs, and what was built and tried on the way to them."""

from artefacts.schemas import Column, TableSchema, pose_columns

_HELD_OUT = [
    Column("heldout_matches", "int64", "verified matches that were left out of mapping and adjustment"),
    Column("heldout_px", "float64", "median Sampson distance of these from the final poses", "px", "", True),
    Column("fitted_px", "float64", "the same of the matches that took part", "px", "", True),
]

TABLES = [
    TableSchema(
        "sfm",
        "images",
        "One row a frame of import.frames: where its model has its camera (sfm: COLMAP's arbitrary gauge and "
        "scale, its own for each model_id).",
        [
            Column("frame_id", "string", "<session>/<six digits>"),
            Column("registered", "bool", "the frame is in one of the models that were kept"),
            Column("model_id", "string", "the model that the pose is from: models.model_id", nullable=True),
            *pose_columns("sfm_cam", "adjusted sfm_T_cam", nullable=True),
            Column(
                "focal_scale",
                "float64",
                "the pose goes with import's focal lengths times this; 1, or null: as they were captured",
                nullable=True,
            ),
            Column("uses_vio", "bool", "VIO positions were the start of this pose (mapper vio)"),
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
        ],
        version="1.2",
    ),
    TableSchema(
        "sfm",
        "intrinsics",
        "What each model says of its sessions' focal lengths, and whether they were refined (sfm.refine_intrinsics).",
        [
            Column("model_id", "string", "the model: models.model_id"),
            Column("session_id", "string", "the session"),
            Column("frames", "int64", "registered frames of the session in the model"),
            Column("focal_scale", "float64", "what the images multiply its focal lengths by", "", "", True),
            Column("focal_scale_sd", "float64", "one sigma of that", "", "", True),
            Column(
                "heldout_px",
                "float64",
                "median Sampson distance of held-out matches of the sessions in question, focal lengths as captured",
                "px",
                "",
                True,
            ),
            Column("heldout_refined_px", "float64", "the same, with the factors applied", "px", "", True),
            Column("decision", "string", "refined, or captured and why"),
        ],
    ),
    TableSchema(
        "sfm",
        "models",
        "Every model that mapping built in the attempt that was taken, in the order in which it did.",
        [
            Column("model_id", "string", "<mapping>/<number>"),
            Column("mapping", "string", "the mapper, or continued: from the largest, with a lower bar for an image"),
            Column("chosen", "bool", "it was kept: some frames' poses are from it"),
            Column(
                "folder", "string", "the folder with COLMAP's model: model (the largest), model_2, ...", nullable=True
            ),
            Column("images", "int64", "registered frames"),
            Column("points", "int64", "points"),
            Column("observations", "int64", "features that see a point"),
            Column("mean_track_length", "float64", "observations a point"),
            Column("mean_reprojection_px", "float64", "mean distance of features from their points", "px"),
            *_HELD_OUT,
        ],
        version="2.0",
    ),
    TableSchema(
        "sfm",
        "attempts",
        "The ladder: each attempt at models of enough frames that move as VIO does, in order.",
        [
            Column("attempt", "string", "as set, more pairs, surer pairs, more features, other mapper or from VIO"),
            Column("mapper", "string", "incremental, global, hierarchical or vio"),
            Column("pairs", "int64", "pairs that were matched"),
            Column("verified", "int64", "of these, with inliers enough and in agreement with VIO"),
            Column("models", "int64", "models that were kept"),
            Column("largest", "int64", "frames of the largest"),
            Column("registered", "int64", "frames in any of them"),
            Column("moving_as_vio", "float64", "share of these that move as VIO does, within its drift", "", "", True),
            Column(
                "outcome",
                "string",
                "taken, or what is wrong: no model, too few frames registered, or moves otherwise than VIO",
            ),
            Column("taken", "bool", "its models are the stage's; where none is good, the one with most such frames"),
        ],
        version="1.1",
    ),
    TableSchema(
        "sfm",
        "pairs",
        "Every pair of frames that was proposed and matched in the attempt that was taken.",
        [
            Column("frame_id_a", "string", "earlier row of import.frames"),
            Column("frame_id_b", "string", "later row of import.frames"),
            Column("origin", "string", "who proposed it first: sequence, vio, retrieval or transitive"),
            Column("matches", "int64", "matched features"),
            Column("inliers", "int64", "of these, in agreement with one relative pose"),
            Column("verdict", "string", "verified, rejected: too few inliers, or disagrees: with VIO, kept out"),
            Column("reason", "string", "what disagrees: rotation, direction of motion or gravity; empty otherwise"),
            Column("rotation_deg", "float64", "between the relative rotations of images and VIO", "deg", "", True),
            Column("rotation_limit_deg", "float64", "what VIO can have drifted by there", "deg", "", True),
            Column("direction_deg", "float64", "between the directions of motion by images and VIO", "deg", "", True),
            Column("direction_limit_deg", "float64", "what VIO can have drifted by there", "deg", "", True),
            Column(
                "gravity_deg", "float64", "between gravity in b and gravity in a turned by the images", "deg", "", True
            ),
        ],
        version="1.1",
    ),
    TableSchema(
        "sfm",
        "points",
        "The points of the models that were kept.",
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
