"""Ground truth of the dataset's frames, and the stage's other tables, from the models as placed and checked."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd

from groundwalk.alignment.check_models import CheckedMap, FrameVerdicts
from groundwalk.alignment.checks.results import checks_table
from groundwalk.alignment.components import PlacedComponent
from groundwalk.alignment.drift import DriftSamples, drift_table, measure_drift
from groundwalk.alignment.quality import Grade, count_grades, grade_frames
from groundwalk.alignment.reference.agreement import agreement_table
from groundwalk.alignment.reference.poses import Reference
from groundwalk.alignment.sessions import SessionFit, fit_session, residuals_table, sessions_table
from groundwalk.alignment.sfm_tables import covariances
from groundwalk.alignment.uncertainty import SharedSd, covariance_in_map, largest_sd, shared_covariance
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import QualityClass
from groundwalk.store.tables import CAMERA_COLUMNS, dataset_frames, pose_frame, poses_of

# Error (sd) that all keypoints have in common, pixels an image axis: it turns all cameras alike.
_COMMON_KEYPOINT_SD_PX = 0.05


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


def build(frames: pd.DataFrame, images: pd.DataFrame, checked: CheckedMap, reference: Reference | None) -> AlignResult:
    """Ground truth and how VIO and a reference agree with it; `frames` is import's table, `images` SfM's in its
    order."""
    dataset = ~frames["support"].to_numpy(bool)
    checked, frames = checked.where(dataset), dataset_frames(frames)
    images = images[dataset].reset_index(drop=True)
    reference = None if reference is None else reference.where(dataset)
    placed, verdicts = checked.placed, checked.frames
    map_T_cam = poses_in_map(images, placed)
    ground_truth, grades = ground_truth_table(frames, images, map_T_cam, placed, verdicts)
    fits, is_upright = list[SessionFit](), placed[0].component.vertical.source.is_known
    for component in (each.component for each in placed):
        for s in component.segments:
            of_map, usable = map_T_cam[s.rows], verdicts.has_ground_truth[s.rows]
            fits.append(fit_session(s, of_map, usable, is_metric=component.scale.is_known, is_upright=is_upright))
    # By session, for whoever reads the tables; models of one session one after the other.
    fits.sort(key=lambda fit: (fit.segment.session_id, fit.segment.index, fit.segment.component))
    drift: dict[str, list[DriftSamples]] = {}
    for fit in fits:
        s, rows = fit.segment, fit.compared
        drift.setdefault(s.session_id, []).extend(
            measure_drift(s.t_ns[rows], fit.map_T_cam[rows], s.vio_T_cam[rows], is_upright=fit.is_upright)
        )
    frame_id = frames["frame_id"].to_numpy(str)
    return AlignResult(
        ground_truth=ground_truth,
        sessions=sessions_table(fits, placed),
        drift=drift_table(drift),
        checks=checks_table(checked.checks),
        residuals=residuals_table(fits, frame_id, verdicts.residual_m, np.degrees(verdicts.residual_rad)),
        reference_agreement=agreement_table(frames, map_T_cam, placed, reference),
        class_counts=count_grades(grades),
        placed=placed,
        map_T_cam=map_T_cam,
        fits=fits,
    )


def poses_in_map(images: pd.DataFrame, placed: Sequence[PlacedComponent]) -> Array:
    """map_T_cam (N, 4, 4) of SfM's images that are in a placed model, with ground truth or not; else NaN."""
    map_T_cam, sfm_T_cam = np.full((len(images), 4, 4), np.nan), poses_of(images, "sfm_cam")
    for each in placed:
        rows = each.component.registered_rows
        map_T_cam[rows] = each.map_S_sfm.poses(sfm_T_cam[rows])
    return map_T_cam


def camera_sd(frames: pd.DataFrame) -> float:
    """Standard error, in radians, of the turn that all cameras share."""
    return _COMMON_KEYPOINT_SD_PX / float(frames["fx"].median())


def ground_truth_table(
    frames: pd.DataFrame, images: pd.DataFrame, map_T_cam: Array, placed: list[PlacedComponent], verdicts: FrameVerdicts
) -> tuple[pd.DataFrame, list[Grade]]:
    """The align.ground_truth table of import's frames, and the classes of those that have ground truth; `images` are
    SfM's in the same order, `map_T_cam` (N, 4, 4) their poses."""
    has_truth, sfm_covariance = verdicts.has_ground_truth, covariances(images["covariance"])
    component = np.full(len(frames), -1)
    scale_source, vertical_source = np.full((2, len(frames)), None, dtype=object)
    is_linked = np.zeros(len(frames), dtype=bool)
    # Of the model alone, SfM's and the link's to the map, by which frames are graded; and in all.
    of_model, whole = np.full((2, len(frames), 6, 6), np.nan)
    for each in placed:
        rows = each.component.registered_rows
        rows = rows[has_truth[rows]]
        if not len(rows):
            continue
        component[rows], scale_source[rows] = each.component.index, each.component.scale.source
        vertical_source[rows] = placed[0].component.vertical.source
        xyz = map_T_cam[rows, :3, 3]
        of_model[rows], anchor = covariance_in_map(sfm_covariance[rows], each.map_S_sfm), xyz.mean(axis=0)
        if each.link is not None:
            is_linked[rows] = True
            of_model[rows] += sum(link.covariance(xyz) for link in each.links)
            anchor = each.link.anchor
        # Where the unit is SfM's, it has no error, and where up is unknown, the axes have none.
        scale_sd, tilt_sd = np.nan_to_num([each.component.scale.sd, each.component.vertical.sd]).tolist()
        if each.link is not None and not each.component.vertical.source.is_known:
            # Upright as the map and VIO on the way are.
            map_sd = placed[0].component.vertical.sd
            tilt_sd = float(np.linalg.norm([np.nan_to_num(map_sd), *(link.heading_sd for link in each.links)]))
        shared = SharedSd(scale_sd, tilt_sd, camera_sd(frames))
        whole[rows] = of_model[rows] + shared_covariance(map_T_cam[rows], anchor, shared)
    sd_m, sd_rad = largest_sd(of_model)
    grades = grade_frames(frames, images, of_model, verdicts.problem)
    table = frames[["frame_id", "session_id", "split", "t_ns"]].copy()
    table["component"] = pd.Series(component, index=table.index).where(has_truth).astype("Int64")
    finite = [c.ravel().tolist() if np.isfinite(c).all() else None for c in whole]
    table["covariance"] = pd.Series(finite, index=table.index, dtype=object)
    table["position_sd_m"], table["rotation_sd_deg"] = sd_m, np.degrees(sd_rad)
    table["quality"] = np.where(has_truth, [g.quality for g in grades], QualityClass.NONE)
    table["reason"] = np.where(has_truth, [g.reason for g in grades], verdicts.exclusion)
    table["scale_source"] = scale_source
    table["vertical_source"] = vertical_source
    # Later stages need the cameras that go with these poses, and read no table of SfM.
    table[[*CAMERA_COLUMNS, "camera_origin"]] = images[[*CAMERA_COLUMNS, "camera_origin"]]
    table["gt_uses_vio"] = is_linked
    poses = pose_frame("map_cam", np.where(has_truth[:, None, None], map_T_cam, np.nan))
    return pd.concat([table, poses], axis=1), [grades[row] for row in np.flatnonzero(has_truth)]
