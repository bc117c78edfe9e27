"""Frames of a capture with the phone's poses, and everything that was rejected."""

from groundwalk.store.choices import (
    Appearance,
    Clock,
    ImageSide,
    LengthUnit,
    PoseSource,
    Rejected,
    SessionSplit,
    Split,
    Tracking,
    UpAxis,
    UpSource,
)
from groundwalk.store.schemas import Column, TableSchema, pose_columns

_SESSION = Column(
    "session_id",
    "string",
    "recording; a part of one where VIO jumped (`walk`, `walk.part2`), or of one camera of several (`walk.camera2`)",
)
_TIME = Column(
    "t_ns",
    "int64",
    "time on the session's clock; where that is name_order, the place in the order of names times 1e9",
    "ns",
)

TABLES = [
    TableSchema(
        "import",
        "frames",
        "Images that are used, each with its intrinsics and the phone's pose: frames of the dataset, and between them "
        "support frames, which only SfM and the checks of its model use: no table of a later stage has them.",
        [
            Column("frame_id", "string", "<session>/<six digits>, the row's number in the capture's log"),
            _SESSION,
            _TIME,
            Column("clock", "string", "what t_ns counts from; name_order: images have no times", choices=Clock),
            Column("image", "string", "path in the capture folder; `import:` in front: in this artefact"),
            Column("image_sha256", "string", "sha256 of the image file"),
            Column("width", "int64", "image width", "px"),
            Column("height", "int64", "image height", "px"),
            Column("fx", "float64", "focal length, x", "px"),
            Column("fy", "float64", "focal length, y", "px"),
            Column("cx", "float64", "principal point, x; the first pixel's outer corner is 0", "px"),
            Column("cy", "float64", "principal point, y; the first pixel's outer corner is 0", "px"),
            Column("distortion", "list<float64>", "OpenCV's k1, k2, p1, p2, k3, ...; empty: none"),
            Column(
                "focal_sd",
                "float64",
                "standard error of fx and fy, as a fraction, where they are EXIF's or a guess; 0: as logged",
            ),
            Column(
                "first_row",
                "string",
                "side of the image that the sensor reads out first (rolling shutter); sfm estimates a readout time "
                "below 0 where it is the opposite one",
                choices=ImageSide,
            ),
            Column(
                "stated_readout_s",
                "float64",
                "rolling shutter: time from the first to the last row that the capture states; null: none",
                "s",
                nullable=True,
            ),
            *pose_columns("vio_cam", "vio_T_cam by the phone's odometry", nullable=True),
            Column("gravity_x", "float64", "unit vector of gravity, x", "", "cam", nullable=True),
            Column("gravity_y", "float64", "unit vector of gravity, y", "", "cam", nullable=True),
            Column("gravity_z", "float64", "unit vector of gravity, z", "", "cam", nullable=True),
            Column("tracking", "string", "the odometry's state", choices=Tracking),
            Column("sharpness", "float64", "1 - blur after Crete et al. 2007, 0 to 1; higher is sharper"),
            Column("exposure_s", "float64", "exposure time", "s", nullable=True),
            Column(
                "split",
                "string",
                "what the frame is for; a support frame's is that of the frame of the dataset nearest in time",
                choices=Split,
            ),
            Column("support", "bool", "support frame: used by SfM and the checks of its model, not in the dataset"),
            Column("blurred_faces", "int64", "regions blurred as faces; null: no detector ran", nullable=True),
            Column("blurred_plates", "int64", "regions blurred as plates; null: no detector ran", nullable=True),
            Column(
                "depth",
                "string",
                "depth image that shows what the image shows: path as in `image`; PNG of 16 bits, mm along the "
                "camera's z axis, 0: none. Null where there is none",
                nullable=True,
            ),
            Column("depth_sha256", "string", "sha256 of the depth image file; null where there is none", nullable=True),
            Column(
                "depth_confidence",
                "string",
                "the sensor's confidence in the depth: path as in `image`; PNG of 8 bits, 0, 1, 2 or 0, 127, 255 for "
                "low, medium, high. Null where there is none",
                nullable=True,
            ),
        ],
        version="2.5",
    ),
    TableSchema(
        "import",
        "sessions",
        "The recordings of a capture.",
        [
            _SESSION,
            Column("recording", "string", "the recording that the session is, or is a part of"),
            Column("format", "string", "capture format, as `groundwalk formats` lists it"),
            Column("device", "string", "phone, as far as the capture says"),
            Column("clock", "string", "what t_ns counts from; name_order: images have no times", choices=Clock),
            Column("duration_s", "float64", "time from the first to the last pose; null: no times", "s", nullable=True),
            Column(
                "path_m",
                "float64",
                "length of the path of the poses; null where their unit is unknown, or without times their order",
                "m",
                nullable=True,
            ),
            Column("poses", "int64", "poses in the log"),
            Column("images", "int64", "sound images with a pose, before sampling"),
            Column("frames", "int64", "images selected by sampling: frames of the dataset"),
            Column("support_frames", "int64", "images added for SfM alone"),
            Column("split", "string", "what it is for; val blocks lie in train sessions", choices=SessionSplit),
            Column(
                "pose_source",
                "string",
                "whose poses they are; those of a reference are in table `reference`; none: photos or a video alone",
                nullable=True,
                choices=PoseSource,
            ),
            Column(
                "reference_unit",
                "string",
                "unit of the reference poses, unknown where their file states none; null where there are none",
                nullable=True,
                choices=LengthUnit,
            ),
            *(
                Column(
                    f"reference_origin_{axis}",
                    "float64",
                    f"where the origin of the reference poses is in the data set's own coordinates, {axis}, in "
                    "reference_unit: 0 where they are as stated, else what was taken off positions far from their "
                    "origin; null for VIO",
                    nullable=True,
                )
                for axis in "xyz"
            ),
            Column("up", "string", "up in the world of the poses", nullable=True, choices=UpAxis),
            Column(
                "up_source",
                "string",
                "what says whether +y is up: the format, untested; the capture itself; or import's test, by the "
                "accelerometer, lines in the images or the start pose",
                nullable=True,
                choices=UpSource,
            ),
            Column(
                "appearance",
                "string",
                "what is seen in a simulated recording, beside the training walks; null for a real one",
                nullable=True,
                choices=Appearance,
            ),
        ],
        version="3.3",
    ),
    TableSchema(
        "import",
        "rejects",
        "Rows and files of the captures that were rejected; images that sampling didn't select aren't here.",
        [
            _SESSION,
            Column("source", "string", "file or row in the capture"),
            Column("t_ns", "int64", "time on the session's clock, where it could be read", "ns", nullable=True),
            Column("reason", "string", "why"),
            Column(
                "rejected",
                "string",
                "what is left out by it: an image with its pose, a pose without an image, or the depth image of a "
                "frame that stays; null for a row that can't be read",
                nullable=True,
                choices=Rejected,
            ),
        ],
        version="1.1",
    ),
    TableSchema(
        "import",
        "jumps",
        "Motion between two poses that no hand can do: relocalisations of the odometry.",
        [
            _SESSION,
            Column("t_ns", "int64", "time of the first pose after the jump", "ns"),
            Column("dt_s", "float64", "time between the two poses", "s"),
            Column("jump_m", "float64", "displacement beyond the motion around it", "m"),
            Column("jump_deg", "float64", "rotation beyond the motion around it", "deg"),
            Column("splits", "bool", "larger than 0.5 m or 15 degrees: the session was split here"),
        ],
    ),
    TableSchema(
        "import",
        "reference",
        "Poses that a public data set has instead of VIO; no rows for phone captures. Its world is the data set's.",
        [
            Column("frame_id", "string", "frame, as in `frames`"),
            _SESSION,
            _TIME,
            *pose_columns("map_cam", "map_T_cam by the data set"),
        ],
    ),
    TableSchema(
        "import",
        "vio",
        "All sound poses of the odometry at its full rate, also those without an image.",
        [
            _SESSION,
            _TIME,
            *pose_columns("vio_cam", "vio_T_cam by the phone's odometry"),
            Column("tracking", "string", "the odometry's state", choices=Tracking),
        ],
    ),
]
