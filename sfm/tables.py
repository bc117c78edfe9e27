"""The stage's tables from its arrays."""

from collections.abc import Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.sfm.cameras.adjustment import LENS_UNKNOWNS, Adjusted, Cameras, Ints
from groundwalk.sfm.cameras.calibration import distortion_lists
from groundwalk.sfm.cameras.model_adjustment import EXACT_SD, CameraLog
from groundwalk.sfm.mapping.attempts import Attempt
from groundwalk.sfm.mapping.build import BuiltModel, selected_models
from groundwalk.sfm.mapping.source import HeldOutCheck
from groundwalk.sfm.model import Model
from groundwalk.sfm.pairs.matching import MatchedPairs
from groundwalk.sfm.quality.covariance import Covariances
from groundwalk.store.choices import NotRegistered
from groundwalk.store.schemas import schema
from groundwalk.store.tables import pose_frame

# Images determine the product of readout and angular velocity: the common error of VIO's, which filters smooth.
_RATE_SCALE_SD = 0.02


def images_table(
    frame_ids: Sequence[str],
    model: Model,
    selected: Sequence[BuiltModel],
    keypoints_N: NDArray[np.int64],
    check: HeldOutCheck,
    cameras: Cameras,
    covariance_N66: Array,
) -> pd.DataFrame:
    """One row a frame; `selected` are the models that `model` numbers, `covariance_N66` is NaN where there is none."""
    table = pd.DataFrame({"frame_id": frame_ids, "registered": model.registered})
    table["model_id"] = _model_ids(selected)[model.model]
    table = pd.concat([table, pose_frame("sfm_cam", model.sfm_T_cam)], axis=1)
    table[["fx", "fy"]] = cameras.focal
    table[["cx", "cy"]] = cameras.intrinsics[:, 2:]
    table["distortion"] = distortion_lists(cameras.coefficients[cameras.lens])
    table["readout_s"] = cameras.readout_s[cameras.lens]
    for name, of_frame in (("angular", cameras.angular), ("velocity", cameras.velocity)):
        table[[f"{name}_{axis}" for axis in "xyz"]] = of_frame
    table["keypoints"] = keypoints_N
    table["observations"] = model.observations()
    table["track_length"] = model.frame_track_length()
    table["triangulation_deg"] = np.degrees(model.frame_triangulation())
    table["reprojection_px"] = model.frame_error_px()
    table["held_out_matches"], table["held_out_px"] = check.by_frame(len(table), held_out=True)
    table["fitted_px"] = check.by_frame(len(table), held_out=False)[1]
    table["covariance"] = pd.Series(
        [list(row) if np.isfinite(row).all() else None for row in covariance_N66.reshape(-1, 36)], dtype=object
    )
    return table


def not_registered(registered_N: NDArray[np.bool_], built: Sequence[BuiltModel], matched: MatchedPairs) -> pd.Series:
    """Why frames (N,) have no pose, None where they have one."""
    reasons = np.full(len(registered_N), NotRegistered.NO_VERIFIED_PAIRS, object)
    reasons[np.unique(matched.pairs[matched.verified])] = NotRegistered.NOT_MAPPED
    reasons[[row for entry in built for row in entry.misplaced]] = NotRegistered.MISPLACED
    reasons[registered_N] = None
    return pd.Series(reasons, dtype=object)


def models_table(built: Sequence[BuiltModel], check: HeldOutCheck) -> pd.DataFrame:
    """One row a model."""
    number = {entry.model_id: index for index, entry in enumerate(selected_models(built))}
    return pd.DataFrame(
        [
            {
                "model_id": entry.model_id,
                "mapping": entry.mapping,
                "selected": bool(entry.folder),
                "folder": entry.folder or None,
                "images": entry.images,
                "points": entry.points,
                "observations": entry.observations,
                "mean_track_length": entry.mean_track_length,
                "mean_reprojection_px": entry.mean_reprojection_px,
                "held_out_matches": check.count(held_out=True, model=number.get(entry.model_id, -2)),
                "held_out_px": check.median_px(held_out=True, model=number.get(entry.model_id, -2)),
                "fitted_px": check.median_px(held_out=False, model=number.get(entry.model_id, -2)),
            }
            for entry in built
        ]
    )


def camera_tables(
    log: CameraLog,
    selected: Sequence[BuiltModel],
    parts: Sequence[tuple[Adjusted, Ints]],
    estimates: Sequence[Covariances | None],
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """sfm.lenses, one row a lens of a model, and sfm.intrinsics, one row a session of a model."""
    lens_rows, session_rows = [], []
    for one, (adjusted, rows), estimate in zip(selected, parts, estimates, strict=True):
        cameras = adjusted.cameras
        first_focal = LENS_UNKNOWNS * len(cameras.readout_s)
        unknowns = first_focal + len(cameras.log_focal)
        covariance = np.full((unknowns, unknowns), np.nan) if estimate is None else estimate.shared
        sd = _sds(covariance, adjusted.priors.log_focal_sd)
        for number, index in enumerate(np.unique(log.calibration.lens[rows])):
            lens = log.calibration.lenses[index]
            k = LENS_UNKNOWNS * number
            with_focal = covariance[k : k + 2, first_focal:] / np.outer(sd[k : k + 2], sd[first_focal:])
            lens_rows.append(
                {
                    "model_id": one.model_id,
                    "lens_id": lens.lens_id,
                    "frames": int(np.count_nonzero(cameras.lens == number)),
                    "k1": cameras.coefficients[number, 0],
                    "k1_sd": sd[k],
                    "k2": cameras.coefficients[number, 1],
                    "k2_sd": sd[k + 1],
                    "k3": cameras.coefficients[number, 4],
                    "k3_sd": sd[k + 2],
                    "k1_k2_correlation": covariance[k, k + 1] / (sd[k] * sd[k + 1]),
                    "k1_focal_correlation": with_focal[0].mean(),
                    "readout_s": cameras.readout_s[number],
                    "readout_sd_s": np.hypot(sd[k + 3], _RATE_SCALE_SD * cameras.readout_s[number]),
                    "time_offset_s": lens.stamp_offset_s,
                    "time_offset_sd_s": lens.stamp_offset_sd_s,
                    "time_offset_used": lens.time_offset_s != 0,
                    "stated_k1": lens.stated[0],
                    "stated_k2": lens.stated[1],
                    "origin": lens.origin,
                    "stated_is_wrong": lens.stated_is_wrong,
                    "stated_is_undecided": lens.stated_is_undecided,
                    "stated_readout_s": lens.stated_readout_s,
                    "stated_readout_is_wrong": lens.stated_readout_is_wrong,
                    "held_out_prior_px": lens.held_out_prior_px,
                    "held_out_px": lens.held_out_px,
                }
            )
        for number, session in enumerate(np.unique(log.session[rows])):
            session_rows.append(
                {
                    "model_id": one.model_id,
                    "session_id": session,
                    "frames": int(np.count_nonzero(cameras.session == number)),
                    "focal_scale": float(np.exp(cameras.log_focal[number])),
                    "focal_scale_sd": sd[first_focal + number],
                    "focus_sd": adjusted.priors.focus_sd[number],
                    "angular_sd": float(np.sqrt(np.mean(adjusted.priors.angular_sd[cameras.session == number] ** 2))),
                }
            )
    lenses = pd.DataFrame(lens_rows, columns=schema("sfm", "lenses").column_names)
    return lenses, pd.DataFrame(session_rows, columns=schema("sfm", "intrinsics").column_names)


def _sds(covariance: Array, prior_log_focal_sd_S: Array) -> Array:
    """Standard deviations of what cameras share, the sessions' focal factors last; NaN of those that settings hold, as
    they aren't confirmed by the images."""
    sd = np.sqrt(np.diag(covariance))
    sd[-len(prior_log_focal_sd_S) :][prior_log_focal_sd_S <= EXACT_SD] = np.nan
    return sd


def attempts_table(attempts: Sequence[Attempt], selected: int) -> pd.DataFrame:
    """One row an attempt; `selected` is the index of the one whose models are the stage's."""
    return pd.DataFrame(
        [
            {
                "attempt": attempt.name,
                "mapper": attempt.mapper,
                "pairs": attempt.pairs,
                "verified": attempt.verified,
                "models": len(attempt.model_frames),
                "largest": max(attempt.model_frames, default=0),
                "registered": attempt.registered,
                "consistent_fraction": attempt.consistent / attempt.registered if attempt.model_frames else None,
                "outcome": attempt.outcome,
                "selected": index == selected,
            }
            for index, attempt in enumerate(attempts)
        ]
    )


def pairs_table(frame_ids: Sequence[str], matched: MatchedPairs) -> pd.DataFrame:
    """One row a pair."""
    names = np.asarray(frame_ids, dtype=object)
    compared = matched.compared
    return pd.DataFrame(
        {
            "frame_id_a": names[matched.pairs[:, 0]],
            "frame_id_b": names[matched.pairs[:, 1]],
            "origin": matched.origin.astype(object),
            "matches": matched.matches,
            "inliers": matched.inliers,
            "status": matched.status,
            "reason": compared.reason,
            "rotation_deg": np.degrees(compared.rotation),
            "rotation_limit_deg": np.degrees(compared.rotation_limit),
            "direction_deg": np.degrees(compared.direction),
            "direction_limit_deg": np.degrees(compared.direction_limit),
            "gravity_deg": np.degrees(compared.gravity),
        }
    )


def points_table(model: Model, selected: Sequence[BuiltModel]) -> pd.DataFrame:
    """One row a point."""
    table = pd.DataFrame({"model_id": _model_ids(selected)[model.point_model], "point_id": model.point_ids})
    table[["x", "y", "z"]] = model.xyz
    table[["r", "g", "b"]] = model.rgb.astype(np.int64)
    table["track_length"] = model.track_lengths()
    table["reprojection_px"] = model.point_error_px()
    return table


def _model_ids(selected: Sequence[BuiltModel]) -> NDArray[np.object_]:
    """The id of each selected model by its number, and None for -1."""
    return np.array([*(entry.model_id for entry in selected), None], dtype=object)
