"""The picture of a real capture: our path and stock COLMAP's on VIO's, and how far each frame is from it."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from benchmarks.real_figures import Paths, Placed, placed_alone
from groundwalk.store.colours import GROUND_TRUTH, NEUTRAL, VIO

_INCHES = 3.0
_COLOURS = {name: tuple(c / 255 for c in colour) for name, colour in (
    ("VIO", VIO), ("ours", GROUND_TRUTH), ("stock COLMAP", NEUTRAL)
)}  # fmt: skip
_MOST_TIMES = 4
_STYLES = {"ours": "-", "stock COLMAP": "--"}


def draw_case(path: Path, title: str, verdict: str, paths: Paths) -> None:
    """One row a session: plan in its VIO frame, each model fitted by a Sim3, and residuals over VIO's path."""
    ours, stock = placed_alone(paths)
    ways = {"stock COLMAP": stock, "ours": ours}
    sessions = list(np.unique(paths.session.astype(str)))
    figure = Figure(figsize=(4 * _INCHES, _INCHES * len(sessions) + 0.4), layout="constrained")
    axes = figure.subplots(len(sessions), 3, squeeze=False)
    for (plan, metres, degrees), session in zip(axes, sessions, strict=True):
        rows = np.flatnonzero(paths.session == session)
        _draw_plan(plan, session, paths, ways, rows)
        _draw_residuals(metres, degrees, paths, ways, rows)
    figure.suptitle(f"{title}: {verdict}", fontsize=10, wrap=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)


def _draw_plan(plan: Axes, session: str, paths: Paths, ways: dict[str, Placed], rows: np.ndarray) -> None:
    vio = paths.vio_T_cam[rows, :3, 3]
    plan.plot(vio[:, 0], vio[:, 2], ".-", ms=3, color=_COLOURS["VIO"], lw=1.2, label="VIO")
    for name, placed in ways.items():
        xyz = placed.xyz_vio[rows]
        count = int(np.isfinite(xyz[:, 0]).sum())
        label = f"{name}, {count} of {len(rows)} frames"
        plan.plot(xyz[:, 0], xyz[:, 2], ".", ls=_STYLES[name], ms=3, color=_COLOURS[name], lw=1, label=label)
    plan.set_aspect("equal", adjustable="datalim")
    plan.invert_yaxis()
    plan.set_title(f"{session}: plan in its VIO frame, m", fontsize=8)
    plan.legend(fontsize=7)
    plan.tick_params(labelsize=7)


def _draw_residuals(metres: Axes, degrees: Axes, paths: Paths, ways: dict[str, Placed], rows: np.ndarray) -> None:
    vio = paths.vio_T_cam[rows, :3, 3]
    known = np.isfinite(vio[:, 0])
    rows, vio = rows[known], vio[known]
    travelled_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(vio, axis=0), axis=1))])[: len(rows)]
    for axis, unit in ((metres, "mm"), (degrees, "deg")):
        values = {
            name: (1000 * placed.position_m if unit == "mm" else placed.rotation_deg)[rows]
            for name, placed in ways.items()
        }
        for name, of_way in values.items():
            axis.plot(travelled_m, of_way, ".", ls=_STYLES[name], ms=3, lw=1, color=_COLOURS[name])
        axis.set_ylim(bottom=0)
        title = f"from VIO, {unit}"
        ours, stock = (
            np.max(values[name], where=np.isfinite(values[name]), initial=0) for name in ("ours", "stock COLMAP")
        )
        # A folded model would leave nothing to see of the other.
        if 0 < _MOST_TIMES * ours < stock:
            axis.set_ylim(0, _MOST_TIMES * ours)
            title += f"; stock COLMAP up to {stock:.0f}"
        axis.set_title(title, fontsize=8)
        axis.set_xlabel("VIO path, m", fontsize=7)
        axis.tick_params(labelsize=7)
