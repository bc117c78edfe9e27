"""The sfm stage: import's frames in, COLMAP models over all sessions out, one where the images allow it."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from artefacts import Stage, StageRun, UserError
from artefacts.child import Task, in_child
from artefacts.tables import poses_of
from geometry.motion_agreement import compare_motions
from geometry.poses import Array, relative
from geometry.vio_drift import VioDrift
from sfm.covariance import pose_covariance
from sfm.database import create_database, have_results, image_name, keypoint_counts, read_descriptors, read_pair_results
from sfm.features import extract_features, features_name
from sfm.intrinsics import (
    BEYOND,
    REFINED,
    FocalScale,
    first_estimates,
    read_refined,
    refine_models,
    with_focal_scales,
)
from sfm.ladder import TAKEN, Attempt, climb, outcome_of
from sfm.mappers import MappingInput
from sfm.mapping import BuiltModel, kept_models, map_verified, read_built
from sfm.mapping_input import HeldOutCheck, held_out_check, read_matches
from sfm.matching import ONE_THREAD, MatchedPairs, match_pairs, try_networks
from sfm.model import Model, load_models
from sfm.model_check import check_models
from sfm.networks import model_files, require_model_files
from sfm.odometry import Odometry, PairLimits, drift_between, nothing_compared, odometry
from sfm.pairs import (
    Pairs,
    first_origins,
    sequence_pairs,
    strongest_pairs,
    transitive_pairs,
    unique_pairs,
    vio_pairs,
    within_vio_limits,
)
from sfm.recording import write_recording
from sfm.retrieval import RETRIEVALS, retrieval_pairs
from sfm.settings import SfmSettings
from sfm.tables import attempts_table, images_table, intrinsics_table, models_table, pairs_table, points_table
from sfm.two_views import compare_pairs

_FEWEST_FRAMES = 3
_FEWEST_COMPARED = 8
_UNTRACKED = ("limited", "lost")


# An error on one of COLMAP's threads aborts the process that it runs in, hence child processes.
_TOO_LITTLE = "too little memory needs a smaller sfm.max_image_size or sfm.max_features"


@dataclass(frozen=True)
class _Scene:
    """The frames, what VIO knows of them, and the files that COLMAP works on."""

    frames: pd.DataFrame
    recording_N: NDArray[np.object_]
    vio: Odometry
    names: list[str]
    images: Path
    scratch: Path
    log: Path


@dataclass(frozen=True)
class _Mapped:
    """An attempt: its settings, its pairs, its features, and the models in `folder`; no `model` where it has none."""

    settings: SfmSettings
    matched: MatchedPairs
    keypoints: NDArray[np.int64]
    built: list[BuiltModel]
    folder: Path
    model: Model | None


@dataclass(frozen=True)
class _Kept:
    """The models that were kept, in `folder`, as arrays, with the frames as they go with them, what their focal lengths
    were multiplied by, (N,), and what was tried of that."""

    models: list[BuiltModel]
    folder: Path
    model: Model
    frames: pd.DataFrame
    focal_scale: Array
    tried: list[FocalScale]


def run(r: StageRun[SfmSettings]) -> None:
    scene = _prepare(r)
    attempts, taken, mapped = _climb(r, scene)
    frame_ids = list(scene.frames["frame_id"])
    with r.step("intrinsics"):
        final = _refine(r, scene, mapped)
    kept, model = final.models, final.model
    built = [next((told for told in kept if told.model_id == one.model_id), one) for one in mapped.built]
    with r.step("quality"):
        covariance = _covariance(r, final.frames, model, kept)
        matches = read_matches(_mapping_input(mapped.folder))
        check = held_out_check(matches, final.frames, model.sfm_T_cam, model.model)
        uses_vio = mapped.settings.mapper == "vio"
        images = images_table(frame_ids, model, kept, mapped.keypoints, check, final.focal_scale, covariance, uses_vio)
    r.write("images", images)
    r.write("models", models_table(built, check))
    r.write("intrinsics", intrinsics_table(final.tried))
    r.write("attempts", attempts_table(attempts, taken))
    r.write("pairs", pairs_table(frame_ids, mapped.matched))
    r.write("points", points_table(model, kept))
    for told in kept:
        shutil.copytree(final.folder / told.folder, r.work / told.folder, dirs_exist_ok=True)
    with r.step("recording"):
        write_recording(r, final.frames, model, mapped.matched)
    _tell(r, mapped, final, check, attempts[taken], len(attempts))


def _tell(
    r: StageRun[SfmSettings], mapped: _Mapped, final: _Kept, check: HeldOutCheck, taken: Attempt, attempts: int
) -> None:
    kept, model = final.models, final.model
    registered = int(model.registered.sum())
    disagree = int((mapped.matched.verdict == "disagrees").sum())
    track_length = float(model.track_lengths().mean())
    error_px = float(np.linalg.norm(model.residual_px, axis=1).mean())
    figures = {
        "frames": len(model.registered),
        "registered": registered,
        "models": len(kept),
        "largest": kept[0].images,
        "attempts": attempts,
        "moving_as_vio": taken.agreeing / registered,
        "mapper": mapped.settings.mapper,
        "pairs": len(mapped.matched.pairs),
        "verified_pairs": int(mapped.matched.verified.sum()),
        "pairs_against_vio": disagree,
        "points": len(model.xyz),
        "mean_track_length": track_length,
        "mean_reprojection_px": error_px,
        "heldout_px": check.median_px(held_out=True),
        "fitted_px": check.median_px(held_out=False),
        "refined_sessions": sum(scale.decision == REFINED for scale in final.tried),
    }
    for name, value in figures.items():
        r.figure(name, value)
    where = "one model" if len(kept) == 1 else f"{len(kept)} models that nothing visual ties together"
    r.say(
        f"{registered} of {len(model.registered)} frames in {where}, {len(model.xyz)} points, "
        f"{error_px:.2f} px mean reprojection error"
    )
    if disagree:
        r.say(f"{disagree} verified pairs were kept out, as VIO moved otherwise (table pairs)")
    for scale in final.tried:
        if scale.decision in (REFINED, BEYOND) and scale.factor and scale.sd is not None:
            more = f"{100 * (scale.factor - 1):+.2f} % ± {100 * scale.sd:.2f} %"
            r.say(
                f"session {scale.session_id}: focal lengths refined, {more} (table intrinsics)"
                if scale.decision == REFINED
                else f"session {scale.session_id}: ITS FOCAL LENGTHS ARE LIKELY WRONG, the images say {more}; kept as "
                f"captured, since that is beyond {100 * r.settings.focal_limit:g} % (sfm.focal_limit)"
            )


def _prepare(r: StageRun[SfmSettings]) -> _Scene:
    frames = r.read("import", "frames")
    if len(frames) < _FEWEST_FRAMES:
        raise UserError(
            "too few frames for a model",
            where=r.folder("import") / "frames.parquet",
            expected=f"at least {_FEWEST_FRAMES}",
            found=len(frames),
            do="capture more, or let import keep more (its table rejects says what was left out and why)",
        )
    log = r.scratch / "colmap.log"
    if model_files(r.settings):
        require_model_files(r.settings)
        in_child("trying the networks", log, _TOO_LITTLE, Task(try_networks, (r.settings,)))
    recordings = r.read("import", "sessions").set_index("session_id")["recording"]
    images = r.scratch / "images"
    names = []
    for frame_id, image in zip(frames["frame_id"], frames["image"], strict=True):
        # Links give COLMAP one image folder, and its model names that mean the same on every machine.
        source, name = r.image_path(image), image_name(frame_id, image)
        if not source.is_file():
            raise UserError(
                f"frame {frame_id} has lost its image", where=source, do=f"make scene={r.scene.name} import"
            )
        link = images / name
        if not link.is_symlink():
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(source.absolute())
        names.append(name)
    return _Scene(
        frames,
        frames["session_id"].map(recordings).to_numpy(),
        _odometry(frames, r.read("import", "jumps")),
        names,
        images,
        r.scratch,
        log,
    )


def _odometry(frames: pd.DataFrame, jumps: pd.DataFrame) -> Odometry:
    vio_T_cam = poses_of(frames, "vio_cam")
    # A pose that the phone itself calls limited or lost may stand still while the phone moves.
    vio_T_cam[frames["tracking"].isin(_UNTRACKED).to_numpy()] = np.nan
    return odometry(
        frames["session_id"].to_numpy(object),
        frames["t_ns"].to_numpy(np.int64),
        vio_T_cam,
        frames[["gravity_x", "gravity_y", "gravity_z"]].to_numpy(float, na_value=np.nan),
        zip(
            jumps["session_id"].to_numpy(str),
            jumps["t_ns"].to_numpy(np.int64),
            jumps["jump_m"].to_numpy(float),
            np.radians(jumps["jump_deg"].to_numpy(float)),
            strict=True,
        ),
    )


def _climb(r: StageRun[SfmSettings], scene: _Scene) -> tuple[list[Attempt], int, _Mapped]:
    """All attempts, the index of the one that is taken, and what it made. UserError with all of them where none has
    frames enough."""
    keypoints: dict[Path, NDArray[np.int64]] = {}

    def attempt(number: int, name: str, settings: SfmSettings) -> tuple[Attempt, _Mapped]:
        return _attempt(r, scene, number, name, settings, keypoints)

    attempts, taken, mapped = climb(r.settings, attempt, r.say)
    if taken is None or mapped is None:
        raise UserError(
            "the models hold too few of the frames",
            expected=f"at least {r.settings.min_registered:.0%} of {len(scene.names)} frames (sfm.min_registered)",
            found="".join(f"\n{attempt}" for attempt in attempts),
            do="look at the images: neighbours need to overlap by half and to be sharp; a larger sfm.max_features or "
            "sfm.max_image_size finds more in hard images",
        )
    if attempts[taken].outcome != TAKEN:
        why = attempts[taken].no_help
        r.say(
            f"fewer than {r.settings.min_agreeing:.0%} of the frames move as VIO does (sfm.min_agreeing); "
            f"{f'no other attempt would help: {why}' if why else 'the best attempt is taken'}: {attempts[taken]}"
        )
    return attempts, taken, mapped


def _attempt(
    r: StageRun[SfmSettings],
    scene: _Scene,
    number: int,
    name: str,
    settings: SfmSettings,
    keypoints: dict[Path, NDArray[np.int64]],
) -> tuple[Attempt, _Mapped]:
    """Features, pairs and models by these settings, held against VIO. `keypoints` are those counted before."""
    database = scene.scratch / f"database{features_name(settings)}.db"
    create_database(database, scene.frames, scene.names)
    with r.step("features"):
        if database not in keypoints:
            arguments = (database, scene.images, scene.names, settings)
            task = Task(extract_features, arguments, len(scene.names))
            in_child("extracting features", scene.log, _TOO_LITTLE, task)
            keypoints[database] = keypoint_counts(database, len(scene.names))
            _require_features(r, keypoints[database])
    with r.step("pairs"):
        proposals = _propose(r.seed, settings, scene, database)
    with r.step("matching"):
        matched = _match(r.seed, settings, scene, database, proposals)
        matched = _compare(settings, scene, database, matched)
    folder = scene.scratch / f"mapping_{number}"
    with r.step("mapping"):
        built = _map(r, settings, scene, database, matched, folder)
    kept = kept_models(built)
    model, agreeing, no_help = None, 0, ""
    with r.step("check"):
        if kept:
            model = load_models([folder / told.folder for told in kept], len(scene.names))
            t_ns = scene.frames["t_ns"].to_numpy(np.int64)
            check = check_models(model.sfm_T_cam, model.model, scene.vio, scene.recording_N, t_ns, _drift(settings))
            agreeing = int(check.agrees.sum())
            no_help = ", ".join(
                f"the images of session {session} turn {gain:.2f} times as far as its VIO, so its focal length is wrong"
                for session, gain in check.turned.items()
            )
    sizes = [told.images for told in kept]
    outcome = outcome_of(sizes, agreeing, len(scene.names), settings)
    told = Attempt(
        name, settings.mapper, len(matched.pairs), int(matched.verified.sum()), sizes, agreeing, outcome, no_help
    )
    return told, _Mapped(settings, matched, keypoints[database], built, folder, model)


def _require_features(r: StageRun[SfmSettings], keypoints_N: NDArray[np.int64]) -> None:
    if np.count_nonzero(keypoints_N) < _FEWEST_FRAMES:
        raise UserError(
            "the images have hardly any features",
            expected=f"at least {_FEWEST_FRAMES} images with features",
            found=f"{np.count_nonzero(keypoints_N)} of {len(keypoints_N)}",
            do=f"look at the images of scene {r.scene.name}: blank, black or all blurred ones can't be placed",
        )


def _propose(seed: int, s: SfmSettings, scene: _Scene, database: Path) -> list[tuple[str, Pairs]]:
    frames, vio = scene.frames, scene.vio
    following = sequence_pairs(scene.recording_N, frames["t_ns"], s.sequence_pairs)
    # The next frame is always tried: that is what ties a recording together where VIO jumped.
    next_one = sequence_pairs(scene.recording_N, frames["t_ns"], 1)
    near = vio_pairs(
        vio.session,
        vio.vio_T_cam,
        frames[["fx", "fy", "cx", "cy"]].to_numpy(float),
        frames[["width", "height"]].to_numpy(float),
        s.vio_max_distance_m,
        s.vio_max_angle_deg,
        s.vio_pairs,
    )
    alike = unique_pairs([])
    if s.retrieval_pairs and len(set(vio.session)) > 1:
        descriptors = read_descriptors(database, len(frames))
        described = RETRIEVALS[s.retrieval](descriptors, s.retrieval_words, seed)
        alike = retrieval_pairs(described, vio.session, s.retrieval_pairs)
    return [
        ("sequence", unique_pairs(np.concatenate([next_one, following[_can_see(s, vio, following)]]))),
        ("vio", near),
        ("retrieval", alike),
    ]


def _match(
    seed: int, s: SfmSettings, scene: _Scene, database: Path, proposals: list[tuple[str, Pairs]]
) -> MatchedPairs:
    def match(text: str) -> MatchedPairs:
        pairs, origin = first_origins(proposals, len(scene.names))
        if not have_results(database, pairs).all():
            arguments = (database, scene.names, pairs, s, seed)
            in_child(text, scene.log, _TOO_LITTLE, Task(match_pairs, arguments, len(pairs), ONE_THREAD))
        matches, inliers = read_pair_results(database, pairs)
        return MatchedPairs(pairs, origin, matches, inliers, s.min_inliers, nothing_compared(len(pairs)))

    matched = match("matching pairs")
    if s.transitive_pairs:
        pairs, strength = transitive_pairs(matched.pairs, matched.inliers, len(scene.names))
        allowed = _can_see(s, scene.vio, pairs)
        more = strongest_pairs(pairs[allowed], strength[allowed], s.transitive_pairs)
        proposals = [*proposals, ("transitive", more)]
        matched = match("matching pairs that share a partner")
    return matched


def _drift(s: SfmSettings) -> VioDrift:
    return VioDrift.in_degrees(s.vio_drift_m, s.vio_drift_m_per_m, s.vio_drift_deg, s.vio_drift_deg_per_root_m)


def _limits(s: SfmSettings) -> PairLimits:
    return PairLimits(_drift(s), float(np.radians(s.vio_gravity_deg)), float(np.radians(s.vio_direction_deg)))


def _can_see(s: SfmSettings, vio: Odometry, pairs: Pairs) -> NDArray[np.bool_]:
    """Whether the frames of each pair are near enough by VIO to see the same thing, its drift allowed for, (P,)."""
    drift_m, drift_rad = drift_between(vio, pairs, _drift(s))
    reach_m, reach_deg = s.vio_max_distance_m + drift_m, s.vio_max_angle_deg + np.degrees(drift_rad)
    return within_vio_limits(pairs, vio.session, vio.vio_T_cam, reach_m, reach_deg)


def _compare(s: SfmSettings, scene: _Scene, database: Path, matched: MatchedPairs) -> MatchedPairs:
    """The pairs with inliers enough held against VIO. UserError where most of a session's disagree: then it isn't the
    pairs that are wrong."""
    rows = np.flatnonzero(matched.enough)
    pairs = matched.pairs[rows]
    a_T_b, compared = compare_pairs(database, pairs, scene.vio, _limits(s))
    session, vio_T_cam = scene.vio.session, scene.vio.vio_T_cam
    for name in np.unique(session):
        own = (session[pairs] == name).all(axis=1) & np.isfinite(compared.rotation)
        wrong = int(np.count_nonzero(~compared.agrees[own]))
        if own.sum() >= _FEWEST_COMPARED and wrong > own.sum() / 2:
            a, b = pairs[own].T
            motions = compare_motions(a_T_b[own], relative(vio_T_cam[a], vio_T_cam[b]), common_scale=False)
            raise UserError(
                f"the images of session {name} move otherwise than its VIO",
                expected="relative motions that agree, drift allowed for, in all but a few pairs of frames",
                found=f"{wrong} of {own.sum()} verified pairs disagree"
                + (f"; the images are {motions.mistake} to the poses" if motions.mistake else ""),
                do="look at how this session was exported: mirrored or turned images, images in another order than "
                "their poses, or wrong intrinsics; or leave the session out",
            )
    return replace(matched, compared=compared.selected(rows, len(matched.pairs)))


def _mapping_input(mapping: Path) -> Path:
    """The database of what goes into the mapping of that folder."""
    return mapping.with_suffix(".db")


def _map(
    r: StageRun[SfmSettings], s: SfmSettings, scene: _Scene, database: Path, matched: MatchedPairs, folder: Path
) -> list[BuiltModel]:
    if not matched.verified.any():
        return []
    if not folder.is_dir():
        target, vio = _mapping_input(folder), scene.vio
        verified = (database, target, scene.frames, matched.pairs[matched.verified], s.held_out, r.seed)
        given = MappingInput(target, scene.images, vio.vio_T_cam, vio.session, r.seed)
        arguments = (verified, given, s.mapper, s.component_frames, folder)
        task = Task(map_verified, arguments, len(scene.names))
        in_child("mapping", scene.log, _TOO_LITTLE, task)
    return read_built(folder)


def _refine(r: StageRun[SfmSettings], scene: _Scene, mapped: _Mapped) -> _Kept:
    """The models that were kept, with focal lengths refined where the settings ask for it and it helps."""
    kept, frames, model = kept_models(mapped.built), scene.frames, mapped.model
    assert model is not None  # what is taken has one
    as_captured = _Kept(kept, mapped.folder, model, frames, np.ones(len(frames)), [])
    if r.settings.refine_intrinsics == "never":
        return as_captured
    first = first_estimates(model, kept, frames, r.settings.focal_limit)
    if all(scale.decision for own in first for scale in own):
        return replace(as_captured, tried=[scale for own in first for scale in own])
    folder = mapped.folder.with_name(mapped.folder.name + "_refined")
    if not folder.is_dir():
        matches = read_matches(_mapping_input(mapped.folder))
        arguments = (mapped.folder, kept, first, frames, matches, r.settings, folder)
        in_child("refining focal lengths", scene.log, _TOO_LITTLE, Task(refine_models, arguments, len(kept)))
    refined, scales_of = read_refined(folder)
    tried = [scale for own in scales_of for scale in own]
    if not any(scale.decision == REFINED for scale in tried):
        return replace(as_captured, tried=tried)
    applied = {(number, scale.session_id): scale.applied for number, own in enumerate(scales_of) for scale in own}
    of_frame = zip(model.model.tolist(), frames["session_id"], strict=True)
    focal_scale = np.array([applied.get(key, 1.0) for key in of_frame])
    model = load_models([folder / told.folder for told in refined], len(frames))
    return _Kept(refined, folder, model, with_focal_scales(frames, focal_scale), focal_scale, tried)


def _covariance(r: StageRun[SfmSettings], frames: pd.DataFrame, model: Model, kept: list[BuiltModel]) -> Array:
    """(N, 6, 6), NaN for frames without one."""
    covariance = np.full((len(frames), 6, 6), np.nan)
    for number, told in enumerate(kept):
        if told.images > r.settings.covariance_max_images:
            r.say(f"no covariances: more than {r.settings.covariance_max_images} frames (sfm.covariance_max_images)")
            continue
        part = model.part(number)
        known = part.registered
        row = np.cumsum(known) - 1
        blocks = pose_covariance(
            part.sfm_T_cam[known],
            frames[["fx", "fy"]].to_numpy(float)[known],
            part.xyz,
            row[part.frame],
            part.point,
            part.residual_px,
            told.loss_px,
            part.blobs(),
        )
        if blocks is None:
            r.say(f"no covariances: model {told.model_id} has too few points to tell")
        else:
            covariance[known] = blocks
    return covariance


STAGE = Stage(
    name="sfm",
    version=9,
    settings=SfmSettings,
    needs=("import",),
    run=run,
    help="Structure from motion: features, pairs from time, VIO and looks, checked against VIO; models over all "
    "sessions, one where the images allow it, and their quality.",
)
