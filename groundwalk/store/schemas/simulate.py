"""What the simulator writes beside its captures. Only checks and benchmarks read it, never a stage."""

from groundwalk.store.schemas import tables

TABLES = tables(
    "simulate",
    """
true_poses 1.0: Where each simulated camera really was, in the simulated world (metric, +y up).
    session_id (string): capture session
    t_ns (int64, ns): time of the pose on the capture's clock
    map_cam (pose): true map_T_cam at the middle row

true_cameras 1.2: What each simulated camera really was; the app's log states a pinhole at rest.
    = session_id t_ns
    f{xy} (float64, px): true focal length, {}
    c{xy} (float64, px): true principal point, {}
    k{123} (float64): radial distortion, OpenCV's convention
    readout_s (float64, s): time from the first row to the last
    time_offset_s (float64, s): t_ns minus the time of the middle row
""",
)
