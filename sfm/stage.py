"""The sfm stage: import's frames in, COLMAP models over all sessions out, one where the images allow it."""

import shutil

import numpy as np

from groundwalk.sfm.cameras.calibration import with_lenses
from groundwalk.sfm.cameras.model_adjustment import cameras_of_frames, load_adjusted
from groundwalk.sfm.mapping.attempts import Attempt, run_attempts
from groundwalk.sfm.mapping.build import build_models
from groundwalk.sfm.mapping.built import read_built, selected_models
from groundwalk.sfm.mapping.held_out import VerifiedPairs, held_out_check, read_matches
from groundwalk.sfm.messages import (
    report_attempts,
    report_cameras,
    report_coherence,
    report_excluded_pairs,
    report_models,
    report_motion,
)
from groundwalk.sfm.model import load_models
from groundwalk.sfm.pairs.floor import FloorSource
from groundwalk.sfm.pairs.matched import are_verified, checkpoint, rows_of
from groundwalk.sfm.pairs.odometry import motions_over
from groundwalk.sfm.pairs.selection import pairs_by_images, pairs_within_sessions
from groundwalk.sfm.pairs.verification import (
    compared_with_neighbours,
    compared_with_vio,
    match_proposals,
    with_floor_matches,
    with_guided_matches,
)
from groundwalk.sfm.plugins import MappingInput
from groundwalk.sfm.quality.covariance import Covariances, covariances
from groundwalk.sfm.quality.focal_steps import with_focal_steps
from groundwalk.sfm.quality.model_check import check_models
from groundwalk.sfm.recording import write_recording
from groundwalk.sfm.scene_input import (
    calibrated_cameras,
    calibrated_features,
    extracted_features,
    linked_images,
    odometry_of,
    with_focal_lengths,
)
from groundwalk.sfm.settings import SfmSettings
from groundwalk.sfm.tables import (
    attempts_table,
    camera_tables,
    images_table,
    models_table,
    pairs_table,
    points_table,
)
from groundwalk.store import StageRun
from groundwalk.store.child import Task, preload
from groundwalk.store.choices import AttemptName, PoseSource
from groundwalk.store.tables import with_cameras

_IN_CHILDREN = (
    "groundwalk.sfm.cameras.calibration",
    "groundwalk.sfm.cameras.focal_lengths",
    "groundwalk.sfm.mapping.build",
    "groundwalk.sfm.pairs.features",
    "groundwalk.sfm.pairs.neighbours",
)
# VIO is surer than SfM where SfM's motion over so much of its path is less certain (align's check of uncertain frames).
_MOTION_M = 5.0
# Covariances take 36 N² numbers of memory: 1.8 GB for so many frames. Those of larger models are of class C.
_MAX_COVARIANCE_FRAMES = 2500


def run(r: StageRun[SfmSettings]) -> None:
    preload(*_IN_CHILDREN)
    frames, sessions = r.read("import", "frames"), r.read("import", "sessions")
    work = linked_images(r, frames)
    frames = with_focal_lengths(r, frames, work)
    pose_source = frames["session_id"].map(sessions.set_index("session_id")["pose_source"])
    is_alone = (pose_source == PoseSource.NONE).to_numpy(bool)
    vio = odometry_of(frames, r.read("import", "jumps"), sessions)
    cameras = calibrated_cameras(r, frames, sessions, vio, work)
    frames = with_lenses(frames, cameras.calibration)

    def attempt(number: int, name: AttemptName, settings: SfmSettings) -> Attempt:
        """Make models with these settings and check them against VIO; what an earlier, killed run did is reused."""
        features = extracted_features(r, frames, work, settings)
        database = calibrated_features(r, frames, cameras, work, settings)
        with r.step("pairs"):
            proposals = pairs_within_sessions(settings, frames, vio)
            proposals += pairs_by_images(settings, vio, proposals, database, r.seed)
        with r.step("matching"):
            # Later steps replace results in the database, by which pairs were chosen for them.
            steps = work.scratch / f"matched_{number}"
            steps.mkdir(exist_ok=True)
            source = FloorSource(features, work.images, work.names, frames, cameras.calibration, cameras.motion)
            compared = checkpoint(
                steps / "compared.parquet",
                lambda: compared_with_vio(
                    match_proposals(settings, vio, proposals, database, work, r.seed), vio, database
                ),
            )
            floor = checkpoint(
                steps / "floor.parquet", lambda: with_floor_matches(compared, source, vio, database, work, r.say)
            )
            guided = checkpoint(
                steps / "guided.parquet", lambda: with_guided_matches(floor, compared, vio, database, work)
            )
            matched = checkpoint(
                steps / "neighbours.parquet",
                lambda: compared_with_neighbours(guided, is_alone, vio, source, database, work, r.seed),
            )
        folder = work.scratch / f"mapping_{number}"
        with r.step("mapping"):
            is_verified = are_verified(matched)
            if is_verified.any() and not folder.is_dir():
                verified = rows_of(matched)[is_verified]
                pairs = VerifiedPairs(frames=frames, pairs=verified, matched=database, features=features)
                mapping_input = MappingInput(folder.with_suffix(".db"), work.images, r.seed)
                task = Task(build_models, (pairs, mapping_input, cameras, settings, folder), len(frames))
                work.in_child("mapping", task)
            built = read_built(folder) if folder.is_dir() else []
        model, consistent, fault = None, np.zeros(len(frames), bool), ""
        with r.step("check"):
            if selected := selected_models(built):
                model = load_models([folder / one.folder for one in selected], len(frames))
                consistent, fault = check_models(model.sfm_T_cam, model.model, vio)
        return Attempt(
            name=name,
            settings=settings,
            matched=matched,
            built=built,
            folder=folder,
            model=model,
            consistent=consistent,
            has_vio=bool(vio.posed.any()),
            input_fault=fault,
        )

    attempts, best = run_attempts(r.settings, attempt, r.say)
    report_attempts(r, attempts, best, len(frames))
    assert best.model is not None  # otherwise that was an error
    model, matched, selected = best.model, best.matched, best.selected

    with r.step("quality"):
        adjusted = [load_adjusted(best.folder / f"{one.folder}.npz") for one in selected]
        estimates: list[Covariances | None] = []
        covariance, motion_sd = np.full((len(frames), 6, 6), np.nan), np.full(len(frames), np.nan)
        for one, (bundle, rows) in zip(selected, adjusted, strict=True):
            estimate, motions = None, motions_over(vio.session[rows], vio.travelled_m[rows], _MOTION_M)
            if one.images > _MAX_COVARIANCE_FRAMES:
                r.say(f"model {one.model_id}: no covariances of more than {_MAX_COVARIANCE_FRAMES} frames")
            elif (estimate := covariances(bundle, motions)) is None:
                r.say(f"model {one.model_id}: no covariances: too few points")
            else:
                covariance[rows] = estimate.poses
                for ends in motions.T:
                    np.fmax.at(motion_sd, rows[ends], estimate.motions)
                report_coherence(r, one, estimate)
            estimates.append(estimate)
        finished = cameras_of_frames(cameras, adjusted)
        held_out = held_out_check(read_matches(best.mapping_input), finished, model.sfm_T_cam, model.model)

    frame_ids = list(frames["frame_id"])
    images = images_table(frame_ids, best, cameras, finished, held_out, covariance, motion_sd)
    r.write("images", images)
    r.write("models", models_table(best.built, held_out))
    lenses, intrinsics = camera_tables(cameras, selected, adjusted, estimates)
    intrinsics = with_focal_steps(intrinsics, frames, images)
    r.write("lenses", lenses)
    r.write("intrinsics", intrinsics)
    r.write("attempts", attempts_table(attempts, best))
    r.write("pairs", pairs_table(frame_ids, matched))
    r.write("points", points_table(model, selected))
    for one in selected:
        shutil.copytree(best.folder / one.folder, r.work / one.folder, dirs_exist_ok=True)
    with r.step("recording"):
        write_recording(r, with_cameras(frames, images), model, matched)

    report_models(r, best, held_out, images["not_registered"])
    report_excluded_pairs(r, matched, vio)
    report_cameras(r, lenses, intrinsics, frames)
    report_motion(r, frames, cameras.motion)
