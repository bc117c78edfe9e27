"""The tables align.control and align.control_points, and control.png: surveyed points from above, with their errors."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from groundwalk.alignment.control.check import ControlCheck, describe
from groundwalk.geometry.poses import Array, make_pose
from groundwalk.store.schemas import schema
from groundwalk.store.tables import pose_frame

_INCHES = 6.0
# The longest error is drawn as this share of the picture.
_ARROW = 0.1


def control_table(checks: Sequence[ControlCheck]) -> pd.DataFrame:
    """A row a survey."""
    rows = [_row(check) for check in checks]
    return pd.DataFrame(rows, columns=schema("align", "control").column_names)


def _row(check: ControlCheck) -> dict[str, object]:
    fit, errors, (rms, expected_rms) = check.fit, check.error_m[check.held_out], check.rms_m
    survey_S_map = None if fit is None else fit.survey_S_map
    pose = (
        np.full((4, 4), np.nan) if survey_S_map is None else make_pose(survey_S_map.rotation, survey_S_map.translation)
    )
    rotation_sd, shift_sd = (
        (np.nan, np.nan)
        if fit is None
        else (float(np.sqrt(np.linalg.eigvalsh(fit.covariance[part, part])[-1])) for part in (slice(0, 3), slice(3, 6)))
    )
    figures = {
        "rms_m": rms,
        "worst_m": float(errors.max()) if len(errors) else np.nan,
        "expected_rms_m": expected_rms,
        "within_bounds": float(check.within_bounds[check.held_out].mean()) if len(errors) else np.nan,
        "map_scale": np.nan if survey_S_map is None else survey_S_map.scale,
        "scale": check.scale[0],
        "scale_sd": check.scale[1],
        "tilt_deg": check.tilt_deg[0],
        "tilt_sd_deg": check.tilt_deg[1],
        "rotation_sd_deg": np.degrees(rotation_sd),
        "position_sd_m": shift_sd,
    }
    return {
        "control": check.points.settings.name,
        "points": len(check.used),
        "used": int(check.used.sum()),
        "held_out": len(errors),
        "fit": "none" if fit is None else "se3" if survey_S_map is not None and survey_S_map.scale == 1.0 else "sim3",
        **figures,
        **{str(name): values[0] for name, values in pose_frame("survey_map", pose[None]).items()},
        "status": check.result.status,
        "reason": check.result.reason,
    }


def points_table(checks: Sequence[ControlCheck]) -> pd.DataFrame:
    """A row a survey and point."""
    tables = [
        pd.DataFrame(
            {
                "control": check.points.settings.name,
                "point": check.points.names,
                "used": check.used,
                "frames": check.mapped.frames,
                **{f"survey_{axis}": check.points.xyz_m[:, i] for i, axis in enumerate("xyz")},
                "survey_sd_m": check.points.sd_m,
                **{f"map_{axis}": check.mapped.xyz[:, i] for i, axis in enumerate("xyz")},
                "map_sd_m": np.sqrt(np.trace(check.mapped.covariance, axis1=1, axis2=2)),
                "error_m": check.error_m,
                "expected_m": check.expected_m,
                "reason": [check.mapped.remarks.get(index, "") for index in range(len(check.used))],
            }
        )
        for check in checks
    ]
    names = schema("align", "control_points").column_names
    return pd.concat(tables, ignore_index=True)[names] if tables else pd.DataFrame(columns=names)


def draw_control(path: Path, checks: Sequence[ControlCheck], map_xyz: Array) -> None:
    """Each survey's points in the map from above, the walk (N, 3) behind, with held-out errors as arrows."""
    figure = Figure(figsize=(_INCHES * len(checks), _INCHES), layout="constrained")
    for axes, check in zip(figure.subplots(1, len(checks), squeeze=False)[0], checks, strict=True):
        axes.plot(map_xyz[:, 0], map_xyz[:, 2], ".", ms=2, color="0.7")
        at, fit = check.mapped.xyz, check.fit
        axes.plot(*at[check.used][:, ::2].T, "o", color="tab:blue", label="agree")
        axes.plot(*at[~check.used][:, ::2].T, "x", color="tab:red", label="don't, or aren't used")
        if fit is not None and check.held_out.any():
            rows = check.held_out
            error = fit.held_out[rows] @ fit.survey_S_map.rotation / fit.survey_S_map.scale
            factor = (
                _ARROW * float(np.ptp(at[rows], axis=0).max()) / max(float(np.linalg.norm(error, axis=1).max()), 1e-12)
            )
            axes.quiver(
                *at[rows][:, ::2].T, *factor * error[:, ::2].T, angles="xy", scale_units="xy", scale=1, width=0.004
            )
            axes.set_xlabel(f"x, m; errors {factor:.0f} times as long", fontsize=8)
        for name, xyz in zip(check.points.names, at, strict=True):
            if np.isfinite(xyz).all():
                axes.annotate(name, xyz[::2], fontsize=7, xytext=(3, 3), textcoords="offset points")
        axes.set_ylabel("z, m", fontsize=8)
        axes.set_title(describe(check), fontsize=7, loc="left", wrap=True)
        axes.invert_yaxis()
        axes.set_aspect("equal", "datalim")
        axes.legend(fontsize=7)
    figure.savefig(path, dpi=100)
