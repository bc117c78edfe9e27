"""Records of groundwalk's own fusion methods."""

from groundwalk.fusion.methods import Method
from groundwalk.fusion.methods.drift_aware import DriftAware, DriftAwareOptions, Smoother
from groundwalk.fusion.methods.error_state import ErrorState, ErrorStateOptions
from groundwalk.fusion.methods.last_good import LastGood
from groundwalk.fusion.methods.localiser import MethodOptions
from groundwalk.fusion.methods.odometry import PairOptions, Raw
from groundwalk.fusion.methods.paper_rule import PaperRule, PaperRuleOptions
from groundwalk.fusion.methods.pose_graph import GlobalGraphOptions, PoseGraph, PoseGraphOptions
from groundwalk.fusion.methods.vio_oracle import VioOracle, VioOracleOptions
from groundwalk.fusion.methods.window import Window, WindowOptions
from groundwalk.store import colours

RAW = Method(
    id="raw",
    label="predictor alone",
    meaning="the raw prediction",
    colour=colours.APR,
    make=Raw,
    options=MethodOptions,
    causal=True,
    fuses=False,
    visible=True,
)
PAPER_RULE = Method(
    id="paper_rule",
    label="VIO",
    meaning="the paper's rule",
    colour=colours.FUSED,
    make=PaperRule,
    options=PaperRuleOptions,
    causal=True,
    visible=True,
)
LAST_GOOD = Method(
    id="last_good",
    label="last_good",
    meaning="the last prediction that passed the pair check, carried on",
    colour=(240, 228, 66),
    make=LastGood,
    options=PairOptions,
    causal=True,
)
WINDOW30 = Method(
    id="window30",
    label="window30",
    meaning="robust rigid alignment of the last 30 predictions",
    colour=(0, 114, 178),
    make=Window,
    options=WindowOptions,
    causal=True,
)
POSE_GRAPH = Method(
    id="pose_graph",
    label="pose_graph",
    meaning="sliding window of poses: predictions and odometry's steps",
    colour=(200, 200, 200),
    make=PoseGraph,
    options=PoseGraphOptions,
    causal=True,
)
GLOBAL_GRAPH = Method(
    id="global_graph",
    label="global_graph",
    meaning="global pose graph, as VINS-Fusion's: the walk so far, Huber's loss",
    colour=(120, 120, 120),
    make=PoseGraph,
    options=GlobalGraphOptions,
    causal=True,
)
ERROR_STATE = Method(
    id="error_state",
    label="error_state",
    meaning="error-state Kalman filter with a gate",
    colour=(166, 86, 40),
    make=ErrorState,
    options=ErrorStateOptions,
    causal=True,
)
DRIFT_AWARE = Method(
    id="drift_aware",
    label="drift_aware",
    meaning="slowly drifting alignment, fitted to all kept predictions anew with each one",
    colour=(0, 60, 110),
    make=DriftAware,
    options=DriftAwareOptions,
    causal=True,
    needs_vertical=True,
    visible=True,
)
SMOOTHER = Method(
    id="smoother",
    label="smoother",
    meaning="drift_aware that answers after the whole walk",
    colour=(117, 112, 179),
    make=Smoother,
    options=DriftAwareOptions,
    causal=False,
    needs_vertical=True,
)
VIO_ORACLE = Method(
    id="vio_oracle",
    label="vio_oracle",
    meaning="odometry laid on the ground truth: a bound",
    colour=(231, 41, 138),
    make=VioOracle,
    options=VioOracleOptions,
    causal=False,
)
