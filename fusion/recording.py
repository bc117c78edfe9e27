"""The fuse stage's recording: where each source says the device was, and why, as the walk plays."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from groundwalk.fusion.evaluation.fuse import Fused, pose_errors
from groundwalk.fusion.methods import METHODS
from groundwalk.fusion.methods.localiser import Status
from groundwalk.fusion.walk import known
from groundwalk.geometry.poses import Array, quaternion_from_matrix
from groundwalk.store import colours
from groundwalk.store.recording import FRAME_TIMELINE, TIMELINE, UP_AXIS, log_images, log_path, tabbed
from groundwalk.store.registry import Colour

Stream = rr.RecordingStream
Times = list[rr.TimeColumn]
Gates = Mapping[str, Mapping[str, float]]  # the thresholds of each method's signals
STATUS_COLOURS = {
    Status.RELIABLE: colours.APR,
    Status.OPTIMISED: colours.FUSED,
    Status.ALIGNING: colours.VIO,
    Status.PREDICTED: colours.APR,
    Status.FUSED: colours.FUSED,
    Status.LOST: colours.VIO,
    Status.NONE: colours.REJECTED,
}
_MARKER = rr.Radius.ui_points(6.0)
_SPARSE = 0.5  # share of frames with a value, below which a plot has points instead of a line
_GATE_RANGE = 5.0  # how far a plot of a gated signal reaches, in gates
_WITHIN_95 = 7.815  # squared standard deviations that hold 95 % of a Gaussian with three axes


def blueprint(fused: list[Fused], gates: Gates) -> rrb.Blueprint:
    """A tab a scene and model: the paths on the left; errors, status and decisions over time on the right. `gates` has
    the thresholds of each method's signals."""
    tabs = []
    for scene, model in dict.fromkeys((f.walk.scene, f.run.model) for f in fused):
        of_tab = [f for f in fused if (f.walk.scene, f.run.model) == (scene, model)]
        methods = list(dict.fromkeys(f.run.method for f in of_tab))
        initial = [method for method in methods if METHODS[method].visible]
        # The others are switched on in the viewer's list of entities.
        hidden = [method for method in methods if method not in initial] if len(initial) > 1 else []
        at = _path(scene, model)
        decisions = [
            rrb.Vertical(
                rrb.StateTimelineView(origin=f"{at}/status/{method}", name="status"),
                *(_signal_view(at, method, signal, gates[method].get(signal)) for signal in signals),
                name=method,
            )
            for method, signals in _signals(of_tab).items()
        ]
        plots = rrb.Vertical(
            *(
                rrb.TimeSeriesView(
                    origin=f"{at}/{quantity}", name=name, overrides=_invisible(f"{at}/{quantity}", hidden)
                )
                for quantity, name in _ERRORS.items()
            ),
            *([rrb.Tabs(*decisions)] if decisions else []),
            row_shares=[1, 1, *([3] if decisions else [])],
        )
        paths_of = [f"{at}/{'fused/' if METHODS[method].fuses else ''}{method}" for method in methods]
        walkers = (f"{_path(scene)}/ground_truth", *paths_of)
        paths = rrb.Spatial3DView(
            origin=_path(scene),
            contents=[f"{_path(scene)}/ground_truth/**", f"{at}/**"],
            name=_FUSED_COLOURS if decisions else _ALONE_COLOURS,
            overrides={
                **{path: seen for kind in _OF_METHOD for path, seen in _invisible(f"{at}/{kind}", hidden).items()},
                **{f"{path}/now": _TAIL for path in walkers},
            },
        )
        name = f"{scene} · {model}"
        image = rrb.Spatial2DView(origin=f"{_path(scene)}/image", name="image")
        places = rrb.Vertical(paths, image, row_shares=[2, 1])
        tabs.append(rrb.Horizontal(places, plots, column_shares=[3, 2], name=name))
    return tabbed(tabs)


_FUSED_COLOURS = "ground truth green, aligned odometry orange, the others as on the right"
_ALONE_COLOURS = "ground truth green; without odometry nothing is fused"
_OF_METHOD = ("fused", "vio_aligned", "residual", "covariance")
# A marker's last ten places stay in view.
_TAIL = rrb.VisibleTimeRanges(
    timeline=FRAME_TIMELINE,
    start=rrb.TimeRangeBoundary.cursor_relative(seq=-10),
    end=rrb.TimeRangeBoundary.cursor_relative(),
)
_ERRORS = {"position_error_m": "position error, m", "rotation_error_deg": "rotation error, degrees"}


def _path(*parts: str) -> str:
    """An entity path; names may hold anything."""
    return "".join(f"/{rr.escape_entity_path_part(part)}" for part in parts)


def _invisible(at: str, methods: list[str]) -> dict[Any, Any]:
    """The blueprint's overrides that hide some methods' entities under `at`."""
    return {f"{at}/{method}": rrb.EntityBehavior(visible=False) for method in methods}


def _signal_view(at: str, method: str, signal: str, gate: float | None) -> rrb.TimeSeriesView:
    """A signal over time. Outliers would squeeze its gate into the axis, so the plot reaches some gates far."""
    reach = None
    if signal == "similarity" and gate is not None:
        # Its gate is a lower bound, and 1 its best value.
        reach = (1 - _GATE_RANGE * max(1 - gate, 0.001), 1.0)
    elif gate is not None:
        reach = (0.0, _GATE_RANGE * gate)
    axis = None if reach is None else rrb.ScalarAxis(range=reach)
    return rrb.TimeSeriesView(origin=f"{at}/signals/{method}/{signal}", name=signal, axis_y=axis)


def record(stream: Stream, fused: list[Fused], gates: Gates, frames: Mapping[str, pd.DataFrame]) -> None:
    """Log what each method said of each walk. `gates` has the thresholds of each method's signals; `frames`, of scenes
    with images, the rows of import.frames and the `file` of each."""
    starts: dict[tuple[str, str, str, int], int] = {}
    names: dict[tuple[str, str, str, int], str] = {}
    counted: Counter[str] = Counter()
    for f in fused:
        walk, method = f.walk, f.run.method
        key = (walk.scene, walk.session_id, walk.split, int(walk.t_ns[0]))
        first = key not in starts
        if first:
            stretch = sum(other[:3] == key[:3] for other in starts)  # a split may have several of a session
            names[key] = _path(walk.session_id, f"{walk.split}_{stretch + 1}" if stretch else walk.split)
            starts[key] = counted[walk.scene]
            counted[walk.scene] += len(walk)
        number: NDArray[Any] = starts[key] + np.arange(len(walk))
        since = walk.t_ns - walk.t_ns[0]
        times = [
            rr.TimeColumn(FRAME_TIMELINE, sequence=number),
            rr.TimeColumn(TIMELINE, duration=since.astype("timedelta64[ns]")),
        ]
        name, scene, at = names[key], _path(walk.scene), _path(walk.scene, f.run.model)
        if first:
            stream.log(scene, UP_AXIS, static=True)
            _log_walk(stream, f"{scene}/ground_truth", name, times, walk.map_T_cam, colours.GROUND_TRUTH)
            if walk.scene in frames:
                seen = frames[walk.scene].set_index("frame_id").loc[list(walk.frame_id)]
                log_images(stream, f"{scene}/image", seen, [(FRAME_TIMELINE, number), (TIMELINE, since)])
        if not METHODS[method].fuses:
            _log_walk(stream, f"{at}/{method}", name, times, f.live_map_T_cam, _colour(f), 0.5)
        else:
            _log_walk(stream, f"{at}/fused/{method}", name, times, f.live_map_T_cam, _colour(f))
            _log_walk(stream, f"{at}/vio_aligned/{method}", name, times, f.map_T_vio @ walk.vio_T_cam, colours.VIO, 0.5)
            _log_residuals(stream, f"{at}/residual/{method}", f, times)
            _log_covariance(stream, f"{at}/covariance/{method}", f, times)
            _log_decisions(stream, at, f, times, gates[method])
        colour = _colour(f)
        position_m, rotation_deg = pose_errors(f.live_map_T_cam, walk.map_T_cam)
        _log_series(stream, f"{at}/position_error_m/{method}", times, position_m, colour, method)
        _log_series(stream, f"{at}/rotation_error_deg/{method}", times, rotation_deg, colour, method)


def _colour(f: Fused) -> Colour:
    """A method's colour; what a localiser says alone has the localiser's."""
    method = METHODS[f.run.method]
    return method.colour if method.fuses else colours.localiser_colours([f.run.model])[f.run.model]


def _signals(fused: list[Fused]) -> dict[str, list[str]]:
    """The names of each method's signals, for the methods that decide anything."""
    names: dict[str, set[str]] = {}
    for f in fused:
        if METHODS[f.run.method].fuses:
            names.setdefault(f.run.method, set()).update(name for e in f.estimates for name in e.signals)
    return {method: sorted(keys) for method, keys in names.items()}


def _log_walk(
    stream: Stream, path: str, name: str, times: Times, map_T_cam: Array, colour: Colour, width_px: float = 1.5
) -> None:
    """The whole path as a line, and a marker where the walk is now."""
    xyz = map_T_cam[:, :3, 3]
    log_path(stream, f"{path}/path{name}", xyz, colour, width_px)
    stream.log(f"{path}/now", rr.Points3D.from_fields(colors=colour, radii=_MARKER), static=True)
    there = known(map_T_cam)
    # A frame without a pose takes the marker away.
    markers = rr.Points3D.columns(positions=xyz[there]).partition(there.astype(int))
    stream.send_columns(f"{path}/now", indexes=times, columns=markers)


def _log_residuals(stream: Stream, path: str, f: Fused, times: Times) -> None:
    """A line from the frame's answer to its prediction."""
    stream.log(path, rr.LineStrips3D.from_fields(colors=colours.NEUTRAL, radii=rr.Radius.ui_points(1.0)), static=True)
    there = known(f.live_map_T_cam) & known(f.walk.map_T_cam_predicted)
    ends = np.stack([f.live_map_T_cam[there, :3, 3], f.walk.map_T_cam_predicted[there, :3, 3]], axis=1)
    columns = rr.LineStrips3D.columns(strips=list(ends)).partition(there.astype(int))
    stream.send_columns(path, indexes=times, columns=columns)


def _log_covariance(stream: Stream, path: str, f: Fused, times: Times) -> None:
    """The ellipsoid that holds the position with 95 % by the method's covariance, for methods that have one."""
    there = known(f.live_map_T_cam) & known(f.covariance)
    if not there.any():
        return
    variance, axes = np.linalg.eigh(f.covariance[there, 3:, 3:])
    axes[..., 0] *= np.linalg.det(axes)[:, None]
    thin = rr.Radius.ui_points(0.7)
    look = rr.Ellipsoids3D.from_fields(colors=(*_colour(f), 90), fill_mode="majorwireframe", line_radii=thin)
    stream.log(path, look, static=True)
    columns = rr.Ellipsoids3D.columns(
        centers=f.live_map_T_cam[there, :3, 3],
        half_sizes=np.sqrt(_WITHIN_95 * np.maximum(variance, 0.0)),
        quaternions=quaternion_from_matrix(axes),
    ).partition(there.astype(int))
    stream.send_columns(path, indexes=times, columns=columns)


def _log_decisions(stream: Stream, at: str, f: Fused, times: Times, gates: Mapping[str, float]) -> None:
    """The status as a lane, and each signal with its gate."""
    method = f.run.method
    lane = f"{at}/status/{method}"
    states = rr.StateConfiguration(values=[str(s) for s in STATUS_COLOURS], colors=list(STATUS_COLOURS.values()))
    stream.log(lane, states, static=True)
    stream.send_columns(lane, indexes=times, columns=rr.StateChange.columns(state=list(f.live_status)))
    for signal in _signals([f])[method]:
        path = f"{at}/signals/{method}/{signal}"
        values = np.array([e.signals.get(signal, np.nan) for e in f.estimates])
        _log_series(stream, f"{path}/value", times, values, _colour(f), signal)
        if signal in gates:
            _log_series(stream, f"{path}/gate", times, np.full(len(values), gates[signal]), colours.REJECTED, "gate")


def _log_series(stream: Stream, path: str, times: Times, values: Array, colour: Colour, name: str) -> None:
    # A line doesn't show values that stand alone.
    if np.isfinite(values).mean() < _SPARSE:
        stream.log(path, rr.SeriesPoints(colors=colour, names=name, marker_sizes=2.0), static=True)
    else:
        stream.log(path, rr.SeriesLines(colors=colour, names=name), static=True)
    stream.send_columns(path, indexes=times, columns=rr.Scalars.columns(scalars=values))
