"""The stage's tables from its arrays."""

from collections.abc import Sequence
from dataclasses import asdict

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.sfm.cameras.adjustment import CENTRE, LENS_UNKNOWNS, RADIAL, READOUT, Adjusted, Cameras, Ints
from groundwalk.sfm.cameras.lenses import distortion_lists
from groundwalk.sfm.cameras.model_adjustment import EXACT_SD, CameraLog
from groundwalk.sfm.database import keypoint_counts
from groundwalk.sfm.mapping.attempts import Attempt
from groundwalk.sfm.mapping.held_out import held_out_medians
from groundwalk.sfm.model import BuiltModel, Model, selected_models
from groundwalk.sfm.pairs.matched import are_verified, rows_of, status_of
from groundwalk.sfm.quality.covariance import Covariances
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store.choices import CameraOrigin, NotRegistered
from groundwalk.store.schemas import schema
from groundwalk.store.tables import pose_frame

# Images determine the product of readout and angular velocity: the common error of VIO's, which filters smooth.
_RATE_SCALE_SD = 0.02
_NOT_IN_TABLE = ["number", "misplaced", "stated"]


def images_table(
    frame_ids: Sequence[str],
    best: Attempt,
    origins: Sequence[CameraOrigin],
    cameras: Cameras,
    check: pd.DataFrame,
    covariance_N66: Array,
) -> pd.DataFrame:
    """One row a frame, of the selected models of the best attempt, with its cameras; covariances are NaN where there
    are none."""
    model = best.model
    assert model is not None
    table = pd.DataFrame({"frame_id": frame_ids, "registered": model.registered})
    reasons = np.full(len(table), NotRegistered.NO_VERIFIED_PAIRS, object)
    reasons[np.unique(rows_of(best.matched)[are_verified(best.matched)])] = NotRegistered.NOT_MAPPED
    reasons[[row for one in best.built for row in one.misplaced]] = NotRegistered.MISPLACED
    reasons[model.registered] = None
    table["not_registered"] = pd.Series(reasons, dtype=object)
    table["model_id"] = _model_ids(best.selected)[model.model]
    table = pd.concat([table, pose_frame("sfm_cam", model.sfm_T_cam)], axis=1)
    table[["fx", "fy"]] = cameras.focal
    table[["cx", "cy"]] = cameras.centre
    table["distortion"] = distortion_lists(cameras.coefficients[cameras.lens])
    table["readout_s"] = cameras.readout_s[cameras.lens]
    for name, of_frame in (("angular", cameras.angular), ("velocity", cameras.velocity)):
        table[[f"{name}_{axis}" for axis in "xyz"]] = of_frame
    table["camera_origin"] = origins
    table["keypoints"] = keypoint_counts(best.mapping_input, len(table))
    table = pd.concat([table, model.of_frames()], axis=1)
    both = pd.concat([check.assign(frame=check["a"]), check.assign(frame=check["b"])])
    table = pd.concat([table, held_out_medians(both, both["frame"], len(table))], axis=1)
    table["covariance"] = pd.Series(
        [list(row) if np.isfinite(row).all() else None for row in covariance_N66.reshape(-1, 36)], dtype=object
    )
    return table


def models_table(built: Sequence[BuiltModel], check: pd.DataFrame) -> pd.DataFrame:
    """One row a model; `check` is that of the selected ones."""
    table = pd.DataFrame([asdict(one) | {"model_id": one.model_id} for one in built]).drop(columns=_NOT_IN_TABLE)
    selected = selected_models(built)
    medians = held_out_medians(check, check["model"], len(selected)).assign(model_id=[one.model_id for one in selected])
    table = table.assign(selected=table["folder"] != "", folder=table["folder"].replace("", None))
    table = table.merge(medians, on="model_id", how="left", sort=False)
    return table.assign(held_out_matches=table["held_out_matches"].fillna(0).astype(np.int64))


def camera_origins(
    log: CameraLog, models: Sequence[tuple[BuiltModel, Ints]], settings: SfmSettings
) -> list[CameraOrigin]:
    """Where each frame's lens is from; `models` with the rows of their frames."""
    origins = [log.lenses.priors[k].origin for k in log.lenses.lens]
    for one, rows in models:
        wrong = {check["lens"] for check in one.stated if check["distortion_is_wrong"] and settings.lens != "stated"}
        for row in rows.tolist():
            is_free = origins[row] != CameraOrigin.STATED or int(log.lenses.lens[row]) in wrong
            if is_free and settings.refine_cameras != "never":
                origins[row] = CameraOrigin.ESTIMATED
    return origins


def camera_tables(
    log: CameraLog,
    origins: Sequence[CameraOrigin],
    selected: Sequence[BuiltModel],
    adjusted: Sequence[tuple[Adjusted, Ints]],
    estimates: Sequence[Covariances | None],
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """sfm.lenses, one row a lens of a model, and sfm.intrinsics, one row a session of a model."""
    lens_rows, session_rows = [], []
    for one, (model, rows), estimate in zip(selected, adjusted, estimates, strict=True):
        cameras, priors = model.cameras, model.priors
        lenses, sessions = len(cameras.readout_s), len(cameras.log_focal)
        sd = np.full(LENS_UNKNOWNS * lenses + sessions, np.nan)
        if estimate is not None:
            sd = np.sqrt(np.diag(estimate.shared))
        lens_sd, focal_sd = sd[: LENS_UNKNOWNS * lenses].reshape(lenses, LENS_UNKNOWNS), sd[-sessions:]
        # Focal lengths that settings hold aren't confirmed by the images.
        focal_sd[priors.log_focal_sd <= EXACT_SD] = np.nan
        checks = {check["lens"]: check for check in one.stated}
        for number, index in enumerate(np.unique(log.lenses.lens[rows])):
            lens, coefficients = log.lenses.priors[index], cameras.coefficients[number, RADIAL]
            readout_s, check = cameras.readout_s[number], checks.get(index, {})
            row = {"lens_id": lens.lens_id, "origin": origins[rows[cameras.lens == number][0]]}
            row |= dict(zip(("k1", "k2", "k3"), coefficients, strict=True))
            row |= dict(zip(("k1_sd", "k2_sd", "k3_sd"), lens_sd[number], strict=False))
            readout_sd_s = np.hypot(lens_sd[number, READOUT], _RATE_SCALE_SD * readout_s)
            row |= {"readout_s": readout_s, "readout_sd_s": readout_sd_s}
            row |= dict(zip(("centre_x", "centre_y"), cameras.centre_px[number], strict=True))
            row |= dict(zip(("centre_x_sd", "centre_y_sd"), lens_sd[number, CENTRE], strict=True))
            row |= {"stated_k1": lens.stated[0], "stated_k2": lens.stated[1], "stated_readout_s": lens.stated_readout_s}
            row |= {
                "stated_is_wrong": check.get("distortion_is_wrong", False),
                "stated_is_undecided": check.get("distortion_is_undecided", False),
                "stated_readout_is_wrong": check.get("readout_is_wrong", False),
            }
            row |= {name: check.get(name) for name in ("held_out_stated_px", "held_out_free_px")}
            lens_rows.append(row | {"model_id": one.model_id, "frames": int(np.sum(cameras.lens == number))})
        for number, session in enumerate(np.unique(log.session[rows])):
            members = cameras.session == number
            session_rows.append(
                {
                    "model_id": one.model_id,
                    "session_id": session,
                    "frames": int(members.sum()),
                    "focal_scale": float(np.exp(cameras.log_focal[number])),
                    "focal_scale_sd": focal_sd[number],
                    "focus_sd": priors.focus_sd[number],
                    "angular_sd": float(np.sqrt(np.mean(priors.angular_sd[members] ** 2))),
                }
            )
    lenses_table = pd.DataFrame(lens_rows, columns=schema("sfm", "lenses").column_names)
    return lenses_table, pd.DataFrame(session_rows, columns=schema("sfm", "intrinsics").column_names)


def attempts_table(attempts: Sequence[Attempt], best: Attempt) -> pd.DataFrame:
    """One row an attempt; the stage's models are those of the best."""
    return pd.DataFrame(
        [
            {
                "attempt": attempt.name,
                "mapper": attempt.settings.mapper,
                "max_features": attempt.settings.max_features,
                "max_image_size": attempt.settings.max_image_size,
                "pairs": len(attempt.matched),
                "verified": int(are_verified(attempt.matched).sum()),
                "models": len(attempt.selected),
                "largest": max((one.images for one in attempt.selected), default=0),
                "registered": attempt.registered,
                "consistent_fraction": attempt.consistent.sum() / attempt.registered if attempt.registered else None,
                "outcome": attempt.outcome,
                "selected": attempt is best,
            }
            for attempt in attempts
        ]
    )


def pairs_table(frame_ids: Sequence[str], matched: pd.DataFrame) -> pd.DataFrame:
    names = np.asarray(frame_ids, dtype=object)
    degrees = {
        f"{name}_deg": np.degrees(matched[name].to_numpy(float))
        for name in ("rotation", "rotation_limit", "direction", "direction_limit", "gravity")
    }
    table = matched[["origin", "matches", "inliers", "reason"]].assign(status=status_of(matched), **degrees)
    return table.assign(frame_id_a=names[matched["a"]], frame_id_b=names[matched["b"]])


def points_table(model: Model, selected: Sequence[BuiltModel]) -> pd.DataFrame:
    table = pd.DataFrame({"model_id": _model_ids(selected)[model.point_model], "point_id": model.point_ids})
    table[["x", "y", "z"]] = model.xyz
    table[["r", "g", "b"]] = model.rgb.astype(np.int64)
    table["track_length"] = model.track_lengths
    table["reprojection_px"] = model.point_error_px()
    return table


def _model_ids(selected: Sequence[BuiltModel]) -> NDArray[np.object_]:
    """The id of each selected model by its number, and None for -1."""
    return np.array([*(entry.model_id for entry in selected), None], dtype=object)
