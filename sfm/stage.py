"""The sfm stage: import's frames in, COLMAP models over all sessions out, one where the images allow it."""

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.artefacts import Stage, StageRun, UserError
from groundwalk.artefacts.child import Task, in_child
from groundwalk.artefacts.tables import poses_of, with_cameras
from groundwalk.consistency.motions import compare_motions
from groundwalk.consistency.vio_drift import VioDrift
from groundwalk.geometry.poses import Array, relative
from groundwalk.sfm.adjustment import Adjusted
from groundwalk.sfm.calibration import Calibration, calibrate, with_lenses, write_calibrated_database
from groundwalk.sfm.covariance import Covariances, covariances
from groundwalk.sfm.database import (
    create_database,
    have_features,
    have_results,
    image_name,
    keypoint_counts,
    read_descriptors,
    read_pair_results,
)
from groundwalk.sfm.extensions import MAPPERS, RETRIEVALS, described_by
from groundwalk.sfm.features import extract_features, features_name
from groundwalk.sfm.ladder import OTHERWISE, Attempt, climb, outcome_of
from groundwalk.sfm.mappers import MappingInput
from groundwalk.sfm.mapping import BuiltModel, kept_models, map_verified, read_built
from groundwalk.sfm.mapping_input import HeldOutCheck, held_out_check, read_matches
from groundwalk.sfm.matching import ONE_THREAD, MatchedPairs, match_pairs, try_networks
from groundwalk.sfm.model import Model, blobs_of, load_models
from groundwalk.sfm.model_adjustment import CameraLog, camera_log, cameras_of_frames, load_adjusted
from groundwalk.sfm.model_check import check_models
from groundwalk.sfm.networks import model_files, require_model_files
from groundwalk.sfm.odometry import Odometry, PairLimits, drift_between, nothing_compared, odometry
from groundwalk.sfm.pairs import (
    Pairs,
    first_origins,
    sequence_pairs,
    strongest_pairs,
    transitive_pairs,
    unique_pairs,
    vio_pairs,
    within_vio_limits,
)
from groundwalk.sfm.recording import write_recording
from groundwalk.sfm.residuals import draw_residuals, pattern_of, residual_patterns
from groundwalk.sfm.retrieval import retrieval_pairs
from groundwalk.sfm.settings import SfmSettings
from groundwalk.sfm.tables import (
    attempts_table,
    camera_tables,
    images_table,
    models_table,
    pairs_table,
    points_table,
)
from groundwalk.sfm.two_views import compare_pairs

RESIDUALS_PICTURE = "residuals.png"
_FEWEST_FRAMES = 3
_FEWEST_COMPARED = 8
_UNTRACKED = ("limited", "lost")
_INCOHERENT = 4.0


# An error on one of COLMAP's threads aborts the process that it runs in, hence child processes.
_TOO_LITTLE = "too little memory needs a smaller sfm.max_image_size or sfm.max_features"


@dataclass(frozen=True)
class _Scene:
    """The frames with their lenses, what VIO knows of them, and the files that COLMAP works on."""

    frames: pd.DataFrame
    cameras: CameraLog
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


def run(r: StageRun[SfmSettings]) -> None:
    scene = _calibrated(r, _prepare(r))
    attempts, taken, mapped = _climb(r, scene)
    frame_ids = list(scene.frames["frame_id"])
    kept, model = kept_models(mapped.built), mapped.model
    assert model is not None  # what is taken has one
    with r.step("quality"):
        parts = [load_adjusted(mapped.folder / f"{one.folder}.npz") for one in kept]
        cameras = cameras_of_frames(scene.cameras, parts)
        covariance, estimates = _covariances(r, model, kept, parts)
        matches = read_matches(_mapping_input(mapped.folder))
        check = held_out_check(matches, cameras, model.sfm_T_cam, model.model)
        uses_vio = mapped.settings.mapper == "vio"
        images = images_table(frame_ids, model, kept, mapped.keypoints, check, cameras, covariance, uses_vio)
        images["camera_origin"] = [scene.cameras.calibration.lenses[k].origin for k in scene.cameras.calibration.lens]
    r.write("images", images)
    r.write("models", models_table(mapped.built, check))
    lenses, intrinsics = camera_tables(scene.cameras, kept, parts, estimates)
    r.write("lenses", lenses)
    r.write("intrinsics", intrinsics)
    residuals = _residuals(r, scene, kept, parts)
    r.write("residuals", residuals)
    draw_residuals(r.work / RESIDUALS_PICTURE, residuals)
    r.write("attempts", attempts_table(attempts, taken))
    r.write("pairs", pairs_table(frame_ids, mapped.matched))
    r.write("points", points_table(model, kept))
    for told in kept:
        shutil.copytree(mapped.folder / told.folder, r.work / told.folder, dirs_exist_ok=True)
    with r.step("recording"):
        frames = with_cameras(scene.frames, images)
        write_recording(r, frames, model, mapped.matched)
    _tell(r, mapped, kept, check, attempts[taken], len(attempts))
    _say_cameras(r, lenses, intrinsics)


def _tell(
    r: StageRun[SfmSettings],
    mapped: _Mapped,
    kept: list[BuiltModel],
    check: HeldOutCheck,
    taken: Attempt,
    attempts: int,
) -> None:
    model = mapped.model
    assert model is not None  # what is taken has one
    registered = int(model.registered.sum())
    disagree = int((mapped.matched.verdict == "disagrees").sum())
    track_length = float(model.track_lengths().mean())
    error_px = float(np.linalg.norm(model.residual_px, axis=1).mean())
    figures: dict[str, float | str | None] = {
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


def _residuals(
    r: StageRun[SfmSettings], scene: _Scene, kept: list[BuiltModel], parts: list[tuple[Adjusted, NDArray[np.int64]]]
) -> pd.DataFrame:
    """Table residuals of all models; a line for each lens whose residuals show a pattern."""
    tables = []
    for one, (adjusted, rows) in zip(kept, parts, strict=True):
        calibration = scene.cameras.calibration
        lens_ids = [calibration.lenses[k].lens_id for k in np.unique(calibration.lens[rows])]
        tables.append(residual_patterns(one.model_id, lens_ids, adjusted))
        for lens_id, residuals in tables[-1].groupby("lens_id", sort=True):
            if pattern := pattern_of(residuals):
                r.say(
                    f"model {one.model_id}, lens of {lens_id}: residuals look like a {pattern[0]} that isn't modelled "
                    f"({pattern[1]:.2f} px, {RESIDUALS_PICTURE})"
                )
    return pd.concat(tables, ignore_index=True)


def _say_cameras(r: StageRun[SfmSettings], lenses: pd.DataFrame, intrinsics: pd.DataFrame) -> None:
    """One line a lens, and one a session whose focal lengths are far from the logged ones."""
    for lens in lenses.to_dict("records"):
        r.say(
            f"lens of {lens['lens_id']}: k1 {lens['k1']:.4f} ± {lens['k1_sd']:.4f}, k2 {lens['k2']:.4f} ± "
            f"{lens['k2_sd']:.4f}, readout {1000 * lens['readout_s']:.1f} ± {1000 * lens['readout_sd_s']:.1f} ms "
            f"({lens['origin']})"
        )
        if lens["stated_is_wrong"]:
            r.say(
                f"lens of {lens['lens_id']}: the STATED DISTORTION IS LIKELY WRONG (k1 {lens['stated_k1']:.4f}, k2 "
                f"{lens['stated_k2']:.4f}): held-out matches are off by {lens['heldout_stated_px']:.2f} px with it, "
                f"{lens['heldout_px']:.2f} px with the estimated lens, which is used"
            )
    for session in intrinsics.to_dict("records"):
        if abs(session["focal_scale"] - 1) >= r.settings.focal_limit:
            r.say(
                f"session {session['session_id']}: its logged focal lengths are likely wrong: the images say "
                f"{100 * (session['focal_scale'] - 1):+.2f} % ± {100 * session['focal_scale_sd']:.2f} %, beyond "
                f"{100 * r.settings.focal_limit:g} % (sfm.focal_limit)"
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
        link = images / name
        if not link.is_symlink():
            link.parent.mkdir(parents=True, exist_ok=True)
            link.symlink_to(source.absolute())
        names.append(name)
    devices = r.read("import", "sessions").set_index("session_id")["device"]
    cameras = camera_log(frames, dict(zip(devices.index, devices, strict=True)), r.read("import", "vio"), r.settings)
    return _Scene(
        with_lenses(frames, cameras.calibration),
        cameras,
        frames["session_id"].map(recordings).to_numpy(),
        _odometry(frames, r.read("import", "jumps")),
        names,
        images,
        r.scratch,
        log,
    )


def _features(r: StageRun[SfmSettings], scene: _Scene, settings: SfmSettings) -> Path:
    """The database with the features as they were found, extracted where that hasn't been done."""
    database = _features_file(scene, settings)
    create_database(database, scene.frames, scene.names)
    if not have_features(database, len(scene.names)):
        with r.step("features"):
            task = Task(extract_features, (database, scene.images, scene.names, settings), len(scene.names))
            in_child("extracting features", scene.log, _TOO_LITTLE, task)
    _require_features(r, keypoint_counts(database, len(scene.names)))
    return database


def _features_file(scene: _Scene, settings: SfmSettings) -> Path:
    return scene.scratch / f"features{features_name(settings)}.db"


def _calibrated(r: StageRun[SfmSettings], scene: _Scene) -> _Scene:
    """The scene with its lenses and readout times as pairs of images tell them."""
    if r.settings.refine_cameras == "never":
        return scene
    path = scene.scratch / "calibration.json"
    if not path.is_file():
        database = _features(r, scene, r.settings)
        with r.step("calibration"):
            pairs = unique_pairs(np.concatenate([pairs for _, pairs in _propose_by_vio(r.settings, scene)]))
            prior, motion = scene.cameras.calibration, scene.cameras.motion
            arguments = (database, scene.frames, scene.names, pairs, prior, motion, r.settings, r.seed, path)
            in_child("calibrating lenses", scene.log, _TOO_LITTLE, Task(calibrate, arguments, None, ONE_THREAD))
    calibration = Calibration.load(path)
    frames = with_lenses(scene.frames, calibration)
    return replace(scene, frames=frames, cameras=replace(scene.cameras, calibration=calibration))


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
    if attempts[taken].outcome == OTHERWISE:
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
    if database not in keypoints:
        features = _features(r, scene, settings)
        with r.step("features"):
            if not database.is_file():
                cameras = (scene.cameras.calibration, scene.cameras.motion)
                arguments = (features, database, scene.frames, scene.names, *cameras)
                task = Task(write_calibrated_database, arguments, len(scene.names))
                in_child("correcting keypoints for the rolling shutter", scene.log, _TOO_LITTLE, task)
        keypoints[database] = keypoint_counts(database, len(scene.names))
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


def _propose_by_vio(s: SfmSettings, scene: _Scene) -> list[tuple[str, Pairs]]:
    """Pairs within sessions, from the order of the frames and from VIO."""
    frames, vio = scene.frames, scene.vio
    # Support frames lie between the dataset's, and pairs are to reach as far as without them.
    density = len(frames) / max(int((~frames["support"]).sum()), 1)
    following = sequence_pairs(scene.recording_N, frames["t_ns"], round(density * s.sequence_pairs))
    # The next frame is always tried: that is what ties a recording together where VIO jumped.
    next_one = sequence_pairs(scene.recording_N, frames["t_ns"], 1)
    near = vio_pairs(
        vio.session,
        vio.vio_T_cam,
        frames[["fx", "fy", "cx", "cy"]].to_numpy(float),
        frames[["width", "height"]].to_numpy(float),
        s.vio_max_distance_m,
        s.vio_max_angle_deg,
        round(density * s.vio_pairs),
    )
    return [
        ("sequence", unique_pairs(np.concatenate([next_one, following[_can_see(s, vio, following)]]))),
        ("vio", near),
    ]


def _propose(seed: int, s: SfmSettings, scene: _Scene, database: Path) -> list[tuple[str, Pairs]]:
    session = scene.vio.session
    alike = unique_pairs([])
    if s.retrieval_pairs and len(set(session)) > 1:
        descriptors = read_descriptors(database, len(session))
        described = described_by(s.retrieval, descriptors, s.retrieval_words, seed)
        alike = retrieval_pairs(described, session, s.retrieval_pairs)
    return [*_propose_by_vio(s, scene), ("retrieval", alike)]


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
        features = _features_file(scene, s)
        verified = (database, features, target, scene.frames, matched.pairs[matched.verified], s.held_out, r.seed)
        given = MappingInput(target, scene.images, vio.vio_T_cam, vio.session, r.seed)
        arguments = (verified, given, features, scene.cameras, s, folder)
        task = Task(map_verified, arguments, len(scene.names))
        in_child("mapping", scene.log, _TOO_LITTLE, task)
    return read_built(folder)


def _covariances(
    r: StageRun[SfmSettings], model: Model, kept: list[BuiltModel], parts: list[tuple[Adjusted, NDArray[np.int64]]]
) -> tuple[Array, list[Covariances | None]]:
    """(N, 6, 6), NaN for frames without one, and what each kept model tells of its frames and cameras."""
    covariance, estimates = np.full((len(model.model), 6, 6), np.nan), []
    for one, (adjusted, rows) in zip(kept, parts, strict=True):
        estimate = None
        if one.images > r.settings.covariance_max_images:
            r.say(f"no covariances: more than {r.settings.covariance_max_images} frames (sfm.covariance_max_images)")
        elif (estimate := covariances(adjusted, blobs_of(adjusted.scene))) is None:
            r.say(f"no covariances: model {one.model_id} has too few points to tell")
        else:
            covariance[rows] = estimate.poses
            r.figure(f"coherence_rows_{one.folder}", estimate.by_rows)
            r.figure(f"coherence_cells_{one.folder}", estimate.by_cell)
            if estimate.by_rows > _INCOHERENT:
                times = f"{estimate.by_rows:.0f} times what independent ones do"
                r.say(
                    f"model {one.model_id}: residuals hang together in rows of frames ({times}): a rolling shutter, "
                    "focus or stabilised video isn't modelled; sigmas grow"
                )
        estimates.append(estimate)
    return covariance, estimates


STAGE = Stage(
    name="sfm",
    version=12,
    settings=SfmSettings,
    needs=("import",),
    run=run,
    plugins=lambda settings: {**MAPPERS.versions([settings.mapper]), **RETRIEVALS.versions([settings.retrieval])},
    help="Structure from motion: features, pairs from time, VIO and looks, checked against VIO; models over all "
    "sessions, one where the images allow it, and their quality.",
    reads_images=lambda settings: True,
)
