"""How the poses of SfM in the map agree with reference poses."""

import numpy as np
import pandas as pd

from groundwalk.alignment.components import PlacedComponent
from groundwalk.alignment.reference.diagnosis import fit_if_any
from groundwalk.alignment.reference.poses import Reference
from groundwalk.geometry.fits import pose_residuals
from groundwalk.geometry.pose_similarity import fit_similar_poses
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import LengthUnit, ReferenceAlignment, ScaleSource, VerticalSource
from groundwalk.store.hints import setting_of
from groundwalk.store.schemas import schema

# Real references, by depth or other SfM, agree with SfM's rotations to some tenths of a degree.
_NOTICEABLE_DEG = 0.5


def agreement_table(
    frames: pd.DataFrame, map_T_cam: Array, placed: list[PlacedComponent], reference: Reference | None
) -> pd.DataFrame:
    """The align.reference_agreement table: poses map_T_cam (N, 4, 4) of all frames that SfM placed, model by model,
    against the reference.

    Where the reference gives the map, both are in one frame and compared as they are; `scale` is of a fit of the
    session alone. Where VIO gives it, each session's reference is fitted to the map first: rigidly if both are metric,
    so that a wrong scale shows.
    """
    columns = schema("align", "reference_agreement").column_names
    rows: list[dict[str, object]] = []
    if reference is not None:
        sessions = frames["session_id"].to_numpy(str)
        for component in (each.component for each in placed):
            registered = component.registered_rows
            both = registered[np.isfinite(reference.map_T_cam[registered, 0, 0])]
            for session_id in np.unique(sessions[both]):
                compared = both[sessions[both] == session_id]
                rows.append(
                    {
                        "session_id": session_id,
                        "component": component.index,
                        "frames": int((sessions == session_id).sum()),
                        "compared_frames": len(compared),
                        "unit": LengthUnit.METRE if reference.is_metric else LengthUnit.UNKNOWN,
                        **_agreement(map_T_cam[compared], component.scale.is_known, reference, compared),
                    }
                )
    return pd.DataFrame(rows, columns=columns).sort_values(["session_id", "component"], ignore_index=True)


def describe_agreement(agreement: pd.DataFrame, ground_truth: pd.DataFrame) -> list[str]:
    """Lines for the user on what a reference gave the map, and how each session agrees with it."""
    lines = []
    if (ground_truth["scale_source"] == ScaleSource.REFERENCE_UNIT_UNKNOWN).any():
        lines.append(
            "warning: the reference poses have no stated unit: lengths in m are in their unit, and no frame is better "
            f"than class C; if it's the metre, set {setting_of('import', 'reference_is_metric = true')}"
        )
    if (ground_truth["vertical_source"] == VerticalSource.REFERENCE_UP_UNKNOWN).any():
        lines.append(
            "warning: the reference poses have no stated vertical: the map has their axes, and +y may point anywhere"
        )
    for row in agreement.to_dict("records"):
        name = f"{row['session_id']}, model {row['component']}"
        if row["fit"] == ReferenceAlignment.NONE:
            lines.append(f"{name}: too few reference poses to compare")
            continue
        unit = "m" if row["unit"] == LengthUnit.METRE else "the reference's unit"
        metres = [f"{row[f'position_{which}_m']:.4f}" for which in ("median", "rms", "max")]
        lines.append(
            f"{name}: {row['compared_frames']} reference poses, alignment {row['fit']}: position {metres[0]} median, "
            f"{metres[1]} RMS, {metres[2]} largest ({unit}); rotation {row['rotation_median_deg']:.3f}° median, "
            f"{row['rotation_max_deg']:.3f}° largest"
        )
        if row["rotation_median_deg"] > _NOTICEABLE_DEG:
            lines.append(
                f"warning: {name}: cameras are turned by {row['rotation_median_deg']:.2f}° (median) from their "
                "reference poses: the data set's intrinsics, above all its principal point, may be wrong"
            )
    return lines


def _agreement(map_T_cam: Array, is_scale_known: bool, reference: Reference, rows: np.ndarray) -> dict[str, object]:
    stated = reference.map_T_cam[rows]
    similarity = fit_if_any(stated, map_T_cam)
    if reference.gives_map:
        kind, (position, rotation) = ReferenceAlignment.MODEL_SIM3, pose_residuals(stated, map_T_cam, np.eye(4))
    elif similarity is None:
        kind, position, rotation = ReferenceAlignment.NONE, np.empty(0), np.empty(0)
    elif reference.is_metric and is_scale_known:
        rigid = fit_similar_poses(stated, map_T_cam, with_scale=False)
        kind, position, rotation = ReferenceAlignment.SE3, rigid.position, rigid.rotation
    else:
        kind, position, rotation = ReferenceAlignment.SIM3, similarity.position, similarity.rotation
    return {
        "fit": kind,
        "position_rms_m": float(np.sqrt(np.mean(position**2))) if len(position) else None,
        "position_median_m": float(np.median(position)) if len(position) else None,
        "position_max_m": float(position.max()) if len(position) else None,
        "rotation_median_deg": float(np.degrees(np.median(rotation))) if len(rotation) else None,
        "rotation_max_deg": float(np.degrees(rotation.max())) if len(rotation) else None,
        "scale": None if similarity is None else similarity.a_S_b.scale,
        "scale_sd": None if similarity is None else similarity.a_S_b.scale * similarity.scale_sd,
    }
