"""Poses that a data set states instead of VIO: the map in their frame, and how SfM's model agrees with them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from groundwalk.alignment.checks import REFERENCE, About, Check, check
from groundwalk.alignment.components import Component, Model, Placed
from groundwalk.alignment.map_frame import (
    BY_REFERENCE,
    BY_REFERENCE_UNIT_UNKNOWN,
    BY_REFERENCE_UP_UNKNOWN,
    NO_SCALE,
    MapScale,
    Vertical,
)
from groundwalk.alignment.settings import AlignSettings
from groundwalk.artefacts.schemas import schema
from groundwalk.artefacts.tables import poses_of
from groundwalk.consistency.decisions import Status
from groundwalk.geometry import GeometryError
from groundwalk.geometry.fits import pose_residuals
from groundwalk.geometry.pose_similarity import PoseSimilarity, fit_similar_poses
from groundwalk.geometry.poses import Array

# Real references, by depth or other SfM, agree with SfM's rotations to some tenths of a degree.
_NOTICEABLE_DEG = 0.5
_REASON = "SfM and the reference poses disagree here"


@dataclass(frozen=True)
class Reference:
    """Stated poses map_T_cam (N, 4, 4) of the rows of the frames table, NaN where there is none; whether their unit is
    the metre, and whether their +y is up. `gives_map`: no frame has VIO, so that the map is the reference's frame."""

    map_T_cam: Array
    metric: bool
    up_known: bool
    gives_map: bool

    @staticmethod
    def of(frames: pd.DataFrame, reference: pd.DataFrame, sessions: pd.DataFrame) -> "Reference | None":
        """From import's tables; None where no frame has a reference pose."""
        stated = reference.set_index("frame_id").reindex(frames["frame_id"])
        map_T_cam = poses_of(stated, "map_cam")
        known = np.isfinite(map_T_cam[:, 0, 0])
        if not known.any():
            return None
        own = sessions[sessions["session_id"].isin(set(frames["session_id"][known]))]
        return Reference(
            map_T_cam,
            metric=bool((own["reference_unit"] == "m").all()),
            up_known=bool((own["up"] == "+y").all()),
            gives_map=bool(frames["vio_cam_tx"].isna().all()),
        )

    def where(self, wanted: np.ndarray) -> "Reference":
        """The rows for which `wanted` (N,) holds."""
        return replace(self, map_T_cam=self.map_T_cam[wanted])

    @property
    def scale_source(self) -> str:
        """What gives a map in this reference's frame its scale."""
        return BY_REFERENCE if self.metric else BY_REFERENCE_UNIT_UNKNOWN

    @property
    def vertical_source(self) -> str:
        """What gives a map in this reference's frame its vertical."""
        return BY_REFERENCE if self.up_known else BY_REFERENCE_UP_UNKNOWN

    @property
    def unit(self) -> str:
        return "m" if self.metric else "unknown"

    def limit(self, settings: AlignSettings) -> float:
        """How far a frame may be from its reference pose, in the reference's unit."""
        xyz = self.map_T_cam[np.isfinite(self.map_T_cam[:, 0, 0]), :3, 3]
        extent = float(np.linalg.norm(xyz.max(axis=0) - xyz.min(axis=0)))
        return settings.reference_limit_share * extent + (settings.reference_limit_m if self.metric else 0.0)


@dataclass(frozen=True)
class ReferenceFit:
    """One SfM model put onto the reference: `rows` (n,) of the frames table that were compared, what is left there in
    the reference's unit and radians, and which of them are beyond a limit (n,)."""

    placed: Placed
    fit: PoseSimilarity
    rows: np.ndarray
    wrong: np.ndarray


def fit_component(index: int, model: Model, reference: Reference, settings: AlignSettings) -> ReferenceFit:
    """Fit a model to the reference by a robust similarity; GeometryError where its poses don't determine one."""
    rows = np.concatenate([s.rows for s in model.segments])
    sfm_T_cam = np.concatenate([s.sfm_T_cam for s in model.segments])
    known = np.isfinite(sfm_T_cam[:, 0, 0]) & np.isfinite(reference.map_T_cam[rows, 0, 0])
    fit = fit_similar_poses(reference.map_T_cam[rows[known]], sfm_T_cam[known])
    scale = MapScale(float(np.log(fit.a_S_b.scale)), fit.scale_sd, {}, {}, reference=reference.scale_source)
    vertical = Vertical(fit.a_S_b.rotation[1], fit.turn_sd, {}, reference.vertical_source)
    component = Component(index, model.name, model.segments, model.pieces, scale, vertical, vio_scale=NO_SCALE)
    limit_rad = float(np.radians(settings.reference_limit_deg))
    wrong = (fit.position > reference.limit(settings)) | (fit.rotation > limit_rad)
    return ReferenceFit(Placed(component, fit.a_S_b), fit, rows[known], wrong)


def check_session_references(fit: ReferenceFit, settings: AlignSettings) -> list[Check]:
    """Check that each session's frames lie where the reference has them. Those that don't get no ground truth; of a
    session none does, where too many don't. The share is a count: it has no standard error."""
    checks = []
    component = fit.placed.component
    for session_id in dict.fromkeys(s.session_id for s in component.segments):
        rows = np.concatenate([s.rows[s.registered] for s in component.segments if s.session_id == session_id])
        own = np.isin(fit.rows, rows)
        compared, away = int(own.sum()), fit.rows[own & fit.wrong]
        if not compared:
            continue
        position, degrees = fit.fit.position[own], np.degrees(fit.fit.rotation[own])
        result = check(
            "session_reference",
            len(away) / compared,
            None,
            1 - settings.least_agreeing,
            About(compared, session_id, component.index),
            REFERENCE,
            f"{len(away)} of {compared} frames of {session_id} are away from their reference poses, by "
            f"{np.median(position):.3g} and {np.median(degrees):.1f} degrees "
            "(medians): the reference, its intrinsics or SfM's model is wrong, or its world is another one",
            rows=rows,
        )
        if result.status is Status.PASSED:
            result = replace(result, refused=away, frame_reason=_REASON)
        checks.append(result)
    return checks


def agreement_table(
    frames: pd.DataFrame, map_T_cam: Array, component: np.ndarray, reference: Reference | None
) -> pd.DataFrame:
    """The align.reference_agreement table: poses map_T_cam (N, 4, 4) of all frames that SfM placed, in the models
    `component` (N,), against the reference.

    Where the reference gives the map, both are in one frame: what is left is compared as it is, and `scale` is of a fit
    of the session's own. Where VIO gives it, each session's reference is fitted to the map first: rigidly if it's
    metric, so that a wrong scale shows.
    """
    columns = schema("align", "reference_agreement").column_names
    rows: list[dict[str, object]] = []
    if reference is not None:
        both = np.isfinite(map_T_cam[:, 0, 0]) & np.isfinite(reference.map_T_cam[:, 0, 0])
        sessions = frames["session_id"].to_numpy(str)
        keys: Sequence[tuple[str, int]] = sorted(set(zip(sessions[both], component[both].tolist(), strict=True)))
        for session_id, of in keys:
            own = np.flatnonzero(both & (sessions == session_id) & (component == of))
            rows.append(
                {
                    "session_id": session_id,
                    "component": of,
                    "frames": int((sessions == session_id).sum()),
                    "compared": len(own),
                    "unit": reference.unit,
                    **_agreement(map_T_cam[own], reference, own),
                }
            )
    return pd.DataFrame(rows, columns=columns)


def describe_agreement(agreement: pd.DataFrame, ground_truth: pd.DataFrame) -> list[str]:
    """Lines for the user on what a reference gave the map, and how each session agrees with it."""
    lines = []
    if (ground_truth["scale_source"] == BY_REFERENCE_UNIT_UNKNOWN).any():
        lines.append(
            "warning: the reference states no unit: lengths in m are in its unit, and no frame is better than class C "
            "(import.reference_is_metric = true says that it's in metres)"
        )
    if (ground_truth["vertical_source"] == BY_REFERENCE_UP_UNKNOWN).any():
        lines.append("the reference doesn't say where up is: the map has its axes, and +y may point anywhere")
    for row in agreement.to_dict("records"):
        name = f"{row['session_id']}, model {row['component']}"
        if row["fit"] == "none":
            lines.append(f"{name}: too few reference poses to compare")
            continue
        unit = "m" if row["unit"] == "m" else "the reference's unit"
        lines.append(
            f"{name}: {row['compared']} reference poses after {row['fit']}: position {row['position_median_m']:.4f} "
            f"median, {row['position_rms_m']:.4f} RMS, {row['position_max_m']:.4f} largest ({unit}); rotation "
            f"{row['rotation_median_deg']:.3f}° median, {row['rotation_max_deg']:.3f}° largest"
        )
        if row["rotation_median_deg"] > _NOTICEABLE_DEG:
            lines.append(
                f"warning: {name}: cameras are turned by {row['rotation_median_deg']:.2f}° (median) from their "
                "reference poses: the data set's intrinsics, above all its principal point, may be wrong"
            )
    return lines


def _agreement(map_T_cam: Array, reference: Reference, rows: np.ndarray) -> dict[str, object]:
    stated = reference.map_T_cam[rows]
    try:
        own: PoseSimilarity | None = fit_similar_poses(stated, map_T_cam)
    except GeometryError:
        own = None
    if reference.gives_map:
        kind, (position, rotation) = "sim3 of the model", pose_residuals(stated, map_T_cam, np.eye(4))
    elif own is None:
        kind, position, rotation = "none", np.empty(0), np.empty(0)
    else:
        fit = fit_similar_poses(stated, map_T_cam, with_scale=False) if reference.metric else own
        kind, position, rotation = "se3" if reference.metric else "sim3", fit.position, fit.rotation
    return {
        "fit": kind,
        "position_rms_m": float(np.sqrt(np.mean(position**2))) if len(position) else None,
        "position_median_m": float(np.median(position)) if len(position) else None,
        "position_max_m": float(position.max()) if len(position) else None,
        "rotation_median_deg": float(np.degrees(np.median(rotation))) if len(rotation) else None,
        "rotation_max_deg": float(np.degrees(rotation.max())) if len(rotation) else None,
        "scale": None if own is None else own.a_S_b.scale,
        "scale_sd": None if own is None else own.a_S_b.scale * own.scale_sd,
    }
