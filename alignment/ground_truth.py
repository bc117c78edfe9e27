"""From SfM's poses and the phones' VIO to ground truth: the whole computation, tables in, tables out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from groundwalk.alignment.checks import gate_table
from groundwalk.alignment.components import Placed, bridge_covariance
from groundwalk.alignment.drift import DriftSamples, drift_table, measure_drift
from groundwalk.alignment.examination import Examination, examine
from groundwalk.alignment.quality import judge, sfm_covariances
from groundwalk.alignment.reference import Reference, agreement_table
from groundwalk.alignment.rulers.measurement import Reading
from groundwalk.alignment.sessions import SessionFit, fit_session, residuals_table, sessions_table
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.sfm_tables import SfmTables
from groundwalk.alignment.uncertainty import (
    SharedSd,
    count_grades,
    covariance_in_map,
    largest_sd,
    shared_covariance,
)
from groundwalk.artefacts.tables import CAMERA_COLUMNS, dataset_frames, pose_frame, poses_of
from groundwalk.consistency.windows import PoseSd
from groundwalk.geometry.poses import Array


@dataclass(frozen=True)
class Aligned:
    """The stage's tables, and what the recording and the summary show: how many frames have which class for which
    reason, the placed models, the first giving the map its origin, map_T_cam (N, 4, 4) of all frames that are in one,
    with ground truth or not, and each session's fit. All of it is of the dataset's frames: support frames, by which the
    model was examined too, are in none of it."""

    ground_truth: pd.DataFrame
    sessions: pd.DataFrame
    drift: pd.DataFrame
    gate: pd.DataFrame
    residuals: pd.DataFrame
    reference_agreement: pd.DataFrame
    class_counts: list[str]
    placed: list[Placed]
    map_T_cam: Array
    fits: list[SessionFit]

    @property
    def main(self) -> Placed:
        """The largest model."""
        return self.placed[0]


def align(
    frames: pd.DataFrame,
    sfm: SfmTables,
    jumps: pd.DataFrame,
    recordings: dict[str, str],
    settings: AlignSettings,
    readings: Sequence[Reading] = (),
    reference: Reference | None = None,
) -> Aligned:
    """Build the map frame, check the model against VIO or reference poses, and give out ground truth.

    `frames` and `jumps` are import's tables; `recordings` names the recording of each session, `readings` what
    rulers say of SfM's models, `reference` the poses that a data set states. Raises UserError where the map can't be
    built, or where too much of the model fails the gate.
    """
    frames = frames.reset_index(drop=True)
    found = examine(frames, sfm, jumps, recordings, settings, readings, reference)
    if found.refusal:
        raise found.refusal
    return build(frames, sfm.images, found, settings)


def build(frames: pd.DataFrame, images: pd.DataFrame, found: Examination, settings: AlignSettings) -> Aligned:
    """Ground truth from what was examined; arguments as for `align`, `images` in the order of `frames`."""
    dataset = ~frames["support"].to_numpy(bool)
    found, images, frames = found.where(dataset), images[dataset].reset_index(drop=True), dataset_frames(frames)
    sd = PoseSd(settings.position_sd_m, float(np.radians(settings.rotation_sd_deg)))
    map_T_cam, component = np.full((len(frames), 4, 4), np.nan), np.full(len(frames), -1)
    sfm_T_cam = poses_of(images, "sfm_cam")
    for placed in found.placed:
        rows = _rows(placed)
        map_T_cam[rows], component[rows] = placed.map_S_sfm.poses(sfm_T_cam[rows]), placed.component.index
    # By session, for whoever reads the table; models of one session one after the other.
    order = sorted(
        ((s, p) for p in found.placed for s in p.component.segments),
        key=lambda item: (item[0].session_id, item[0].index, item[0].component),
    )
    fits = [
        fit_session(s, map_T_cam[s.rows], found.used[s.rows], sd, is_metric=p.component.scale.is_known)
        for s, p in order
    ]
    ground_truth, class_counts = _ground_truth(frames, images, map_T_cam, found, settings)
    return Aligned(
        ground_truth,
        sessions_table(fits, [p for _, p in order], settings.max_scale_sd),
        _drift(fits),
        gate_table(found.checks),
        residuals_table(fits, frames["frame_id"].to_numpy(str), found.worst_m, np.degrees(found.worst_rad)),
        agreement_table(frames, map_T_cam, component, found.reference),
        class_counts,
        found.placed,
        map_T_cam,
        fits,
    )


def camera_sd(frames: pd.DataFrame, settings: AlignSettings) -> float:
    """One sigma, in radians, of the turn that all cameras share."""
    return settings.common_px / float(frames["fx"].median())


def _rows(placed: Placed) -> np.ndarray:
    """Rows of the frames table that a placed model has a pose for."""
    return np.concatenate([s.rows[s.registered] for s in placed.component.segments])


def _ground_truth(
    frames: pd.DataFrame,
    images: pd.DataFrame,
    map_T_cam: Array,
    found: Examination,
    settings: AlignSettings,
) -> tuple[pd.DataFrame, list[str]]:
    """The align.ground_truth table, and how many frames have which class for which reason."""
    known = found.used
    map_T_cam = np.where(known[:, None, None], map_T_cam, np.nan)
    xyz = map_T_cam[:, :3, 3]
    count = len(frames)
    # `own` is what the classes go by: SfM's part, and what a model that VIO ties to the map may be off by in it.
    own, total = np.full((count, 6, 6), np.nan), np.full((count, 6, 6), np.nan)
    component, bridged = np.full(count, -1), np.zeros(count, dtype=bool)
    scale_source, vertical_source = np.full(count, None, dtype=object), np.full(count, None, dtype=object)
    sfm_covariance = sfm_covariances(images["covariance"])
    for placed in found.placed:
        rows = _rows(placed)
        rows = rows[known[rows]]
        if not len(rows):
            continue
        component[rows] = placed.component.index
        scale_source[rows] = placed.component.scale.source(settings.max_scale_sd)
        vertical_source[rows] = placed.component.vertical.source
        own[rows] = covariance_in_map(sfm_covariance[rows], placed.map_S_sfm)
        anchor = xyz[rows].mean(axis=0)
        if placed.bridge is not None:
            bridged[rows] = True
            own[rows] += bridge_covariance(xyz[rows], placed.bridge)
            anchor = placed.bridge.anchor
        # Where the unit is SfM's, nothing is off in it.
        scale_sd = placed.component.scale.sd if np.isfinite(placed.component.scale.sd) else 0.0
        shared = SharedSd(scale_sd, placed.component.vertical.sd, camera_sd(frames, settings))
        total[rows] = own[rows] + shared_covariance(map_T_cam[rows], anchor, shared)
    sd_m, sd_rad = largest_sd(own)
    grades = judge(frames, images, own, found.problem, settings)
    table = frames[["frame_id", "session_id", "split", "t_ns"]].copy()
    table["component"] = pd.Series(component, index=table.index).where(known).astype("Int64")
    stated = [c.ravel().tolist() if np.isfinite(c).all() else None for c in total]
    table["covariance"] = pd.Series(stated, index=table.index, dtype=object)
    table["position_sd_m"] = sd_m
    table["rotation_sd_deg"] = np.degrees(sd_rad)
    table["quality"] = np.where(known, [g.quality for g in grades], "none")
    table["reason"] = np.where(known, [g.reason for g in grades], found.reason)
    table["scale_source"] = scale_source
    table["vertical_source"] = vertical_source
    # Later stages need the cameras that go with these poses, and read no table of SfM.
    table[[*CAMERA_COLUMNS, "camera_origin"]] = images[[*CAMERA_COLUMNS, "camera_origin"]]
    table["gt_uses_vio"] = images["uses_vio"].to_numpy(bool) | bridged
    return pd.concat([table, pose_frame("map_cam", map_T_cam)], axis=1), count_grades(
        [grades[row] for row in np.flatnonzero(known)]
    )


def _drift(fits: list[SessionFit]) -> pd.DataFrame:
    by_session: dict[str, DriftSamples] = {}
    for fit in fits:
        s, kept = fit.segment, fit.compared
        found = measure_drift(s.t_ns[kept], fit.map_T_cam[kept], s.vio_T_cam[kept])
        by_session.setdefault(s.session_id, DriftSamples()).extend(found)
    return drift_table(by_session)
