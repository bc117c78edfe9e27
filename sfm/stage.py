"""The sfm stage: import's frames in, COLMAP models over all sessions out, one where the images allow it."""

import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.sfm.cameras.adjustment import Adjusted
from groundwalk.sfm.cameras.model_adjustment import cameras_of_frames, load_adjusted
from groundwalk.sfm.mapping.attempt_models import AttemptModels, attempt_models
from groundwalk.sfm.mapping.attempts import Attempt, run_attempts
from groundwalk.sfm.mapping.build import BuiltModel
from groundwalk.sfm.mapping.source import held_out_check, read_matches
from groundwalk.sfm.model import blobs_of
from groundwalk.sfm.pairs.odometry import Odometry, motions_over
from groundwalk.sfm.quality.covariance import Covariances, covariances
from groundwalk.sfm.quality.focal_steps import MAX_FOCAL_ERROR, with_focal_steps
from groundwalk.sfm.quality.messages import (
    excluded_pairs,
    report_cameras,
    report_models,
    report_motion,
    report_patterns,
)
from groundwalk.sfm.quality.residuals import draw_residuals, residual_patterns
from groundwalk.sfm.recording import write_recording
from groundwalk.sfm.scene_input import SceneInput, prepare_scene
from groundwalk.sfm.settings import SfmSettings
from groundwalk.sfm.tables import (
    attempts_table,
    camera_tables,
    images_table,
    models_table,
    not_registered,
    pairs_table,
    points_table,
)
from groundwalk.store import StageRun, UserError
from groundwalk.store.choices import AttemptName, AttemptOutcome
from groundwalk.store.hints import setting_of
from groundwalk.store.tables import with_cameras

RESIDUALS_PLOT = "residuals.png"
# By how much features of one surface shift alike where the view turns by a radian, in pixels of the images that they
# were taken from: the adjustment follows, so residuals don't show it (docs/explanation/sfm.md).
_SURFACE_PX = 0.07
# They also shift with the place in the image, alike in all frames: by what variances of lenses, readout times and focal
# factors are larger.
_OF_CAMERAS = 1.5
_MAX_COHERENCE = 4.0
_MOTION_M = 5.0  # of the motions whose uncertainty is written
AdjustedModels = list[tuple[Adjusted, NDArray[np.int64]]]


def run(r: StageRun[SfmSettings]) -> None:
    scene = prepare_scene(r)
    attempts, best, made = _select_attempt(r, scene)
    selected, model = made.selected, made.model
    assert model is not None  # the selected attempt has one
    frame_ids = list(scene.frames["frame_id"])
    with r.step("quality"):
        adjusted = [load_adjusted(made.folder / f"{entry.folder}.npz") for entry in selected]
        cameras = cameras_of_frames(scene.cameras, adjusted)
        shrinking = scene.frames[["width", "height"]].max(axis=1).to_numpy(float) / made.settings.max_image_size
        covariance, motion_sd, estimates = _covariances(
            r, _SURFACE_PX * np.maximum(shrinking, 1.0), scene.vio, selected, adjusted
        )
        check = held_out_check(read_matches(made.mapping_input), cameras, model.sfm_T_cam, model.model)
        images = images_table(frame_ids, model, selected, made.keypoints, check, cameras, covariance)
        images["not_registered"] = not_registered(model.registered, made.built, made.matched)
        images["motion_sd"] = motion_sd
        calibration = scene.cameras.calibration
        images["uses_vio"] = (made.settings.mapper == "vio") & model.registered
        images["camera_origin"] = [calibration.lenses[k].origin for k in calibration.lens]
    r.write("images", images)
    r.write("models", models_table(made.built, check))
    lenses, intrinsics = camera_tables(scene.cameras, selected, adjusted, estimates)
    intrinsics = with_focal_steps(intrinsics, scene.frames, images, MAX_FOCAL_ERROR, made.zooms)
    r.write("lenses", lenses)
    r.write("intrinsics", intrinsics)
    residuals = _residuals(scene, selected, adjusted)
    r.write("residuals", residuals)
    report_patterns(r, residuals, RESIDUALS_PLOT)
    draw_residuals(r.work / RESIDUALS_PLOT, residuals)
    r.write("attempts", attempts_table(attempts, best))
    r.write("pairs", pairs_table(frame_ids, made.matched))
    r.write("points", points_table(model, selected))
    for entry in selected:
        shutil.copytree(made.folder / entry.folder, r.work / entry.folder, dirs_exist_ok=True)
    with r.step("recording"):
        write_recording(r, with_cameras(scene.frames, images), model, made.matched)
    report_models(r, made, model, images["not_registered"], check, attempts, best)
    for line in excluded_pairs(made.matched, scene.vio.posed):
        r.say(line)
    report_cameras(r, lenses, intrinsics)
    report_motion(r, scene.frames, scene.cameras.motion)


def _select_attempt(r: StageRun[SfmSettings], scene: SceneInput) -> tuple[list[Attempt], int, AttemptModels]:
    """All attempts, the index of the selected one, and what it made. UserError where none registers enough frames."""

    def attempt(number: int, name: AttemptName, settings: SfmSettings) -> tuple[Attempt, AttemptModels]:
        return attempt_models(r, scene, number, name, settings)

    done = run_attempts(r.settings, attempt, r.say)
    if done.selected is None or done.result is None:
        raise UserError(
            "too few frames registered",
            expected=f"at least {r.settings.min_registered_fraction:.0%} of {len(scene.names)} frames",
            found="".join(f"\n{attempt}" for attempt in done.attempts),
            do="look at the images: neighbours need to overlap by half and to be sharp; a larger "
            f"{setting_of('sfm', 'max_features')} gives more features in hard images, and so may max_image_size there; "
            f"or lower {setting_of('sfm', 'min_registered_fraction')}",
        )
    best = done.attempts[done.selected]
    if best.outcome is AttemptOutcome.INCONSISTENT_WITH_VIO:
        why = f"further attempts wouldn't help: {best.input_fault}; " if best.input_fault else ""
        r.say(
            f"the motion of {best.consistent / best.registered:.0%} of registered frames is consistent with VIO, limit "
            f"{r.settings.min_consistent_fraction:.0%} ({setting_of('sfm', 'min_consistent_fraction')}); {why}"
            f"selected: {best}"
        )
    return done.attempts, done.selected, done.result


def _residuals(scene: SceneInput, selected: list[BuiltModel], adjusted: AdjustedModels) -> pd.DataFrame:
    """Table residuals of all selected models."""
    calibration = scene.cameras.calibration
    tables = []
    for entry, (one, rows) in zip(selected, adjusted, strict=True):
        lens_ids = [calibration.lenses[k].lens_id for k in np.unique(calibration.lens[rows])]
        tables.append(residual_patterns(entry.model_id, lens_ids, one))
    return pd.concat(tables, ignore_index=True)


def _covariances(
    r: StageRun[SfmSettings], surface_px_N: Array, vio: Odometry, selected: list[BuiltModel], adjusted: AdjustedModels
) -> tuple[Array, Array, list[Covariances | None]]:
    """(N, 6, 6) and the larger standard deviation of a frame's motions (N,), NaN for frames without; and each selected
    model's covariances of frames and cameras."""
    covariance, motion_sd = np.full((len(surface_px_N), 6, 6), np.nan), np.full(len(surface_px_N), np.nan)
    estimates: list[Covariances | None] = []
    for entry, (one, rows) in zip(selected, adjusted, strict=True):
        estimate, motions = None, motions_over(vio.session[rows], vio.travelled_m[rows], _MOTION_M)
        if entry.images > r.settings.covariance_max_images:
            limit = f"limit {r.settings.covariance_max_images} ({setting_of('sfm', 'covariance_max_images')})"
            r.say(f"model {entry.model_id}: no covariances: {entry.images} frames, {limit}")
        elif (
            estimate := covariances(one, blobs_of(one.bundle), float(np.median(surface_px_N[rows])), motions)
        ) is None:
            r.say(f"model {entry.model_id}: no covariances: too few points")
        else:
            estimate = replace(estimate, shared=_OF_CAMERAS * estimate.shared)
            covariance[rows] = estimate.poses
            for ends in motions.T:
                np.fmax.at(motion_sd, rows[ends], estimate.motions)
            r.figure(f"coherence_rows_{entry.folder}", estimate.by_rows)
            r.figure(f"coherence_cells_{entry.folder}", estimate.by_cell)
            if estimate.by_rows > _MAX_COHERENCE:
                r.say(
                    f"model {entry.model_id}: residuals are correlated in rows of frames (variance of their sums "
                    f"{estimate.by_rows:.0f} times that of independent ones): a rolling shutter, focus or stabilised "
                    "video isn't modelled; standard deviations are larger by the root of that"
                )
        estimates.append(estimate)
    return covariance, motion_sd, estimates
