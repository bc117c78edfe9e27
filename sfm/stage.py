"""The sfm stage: import's frames in, COLMAP models over all sessions out, one where the images allow it."""

import shutil
from collections.abc import Sequence

import numpy as np

from groundwalk.geometry.poses import Array
from groundwalk.sfm import messages, scene_input, tables
from groundwalk.sfm.cameras.adjustment import Adjusted, Ints
from groundwalk.sfm.cameras.lenses import with_lenses
from groundwalk.sfm.cameras.model_adjustment import cameras_of_frames, load_adjusted
from groundwalk.sfm.extension import HeldArtefact, refuse_misfit
from groundwalk.sfm.mapping.attempts import Attempt, run_attempts
from groundwalk.sfm.mapping.build import build_models, extend_models
from groundwalk.sfm.mapping.held_out import VerifiedPairs, held_out_check, read_matches
from groundwalk.sfm.model import BuiltModel, load_models, read_built, selected_models
from groundwalk.sfm.pairs import verification
from groundwalk.sfm.pairs.floor import PairSource
from groundwalk.sfm.pairs.matched import are_verified, checkpoint, rows_of
from groundwalk.sfm.pairs.selection import pairs_by_images, pairs_within_sessions
from groundwalk.sfm.plugins import MappingInput
from groundwalk.sfm.quality.covariance import Covariances, covariances
from groundwalk.sfm.quality.model_check import check_models
from groundwalk.sfm.recording import write_recording
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import StageRun
from groundwalk.store.child import Task, preload
from groundwalk.store.choices import AttemptName, PoseSource
from groundwalk.store.tables import with_cameras

_IN_CHILDREN = (
    "groundwalk.sfm.cameras.starts",
    "groundwalk.sfm.database",
    "groundwalk.sfm.mapping.build",
    "groundwalk.sfm.pairs.verification",
)


def run(r: StageRun[SfmSettings]) -> None:
    preload(*_IN_CHILDREN)
    frames, sessions = r.read("import", "frames"), r.read("import", "sessions")
    held = HeldArtefact.of(r.before, frames) if r.before is not None and r.holds else None
    is_new = np.ones(len(frames), bool) if held is None else held.is_new
    work = scene_input.linked_images(r, frames)
    pose_source = frames["session_id"].map(sessions.set_index("session_id")["pose_source"])
    is_alone = (pose_source == PoseSource.NONE).to_numpy(bool)
    vio = scene_input.odometry_of(frames, r.read("import", "jumps"), sessions)
    if held is None:
        frames = scene_input.with_focal_lengths(r, frames, work)
        cameras = scene_input.logged_cameras(r, frames, sessions)
        cameras = scene_input.with_start_lenses(r, frames, vio, work, cameras)
    else:
        frames, cameras = held.cameras(r, frames, sessions, vio, work)
    frames = with_lenses(frames, cameras.lenses)

    def attempt(number: int, name: AttemptName, settings: SfmSettings) -> Attempt:
        """Make models with these settings and check them against VIO; what an earlier, killed run did is reused."""
        features = scene_input.extracted_features(r, frames, work, settings)
        database = scene_input.features_of_cameras(r, frames, cameras, work, settings)
        with r.step("pairs"):
            proposals = pairs_within_sessions(settings, frames, vio)
            proposals += pairs_by_images(settings, vio, proposals, database, r.seed)
        with r.step("matching"):
            # Later steps replace results in the database, by which pairs were chosen for them.
            steps = work.scratch / f"matched_{number}"
            steps.mkdir(exist_ok=True)
            source = PairSource(
                database=database,
                features=features,
                work=work,
                frames=frames,
                lenses=cameras.lenses,
                motion=cameras.motion,
                vio=vio,
                seed=r.seed,
            )
            compared = checkpoint(
                steps / "compared.parquet",
                lambda: verification.compared_with_vio(
                    verification.match_proposals(settings, source, proposals, is_new), source
                ),
            )
            floor = checkpoint(
                steps / "floor.parquet", lambda: verification.with_floor_matches(compared, source, r.say)
            )
            guided = checkpoint(
                steps / "guided.parquet", lambda: verification.with_guided_matches(floor, compared, source)
            )
            matched = checkpoint(
                steps / "neighbours.parquet",
                lambda: verification.compared_with_neighbours(guided, is_alone, source),
            )
        folder = work.scratch / f"mapping_{number}"
        with r.step("mapping"):
            is_verified = are_verified(matched)
            if (is_verified.any() or held is not None) and not folder.is_dir():
                verified = rows_of(matched)[is_verified]
                pairs = VerifiedPairs(frames=frames, pairs=verified, matched=database, features=features)
                mapping_input = MappingInput(folder.with_suffix(".db"), work.images, r.seed)
                arguments = (pairs, mapping_input, cameras, settings, folder)
                start_T_cam = vio.longest_session() if name is AttemptName.VIO_START else None
                task = Task(build_models, (*arguments, start_T_cam), len(frames))
                if held is not None:
                    task = Task(extend_models, ((held.folder, held.models), *arguments), int(is_new.sum()))
                work.in_child("mapping", task)
            built = read_built(folder) if folder.is_dir() else []
        model, consistent, fault = None, np.zeros(len(frames), bool), ""
        with r.step("check"):
            if selected := selected_models(built):
                model = load_models([folder / one.folder for one in selected], len(frames))
                consistent, fault = check_models(model.sfm_T_cam, np.where(is_new, model.model, -1), vio)
                consistent |= model.registered & ~is_new
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

    settings = scene_input.first_settings(r, frames)
    if held is None:
        attempts, best = run_attempts(settings, attempt, r.say)
    else:
        attempts = [best := attempt(0, AttemptName.ADDED, settings)]
        refuse_misfit(best, is_new, frames)
    messages.report_attempts(r, attempts, best, len(frames))
    assert best.model is not None  # otherwise that was an error
    model, selected = best.model, best.selected
    adjusted_models = [one for one in selected if (best.folder / f"{one.folder}.npz").is_file()]

    with r.step("quality"):
        adjusted = [load_adjusted(best.folder / f"{one.folder}.npz") for one in adjusted_models]
        estimates, covariance = _covariances(r, len(frames), adjusted_models, adjusted)
        if held is not None:
            covariance += held.covariance_by_map(model)
        finished = cameras_of_frames(cameras, adjusted)
        held_out = held_out_check(read_matches(best.mapping_input), finished, model.sfm_T_cam, model.model)

    frame_ids = list(frames["frame_id"])
    rows_of_models = [(one, rows) for one, (_, rows) in zip(adjusted_models, adjusted, strict=True)]
    origins = tables.camera_origins(cameras, rows_of_models, r.settings)
    images = tables.images_table(frame_ids, best, origins, finished, held_out, covariance)
    lenses, intrinsics = tables.camera_tables(cameras, origins, adjusted_models, adjusted, estimates)
    written = {
        "images": images,
        "models": tables.models_table(best.built, held_out),
        "lenses": lenses,
        "intrinsics": intrinsics,
        "attempts": tables.attempts_table(attempts, best),
        "pairs": tables.pairs_table(frame_ids, best.matched),
        "points": tables.points_table(model, selected),
    }
    known = held.tables if held is not None else {}
    if held is not None:
        written = held.with_rows(written)
    for name, table in written.items():
        r.write(name, table)
    for one in selected:
        shutil.copytree(best.folder / one.folder, r.work / one.folder, dirs_exist_ok=True)
    with r.step("recording"):
        write_recording(r, with_cameras(frames, written["images"]), model, written["pairs"])
    scene_input.keep_features(r, work, best.settings)

    messages.report_models(r, best, held_out, written["images"]["not_registered"])
    messages.report_excluded_pairs(r, best.matched, vio)
    of_new = {name: written[name].iloc[len(known.get(name, ())) :] for name in ("lenses", "intrinsics")}
    messages.report_cameras(r, of_new["lenses"], of_new["intrinsics"], frames)
    messages.report_motion(r, frames, cameras.motion)


def _covariances(
    r: StageRun[SfmSettings], frames: int, models: Sequence[BuiltModel], adjusted: Sequence[tuple[Adjusted, Ints]]
) -> tuple[list[Covariances | None], Array]:
    """Of each model, None where there are none; and of all N frames, (N, 6, 6), NaN."""
    estimates: list[Covariances | None] = []
    covariance = np.full((frames, 6, 6), np.nan)
    for one, (bundle, rows) in zip(models, adjusted, strict=True):
        if (estimate := covariances(bundle)) is None:  # its frames are of class C
            r.say(
                f"model {one.model_id}: no covariances: its points are too few or don't determine its poses, or, of a "
                "large model, conjugate gradients don't converge"
            )
        else:
            covariance[rows] = estimate.poses
            messages.report_coherence(r, one, estimate)
        estimates.append(estimate)
    return estimates, covariance
