"""Each frame's quality class, and what VIO has to say about the frames that SfM isn't sure of."""

from dataclasses import replace

import numpy as np
import pandas as pd

from groundwalk.alignment.checks import DISAGREES, About, Check, check
from groundwalk.alignment.components import Component
from groundwalk.alignment.segments import Segment
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.uncertainty import Grade, Measures, covariance_in_map, grade, largest_sd
from groundwalk.geometry.fits import Sim3
from groundwalk.geometry.poses import Array, relative


def judge(
    frames: pd.DataFrame, images: pd.DataFrame, own: Array, problem: np.ndarray, settings: AlignSettings
) -> list[Grade]:
    """Classes of frames (import's table, and SfM's in its order) by their own covariances (N, 6, 6) in metres, and why;
    `problem` (N,): what makes a frame C, empty where nothing does."""
    sd_m, sd_rad = largest_sd(own)
    observations = images["observations"].to_numpy(float, na_value=0.0)
    # Pixels mean different angles at different image sizes.
    reprojection_deg = np.degrees(
        np.arctan2(images["reprojection_px"].to_numpy(float, na_value=np.nan), frames["fx"].to_numpy(float))
    )
    limits = settings.quality_a.limits(), settings.quality_b.limits()
    columns = (a.tolist() for a in (sd_m, np.degrees(sd_rad), observations, reprojection_deg))
    measured = (Measures(*row) for row in zip(*columns, strict=True))
    return [Grade("C", why) if why else grade(m, *limits) for m, why in zip(measured, problem, strict=True)]


def check_unsure(
    components: list[Component],
    frames: pd.DataFrame,
    images: pd.DataFrame,
    used: np.ndarray,
    problem: np.ndarray,
    settings: AlignSettings,
) -> list[Check]:
    """Each session's frames that SfM is uncertain of, against VIO; `used` (N,): frames that have ground truth so far,
    `problem` as for `judge`.

    A frame of class A or B stands on its own: its 95 % bounds of 0.3 degrees are 7 cm at the end of 5 m, and VIO
    strays as far. One of class C needs VIO's word: it must move as VIO does, more closely than drift is allowed for
    elsewhere; where most of a session's don't, none of them is believed. That they have no ground truth is a fault of
    the session where it costs it too many frames. The share is a count: it has no standard error."""
    covariance, checks = sfm_covariances(images["covariance"]), []
    for component in (c for c in components if c.scale.is_known):
        own = covariance_in_map(covariance, component.metric_S_sfm)
        sure = np.array([g.quality != "C" for g in judge(frames, images, own, problem, settings)])
        for session_id in dict.fromkeys(s.session_id for s in component.segments):
            of_session = [s for s in component.segments if s.session_id == session_id]
            wrong, unsure = _contradicted(of_session, component.metric_S_sfm, sure, used, settings)
            if not len(unsure):
                continue
            lost = wrong if len(wrong) <= len(unsure) / 2 else unsure
            registered = sum(int(s.registered.sum()) for s in of_session)
            result = check(
                "session_unsure",
                len(lost) / registered,
                None,
                1 - settings.least_agreeing,
                About(registered, session_id, component.index),
                DISAGREES,
                f"of {len(unsure)} frames that SfM isn't sure of {len(wrong)} move otherwise than VIO",
            )
            reason = f"SfM isn't sure here, and VIO moves otherwise by more than {settings.unsure_share:.1%}"
            checks.append(replace(result, refused=lost, frame_reason=reason))
    return checks


def _contradicted(
    segments: list[Segment], metric_S_sfm: Sim3, sure: np.ndarray, used: np.ndarray, settings: AlignSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the frames that SfM isn't sure of: those that VIO contradicts, and all."""
    wrong, unsure = [np.empty(0, np.intp)], [np.empty(0, np.intp)]
    for segment in segments:
        part = segment.where(segment.both & used[segment.rows])
        if len(part.rows) < 2:
            continue
        out = contradicted(part, metric_S_sfm, sure[part.rows], settings.unsure_step_m, settings.unsure_share)
        wrong.append(part.rows[out])
        unsure.append(part.rows[~sure[part.rows]])
    return np.concatenate(wrong), np.concatenate(unsure)


def sfm_covariances(column: pd.Series) -> Array:
    """A column of 36 doubles or null as (N, 6, 6), NaN where null."""
    covariance = np.full((len(column), 6, 6), np.nan)
    for row, values in enumerate(column):
        if values is not None and len(values) == 36:
            covariance[row] = np.asarray(values, dtype=float).reshape(6, 6)
    return covariance


def contradicted(segment: Segment, metric_S_sfm: Sim3, sure: np.ndarray, step_m: float, share: float) -> np.ndarray:
    """Which frames (N,) of a segment SfM isn't `sure` (N,) of and VIO contradicts: over `step_m` to three times that
    of the path their relative positions differ by more than `share` of it.

    Frames are taken out worst first, until no step with an unsure frame is contradicted.
    """
    known = np.flatnonzero(segment.both)
    along = segment.where(segment.both).travelled_m
    first, last = np.nonzero((along[None] - along[:, None] >= step_m) & (along[None] - along[:, None] <= 3 * step_m))
    unsure = ~sure[known]
    told = unsure[first] | unsure[last]
    first, last = first[told], last[told]
    sfm, vio = metric_S_sfm.poses(segment.sfm_T_cam[known]), segment.vio_T_cam[known]
    apart = relative(sfm[first], sfm[last])[:, :3, 3] - relative(vio[first], vio[last])[:, :3, 3]
    excess = np.linalg.norm(apart, axis=1) / (share * (along[last] - along[first]))
    bad = excess > 1
    out = np.zeros(len(known), dtype=bool)
    while bad.any():
        blame = np.bincount(first[bad], excess[bad], len(known)) + np.bincount(last[bad], excess[bad], len(known))
        worst = int(np.argmax(np.where(unsure, blame, 0.0)))
        out[worst] = True
        bad &= (first != worst) & (last != worst)
    result = np.zeros(len(segment.rows), dtype=bool)
    result[known[out]] = True
    return result
