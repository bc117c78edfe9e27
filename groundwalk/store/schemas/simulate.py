"""What the simulator writes beside its captures. Only checks and benchmarks read it, never a stage."""

from groundwalk.store.schemas import Column, TableSchema, pose_columns

TABLES = [
    TableSchema(
        "simulate",
        "true_poses",
        "Where each simulated camera really was, in the simulated world (metric, +y up).",
        [
            Column("session_id", "string", "capture session"),
            Column("t_ns", "int64", "time of the pose on the capture's clock", "ns"),
            *pose_columns("map_cam", "true map_T_cam at the middle row"),
        ],
    ),
    TableSchema(
        "simulate",
        "true_cameras",
        "What each simulated camera really was and how it moved; the app's log states a pinhole at rest.",
        [
            Column("session_id", "string", "capture session"),
            Column("t_ns", "int64", "time of the pose on the capture's clock", "ns"),
            Column("fx", "float64", "true focal length, x", "px"),
            Column("fy", "float64", "true focal length, y", "px"),
            Column("cx", "float64", "true principal point, x", "px"),
            Column("cy", "float64", "true principal point, y", "px"),
            Column("k1", "float64", "radial distortion, OpenCV's convention"),
            Column("k2", "float64", "radial distortion, OpenCV's convention"),
            Column("k3", "float64", "radial distortion, OpenCV's convention"),
            Column("readout_s", "float64", "time from the first row to the last", "s"),
            Column("time_offset_s", "float64", "t_ns minus the time of the middle row", "s"),
            *(Column(f"velocity_{a}", "float64", f"velocity at the middle row, {a}", "m/s", "cam") for a in "xyz"),
            *(Column(f"spin_{a}", "float64", f"turning rate at the middle row, {a}", "rad/s", "cam") for a in "xyz"),
        ],
        version="1.1",
    ),
]
