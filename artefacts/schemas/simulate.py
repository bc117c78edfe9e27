"""What the simulator writes beside its captures. Only checks and benchmarks read it, never a stage."""

from artefacts.schemas import Column, TableSchema, pose_columns

TABLES = [
    TableSchema(
        "simulate",
        "true_poses",
        "Where each simulated camera really was, in the simulated world (metric, +y up).",
        [
            Column("session_id", "string", "capture session"),
            Column("t_ns", "int64", "time of the pose on the capture's clock", "ns"),
            *pose_columns("map_cam", "true map_T_cam"),
        ],
    )
]
