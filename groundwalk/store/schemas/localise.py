"""What the localise stage writes: the structure localisers' poses and refusals, and what they keep and cost."""

from groundwalk.store.choices import Refusal, Split
from groundwalk.store.schemas import Column, TableSchema, pose_columns

_MODEL = Column("model", "string", "the structure localiser's id")

TABLES = [
    TableSchema(
        "localise",
        "predictions",
        "One row a structure localiser and frame of the splits in the settings: the pose estimated from the frame's "
        "image and its gravity, or why there is none. Frames of split train are in the map, and so aren't asked unless "
        "the settings say so.",
        [
            _MODEL,
            Column("scene", "string", "the scene that the frame is of"),
            Column("frame_id", "string", "<session>/<six digits>"),
            Column("session_id", "string", "capture session"),
            Column("split", "string", "what the frame is for; neither val nor test is in the map", choices=Split),
            Column("t_ns", "int64", "capture time on the session's clock", "ns"),
            *pose_columns("map_cam", "estimated map_T_cam; null where refused", nullable=True),
            Column(
                "covariance",
                "list<float64>",
                "6x6, row-major, of map_cam's error: rotation then translation; null where there is none",
                "rad, m",
                "map",
                True,
            ),
            Column("picked_scene", "string", "the scene of the map"),
            Column(
                "inference_ms",
                "float64",
                "one decoded image to its pose, on the clock",
                "ms",
            ),
            Column(
                "cpu_ms", "float64", "the same as time of all cores, which other work on the machine changes less", "ms"
            ),
            Column("inliers", "int64", "keypoints that the pose explains"),
            Column("candidates", "int64", "keypoints that were matched with a point"),
            Column(
                "refusal",
                "string",
                "why there is no pose (docs/explanation/localisation.md); null: there is one",
                nullable=True,
                choices=Refusal,
            ),
            Column("reason", "string", "the figures behind the refusal; null: there is a pose", nullable=True),
        ],
    ),
    TableSchema(
        "localise",
        "models",
        "One row a structure localiser: what it is, what it was built from, and what a query costs.",
        [
            _MODEL,
            Column("label", "string", "the localiser as tables and pages print it"),
            Column("meaning", "string", "the localiser in a few words"),
            Column("file", "string", "its file, relative to the artefact; empty where it has none"),
            Column("bytes", "int64", "all that a query needs: the sum of localise.storage", "byte"),
            Column("points", "int64", "points that it keeps"),
            Column("train_frames", "int64", "frames that it was built from"),
            Column("seed", "int64", "seed of everything random"),
            Column("config", "string", "settings of the features and of this localiser, JSON"),
            Column("device", "string", "where it was built and timed"),
            Column(
                "inference_ms",
                "float64",
                "median of predictions.inference_ms; null: no frame was asked",
                "ms",
                "",
                True,
            ),
            Column("cpu_ms", "float64", "median of predictions.cpu_ms; null: no frame was asked", "ms", "", True),
            Column(
                "build_cpu_seconds",
                "float64",
                "time of all cores that it took beyond features and matches, which all localisers share",
                "s",
            ),
        ],
    ),
    TableSchema(
        "localise",
        "storage",
        "What a query needs of a structure localiser, part by part.",
        [
            _MODEL,
            Column("part", "string", "descriptors, points, ... (docs/explanation/localisation.md)"),
            Column("bytes", "int64", "its size", "byte"),
        ],
    ),
]
