"""Ground truth of the dataset's frames, and the stage's other tables, from the models that were placed and checked."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd

from groundwalk.alignment.checks.summary import checks_table
from groundwalk.alignment.components import PlacedComponent
from groundwalk.alignment.drift import DriftSamples, drift_table, measure_drift
from groundwalk.alignment.examination import Examination
from groundwalk.alignment.quality import count_grades, grade_frames, sfm_covariances
from groundwalk.alignment.reference.agreement import agreement_table
from groundwalk.alignment.sessions import SessionFit, fit_session, residuals_table, sessions_table
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.uncertainty import SharedSd, covariance_in_map, largest_sd, shared_covariance
from groundwalk.alignment.vio_links import link_covariance
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import QualityClass
from groundwalk.store.tables import CAMERA_COLUMNS, dataset_frames, pose_frame, poses_of


@dataclass(frozen=True, kw_only=True)
class AlignResult:
    """The stage's tables, and what the recording and the summary show: how many frames have which class for which
    reason, the placed models, the first giving the map its origin, map_T_cam (N, 4, 4) of all frames that are in one,
    with ground truth or not, and each session's fit. All of it is of the dataset's frames, without support frames."""

    ground_truth: pd.DataFrame
    sessions: pd.DataFrame
    drift: pd.DataFrame
    checks: pd.DataFrame
    residuals: pd.DataFrame
    reference_agreement: pd.DataFrame
    class_counts: list[str]
    placed: list[PlacedComponent]
    map_T_cam: Array
    fits: list[SessionFit]

    @property
    def main(self) -> PlacedComponent:
        """The largest model."""
        return self.placed[0]


def build(frames: pd.DataFrame, images: pd.DataFrame, examination: Examination, settings: AlignSettings) -> AlignResult:
    """Ground truth by what was examined; `frames` is import's table, `images` SfM's in its order."""
    dataset = ~frames["support"].to_numpy(bool)
    examination, frames = examination.where(dataset), dataset_frames(frames)
    images = images[dataset].reset_index(drop=True)
    map_T_cam = np.full((len(frames), 4, 4), np.nan)
    sfm_T_cam = poses_of(images, "sfm_cam")
    for placed in examination.placed:
        rows = placed.component.registered_rows
        map_T_cam[rows] = placed.map_S_sfm.poses(sfm_T_cam[rows])
    # By session, for whoever reads the table; models of one session one after the other.
    segments = sorted(
        ((s, p) for p in examination.placed for s in p.component.segments),
        key=lambda item: (item[0].session_id, item[0].index, item[0].component),
    )
    sd, has_ground_truth = settings.fit_sd, examination.has_ground_truth
    fits = [
        fit_session(
            s,
            map_T_cam[s.rows],
            has_ground_truth[s.rows],
            sd,
            is_metric=p.component.scale.is_known,
            is_upright=examination.placed[0].component.vertical.source.is_known,
        )
        for s, p in segments
    ]
    residuals = examination.residual_m, np.degrees(examination.residual_rad)
    ground_truth, class_counts = _ground_truth(frames, images, map_T_cam, examination, settings)
    return AlignResult(
        ground_truth=ground_truth,
        sessions=sessions_table(fits, [p for _, p in segments], settings.max_scale_sd),
        drift=_drift(fits),
        checks=checks_table(examination.checks),
        residuals=residuals_table(fits, frames["frame_id"].to_numpy(str), *residuals),
        reference_agreement=agreement_table(frames, map_T_cam, examination.placed, examination.reference),
        class_counts=class_counts,
        placed=examination.placed,
        map_T_cam=map_T_cam,
        fits=fits,
    )


def camera_sd(frames: pd.DataFrame, settings: AlignSettings) -> float:
    """Standard error, in radians, of the turn that all cameras share."""
    return settings.common_keypoint_sd_px / float(frames["fx"].median())


class _FrameTruth(NamedTuple):
    """By frame (N,): the model that a pose is from, -1 without ground truth; covariances (N, 6, 6), NaN where unknown,
    of the model alone (SfM's, and the link's to the map) and in all; what its scale and vertical are by; by a VIO
    link."""

    component: np.ndarray
    model_covariance: Array
    covariance: Array
    scale_source: np.ndarray
    vertical_source: np.ndarray
    is_linked: np.ndarray


def _frame_truth(
    frames: pd.DataFrame, images: pd.DataFrame, map_T_cam: Array, examination: Examination, settings: AlignSettings
) -> _FrameTruth:
    count, has_ground_truth = len(frames), examination.has_ground_truth
    truth = _FrameTruth(
        np.full(count, -1),
        np.full((count, 6, 6), np.nan),
        np.full((count, 6, 6), np.nan),
        np.full(count, None, dtype=object),
        np.full(count, None, dtype=object),
        np.zeros(count, dtype=bool),
    )
    sfm_covariance = sfm_covariances(images["covariance"])
    for placed in examination.placed:
        component, rows = placed.component, placed.component.registered_rows
        rows = rows[has_ground_truth[rows]]
        if not len(rows):
            continue
        truth.component[rows] = component.index
        truth.scale_source[rows] = component.scale.source(settings.max_scale_sd)
        truth.vertical_source[rows] = examination.placed[0].component.vertical.source
        covariance, xyz = covariance_in_map(sfm_covariance[rows], placed.map_S_sfm), map_T_cam[rows, :3, 3]
        anchor = xyz.mean(axis=0)
        if placed.link is not None:
            truth.is_linked[rows] = True
            covariance = covariance + link_covariance(xyz, placed.links)
            anchor = placed.link.anchor
        # Where the unit is SfM's, it has no error, and where up is unknown, the axes have none.
        scale_sd, tilt_sd = np.nan_to_num([component.scale.sd, component.vertical.sd]).tolist()
        shared = SharedSd(scale_sd, tilt_sd, camera_sd(frames, settings))
        truth.model_covariance[rows] = covariance
        truth.covariance[rows] = covariance + shared_covariance(map_T_cam[rows], anchor, shared)
    return truth


def _ground_truth(
    frames: pd.DataFrame, images: pd.DataFrame, map_T_cam: Array, examination: Examination, settings: AlignSettings
) -> tuple[pd.DataFrame, list[str]]:
    """The align.ground_truth table, and how many frames have which class for which reason."""
    has_ground_truth = examination.has_ground_truth
    map_T_cam = np.where(has_ground_truth[:, None, None], map_T_cam, np.nan)
    truth = _frame_truth(frames, images, map_T_cam, examination, settings)
    sd_m, sd_rad = largest_sd(truth.model_covariance)
    grades = grade_frames(frames, images, truth.model_covariance, examination.problem, settings)
    table = frames[["frame_id", "session_id", "split", "t_ns"]].copy()
    table["component"] = pd.Series(truth.component, index=table.index).where(has_ground_truth).astype("Int64")
    covariances = [c.ravel().tolist() if np.isfinite(c).all() else None for c in truth.covariance]
    table["covariance"] = pd.Series(covariances, index=table.index, dtype=object)
    table["position_sd_m"] = sd_m
    table["rotation_sd_deg"] = np.degrees(sd_rad)
    table["quality"] = np.where(has_ground_truth, [g.quality for g in grades], QualityClass.NONE)
    table["reason"] = np.where(has_ground_truth, [g.reason for g in grades], examination.exclusion)
    table["scale_source"] = truth.scale_source
    table["vertical_source"] = truth.vertical_source
    # Later stages need the cameras that go with these poses, and read no table of SfM.
    table[[*CAMERA_COLUMNS, "camera_origin"]] = images[[*CAMERA_COLUMNS, "camera_origin"]]
    table["gt_uses_vio"] = images["uses_vio"].to_numpy(bool) | truth.is_linked
    table = pd.concat([table, pose_frame("map_cam", map_T_cam)], axis=1)
    return table, count_grades([grades[row] for row in np.flatnonzero(has_ground_truth)])


def _drift(fits: list[SessionFit]) -> pd.DataFrame:
    by_session: dict[str, DriftSamples] = {}
    for fit in fits:
        s, rows = fit.segment, fit.compared
        samples = measure_drift(s.t_ns[rows], fit.map_T_cam[rows], s.vio_T_cam[rows], is_upright=fit.is_upright)
        by_session.setdefault(s.session_id, DriftSamples()).extend(samples)
    return drift_table(by_session)
