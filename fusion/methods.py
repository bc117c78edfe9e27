"""The fusion methods by id. A new one is a module with a `Localiser` and its options, and a line here."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from groundwalk.artefacts import UserError
from groundwalk.artefacts.settings import validated
from groundwalk.fusion.apr import Apr, AprOptions
from groundwalk.fusion.drift_aware import DriftAware, DriftAwareOptions
from groundwalk.fusion.error_map import ErrorMap
from groundwalk.fusion.error_state import ErrorState, ErrorStateOptions
from groundwalk.fusion.last_good import LastGood, LastGoodOptions
from groundwalk.fusion.localiser import Localiser, MethodOptions
from groundwalk.fusion.mobilearloc import MobileARLoc, MobileARLocOptions
from groundwalk.fusion.offline import Offline
from groundwalk.fusion.pose_graph import PoseGraph, PoseGraphOptions
from groundwalk.fusion.smoother import Smoother, SmootherOptions
from groundwalk.fusion.vio_oracle import VioOracle, VioOracleOptions
from groundwalk.fusion.window import Window, WindowOptions


@dataclass(frozen=True)
class Method:
    """How to make a method: `localiser(options)`; `options` is the settings model, whose values every result records.

    learns: it takes an `ErrorMap` of the regressor in the scene, where there is one.
    causal: it answers a frame from that frame and the ones before it, as an app must. One that isn't makes an
    `Offline`, which sees whole walks; tables say so and never rank it with the causal ones.
    """

    id: str
    make: Callable[..., Localiser | Offline]
    options: type[MethodOptions]
    meaning: str
    learns: bool = False
    causal: bool = True

    def localiser(self, options: MethodOptions, error_map: ErrorMap | None = None) -> Localiser | Offline:
        """A fresh one. `error_map` is what held-out frames say of the regressor; most methods have no use for it."""
        return self.make(options, error_map) if self.learns else self.make(options)


METHODS = {
    method.id: method
    for method in (
        Method("apr", Apr, AprOptions, "the raw regressor"),
        Method("mobilearloc", MobileARLoc, MobileARLocOptions, "the paper's rule"),
        Method("last_good", LastGood, LastGoodOptions, "the last prediction that passed the pair check, carried on"),
        Method("window30", Window, WindowOptions, "robust rigid alignment of the last 30 predictions"),
        Method("pose_graph", PoseGraph, PoseGraphOptions, "sliding window of poses: predictions and odometry's steps"),
        Method("error_state", ErrorState, ErrorStateOptions, "error-state Kalman filter with a gate"),
        Method("drift_aware", DriftAware, DriftAwareOptions, "slowly drifting alignment, from all the history", True),
        Method("smoother", Smoother, SmootherOptions, "drift_aware from the whole walk: for labelling", True, False),
        Method("vio_oracle", VioOracle, VioOracleOptions, "odometry laid on the ground truth: a bound", causal=False),
    )
}


def method(method_id: str) -> Method:
    """The method of that id; UserError where there is none."""
    if method_id not in METHODS:
        raise UserError(f"there is no fusion method {method_id!r}", expected=f"one of {', '.join(METHODS)}")
    return METHODS[method_id]


def resolve_options(method_id: str, values: dict[str, Any] | None = None) -> MethodOptions:
    """A method's options from a table of values; UserError for an unknown key or a value out of range."""
    return validated(method(method_id).options, values or {}, f"options of fusion method {method_id}")
