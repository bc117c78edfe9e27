"""What the train stage writes: the regressors' poses, how they learned, and what they are."""

from groundwalk.store.choices import Split
from groundwalk.store.schemas import Column, TableSchema, pose_columns

_MODEL = Column("model", "string", "the regressor's id")
_SCENES = Column("scenes", "list<string>", "the scenes that the model was trained on, in the order of its queries")

TABLES = [
    TableSchema(
        "train",
        "predictions",
        "One row a model and frame: the pose estimated from the frame's image alone. A regressor that is trained here "
        "has one for every frame of every split, an imported one those that its file has.",
        [
            _MODEL,
            Column("scene", "string", "the scene that the frame is of"),
            Column("frame_id", "string", "<session>/<six digits>"),
            Column("session_id", "string", "capture session"),
            Column("split", "string", "what the frame is for", choices=Split),
            Column("t_ns", "int64", "capture time on the session's clock", "ns"),
            *pose_columns("map_cam", "estimated map_T_cam, in the map of picked_scene"),
            Column(
                "covariance",
                "list<float64>",
                "6x6, row-major, of map_cam's error: rotation then translation; null where neither the regressor nor "
                "held-out frames give one",
                "rad, m",
                "map",
                True,
            ),
            Column(
                "picked_scene", "string", "the scene that the model took the image for; one of several scenes can err"
            ),
            Column(
                "inference_ms",
                "float64",
                "one image through the network, crop to pose, batch of 1, float32; null where a file doesn't say",
                "ms",
                nullable=True,
            ),
        ],
        version="1.1",
    ),
    TableSchema(
        "train",
        "history",
        "Learning curves: one row a model and epoch.",
        [
            _MODEL,
            _SCENES,
            Column("epoch", "int64", "passes over the training frames, from 1"),
            Column("learning_rate", "float64", "of the epoch's last step"),
            Column("train_loss", "float64", "mean over the epoch's steps; comparable within a model only"),
            Column("val_position_m", "float64", "median position error on held-out frames", "m"),
            Column("val_rotation_deg", "float64", "median rotation error on held-out frames", "deg"),
            Column("sx", "float64", "learned log-variance of the position loss; null: there is none", nullable=True),
            Column("sq", "float64", "learned log-variance of the rotation loss; null: there is none", nullable=True),
            Column("seconds", "float64", "wall time of the epoch", "s"),
            Column("selected", "bool", "the epoch whose weights the model has: smallest held-out score"),
        ],
        version="2.0",
    ),
    TableSchema(
        "train",
        "models",
        "Model cards: one row a model. What only training knows is null for imported predictions.",
        [
            _MODEL,
            Column("label", "string", "the model as tables and pages print it; null: its id", nullable=True),
            _SCENES,
            Column("file", "string", "the weights, relative to the artefact; empty for imported predictions"),
            Column("parameters", "int64", "numbers that training can change", nullable=True),
            Column(
                "bytes",
                "int64",
                "float32 weights: parameters and the batch norms' running statistics",
                "byte",
                nullable=True,
            ),
            Column("layers", "string", "sizes that the settings choose, in words; empty where there are none"),
            Column(
                "weights",
                "string",
                "where the first weights came from: ImageNet, a file, scratch, and why; or the file of predictions",
            ),
            Column("resize_px", "int64", "shorter side of the images before cropping", "px", nullable=True),
            Column("crop_px", "int64", "height of what the network sees of the image's middle", "px", nullable=True),
            Column("width_px", "int64", "its width; null: as its height", "px", nullable=True),
            Column("upright", "bool", "images are turned about their middle until gravity points down", nullable=True),
            Column(
                "focal_px",
                "float64",
                "of the pinhole, its principal point in the middle, as whose images the network sees all; null: images "
                "as captured",
                "px",
                nullable=True,
            ),
            Column("train_frames", "int64", "frames trained on", nullable=True),
            Column("val_frames", "int64", "frames held out to choose the epoch", nullable=True),
            Column("epochs", "int64", "epochs trained", nullable=True),
            Column("best_epoch", "int64", "the epoch whose weights the model has", nullable=True),
            Column("seed", "int64", "seed of everything random"),
            Column("config", "string", "settings of this model, JSON"),
            Column(
                "reduced",
                "string",
                "what the profile makes smaller than in the paper; empty: nothing, null: it isn't in the paper",
                nullable=True,
            ),
            Column("device", "string", "where it was trained and timed, and in which precision it was trained"),
            Column("inference_ms", "float64", "median of predictions.inference_ms", "ms", nullable=True),
            Column("train_seconds", "float64", "wall time of training", "s", nullable=True),
        ],
        version="1.4",
    ),
]
