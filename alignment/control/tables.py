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
    """A row a survey; what no fit says is NaN."""
    return pd.DataFrame([_row(check) for check in checks], columns=schema("align", "control").column_names)


def _row(check: ControlCheck) -> dict[str, object]:
    errors, (rms, expected_rms) = check.error_m[check.held_out], check.rms_m
    row: dict[str, object] = {
        "control": check.points.settings.name,
        "points": len(check.used),
        "used": int(check.used.sum()),
        "held_out": len(errors),
        "fit": "none",
        "rms_m": rms,
        "expected_rms_m": expected_rms,
        **dict(zip(("scale", "scale_sd", "tilt_deg", "tilt_sd_deg"), check.scale + check.tilt_deg, strict=True)),
        "status": check.result.status,
        "reason": check.result.reason,
    }
    if len(errors):
        within = float(check.within_bounds[check.held_out].mean())
        row |= {"worst_m": float(errors.max()), "within_bounds": within}
    if check.fit is not None:
        survey_S_map, covariance = check.fit.survey_S_map, check.fit.covariance
        pose = pose_frame("survey_map", make_pose(survey_S_map.rotation, survey_S_map.translation)[None])
        sds = [float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in (covariance[:3, :3], covariance[3:6, 3:6])]
        row |= {str(name): values[0] for name, values in pose.items()}
        row |= {"fit": "se3" if survey_S_map.scale == 1.0 else "sim3", "map_scale": survey_S_map.scale}
        row |= {"rotation_sd_deg": np.degrees(sds[0]), "position_sd_m": sds[1]}
    return row


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
            longest = max(float(np.linalg.norm(error, axis=1).max()), 1e-12)
            factor = _ARROW * float(np.ptp(at[rows], axis=0).max()) / longest
            arrows = *at[rows][:, ::2].T, *factor * error[:, ::2].T
            axes.quiver(*arrows, angles="xy", scale_units="xy", scale=1, width=0.004)
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
