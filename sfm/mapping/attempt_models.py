"""One attempt at models: features, pairs, matching, mapping, and the check against VIO."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from groundwalk.consistency.motions import MISTAKE_ADVICE, MISTAKE_REASONS, compare_motions
from groundwalk.geometry.poses import relative
from groundwalk.sfm.database import has_results, keypoint_counts, read_pair_results
from groundwalk.sfm.mapping.attempts import Attempt, outcome_of
from groundwalk.sfm.mapping.build import BuiltModel, build_models, read_built, selected_models
from groundwalk.sfm.mapping.mappers import MappingInput
from groundwalk.sfm.mapping.source import VerifiedPairs
from groundwalk.sfm.model import Model, load_models
from groundwalk.sfm.pairs.candidates import broken_links, first_origins
from groundwalk.sfm.pairs.floor import tie_by_floor
from groundwalk.sfm.pairs.matching import LINK_INLIERS, MatchedPairs, guide_pairs, match_pairs
from groundwalk.sfm.pairs.odometry import PairLimits, nothing_compared
from groundwalk.sfm.pairs.selection import Proposals, pairs_by_images, pairs_of_chains, pairs_within_sessions
from groundwalk.sfm.pairs.two_views import compare_pairs
from groundwalk.sfm.quality.focal_steps import MAX_FOCAL_ERROR, FocalStep
from groundwalk.sfm.quality.model_check import check_models
from groundwalk.sfm.quality.zoom import zoom_of_session
from groundwalk.sfm.scene_input import SceneInput, calibrated_features
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import StageRun, UserError
from groundwalk.store.child import Task
from groundwalk.store.choices import AttemptName, AttemptOutcome, PairOrigin
from groundwalk.store.hints import setting_of
from groundwalk.store.text import name_list

_MIN_COMPARED_PAIRS = 8


@dataclass(frozen=True, kw_only=True)
class AttemptModels:
    """What an attempt made: its settings, its pairs, its keypoint counts (N,), and all models in `folder`; `model` are
    the selected ones, None where there is none. `zooms`, by session, are what makes them inconsistent with VIO."""

    settings: SfmSettings
    matched: MatchedPairs
    keypoints: NDArray[np.int64]
    built: list[BuiltModel]
    folder: Path
    model: Model | None
    zooms: dict[str, FocalStep]

    @property
    def mapping_input(self) -> Path:
        """The database that was mapped."""
        return self.folder.with_suffix(".db")

    @property
    def selected(self) -> list[BuiltModel]:
        """The selected models, the largest first."""
        return selected_models(self.built)


def attempt_models(
    r: StageRun[SfmSettings], scene: SceneInput, number: int, name: AttemptName, settings: SfmSettings
) -> tuple[Attempt, AttemptModels]:
    """Make models with these settings and check them against VIO; what an earlier, killed run did is reused."""
    database = calibrated_features(r, scene, settings)
    with r.step("pairs"):
        proposals = pairs_within_sessions(settings, scene.frames, scene.recording_N, scene.vio)
        proposals += pairs_by_images(settings, scene.recording_N, scene.vio, proposals, database, r.seed)
    folder = scene.scratch / f"mapping_{number}"
    with r.step("matching"):
        matched = _matched(r, scene, settings, database, proposals, scene.scratch / f"matched_{number}")
    with r.step("mapping"):
        built = _map(r.seed, settings, scene, database, matched, folder)
    selected = selected_models(built)
    model, consistent, faults = None, np.zeros(len(scene.names), bool), []
    with r.step("check"):
        if selected:
            model = load_models([folder / entry.folder for entry in selected], len(scene.names))
            t_ns = scene.frames["t_ns"].to_numpy(np.int64)
            check = check_models(model.sfm_T_cam, model.model, scene.vio, scene.recording_N, t_ns, settings.vio_drift)
            consistent = check.consistent
            faults = [
                f"the images of session {session} turn {gain:.2f} times as far as its VIO, so its focal length is wrong"
                for session, gain in check.turn_gains.items()
            ]
        sizes = [entry.images for entry in selected]
        outcome = outcome_of(sizes, int(consistent.sum()), len(scene.names), settings)
        zooms: dict[str, FocalStep] = {}
        if model is not None and outcome is AttemptOutcome.INCONSISTENT_WITH_VIO:
            zooms = _zooms(settings, scene, database, scene.vio.session[model.registered & ~consistent])
    attempt = Attempt(
        name=name,
        mapper=settings.mapper,
        pairs=len(matched.pairs),
        verified=int(matched.verified.sum()),
        model_frames=sizes,
        consistent=int(consistent.sum()),
        outcome=outcome,
        input_fault=", ".join([*faults, *(f"the focal length of session {session} changes" for session in zooms)]),
        has_vio=bool(scene.vio.posed.any()),
    )
    keypoints = keypoint_counts(database, len(scene.names))
    return attempt, AttemptModels(
        settings=settings, matched=matched, keypoints=keypoints, built=built, folder=folder, model=model, zooms=zooms
    )


def _matched(
    r: StageRun[SfmSettings],
    scene: SceneInput,
    settings: SfmSettings,
    database: Path,
    proposals: Proposals,
    folder: Path,
) -> MatchedPairs:
    """The proposals, and pairs that both match a third frame, matched and compared with VIO.

    Floor features and guided matches replace results in the database, by which they were chosen, too: `folder` has what
    each was chosen by, so that a killed run makes the same choices when it goes on.
    """
    folder.mkdir(exist_ok=True)

    def kept(name: str, make: Callable[[], MatchedPairs]) -> MatchedPairs:
        path = folder / f"{name}.npz"
        if not path.is_file():
            make().save(path)
        return MatchedPairs.load(path)

    def first() -> MatchedPairs:
        return _compared_with_vio(settings, scene, database, _match(r.seed, settings, scene, database, proposals))

    def tied() -> MatchedPairs:
        matched = kept("first", first)
        return _tied_by_floor(r, settings, scene, database, matched) if settings.floor_features else matched

    def last() -> MatchedPairs:
        matched = _guided(settings, scene, database, kept("tied", tied))
        is_changed = not np.array_equal(matched.inliers, kept("first", first).inliers)
        return _compared_with_vio(settings, scene, database, matched) if is_changed else matched

    return kept("last", last)


def _match(seed: int, settings: SfmSettings, scene: SceneInput, database: Path, proposals: Proposals) -> MatchedPairs:
    """Match and verify the proposals, then pairs that both match a third frame."""

    def match(text: str) -> MatchedPairs:
        pairs, origin = first_origins(proposals, len(scene.names))
        if not has_results(database, pairs).all():
            arguments = (database, pairs, settings, seed)
            scene.in_child(text, Task(match_pairs, arguments, len(pairs)))
        matches, inliers = read_pair_results(database, pairs)
        return MatchedPairs(pairs, origin, matches, inliers, settings.min_inliers, nothing_compared(len(pairs)))

    matched = match("matching pairs")
    if settings.transitive_pairs:
        more = pairs_of_chains(settings, scene.vio, matched.pairs, matched.inliers)
        proposals = [*proposals, (PairOrigin.TRANSITIVE, more)]
        matched = match("matching pairs that share a partner")
    return matched


def _tied_by_floor(
    r: StageRun[SfmSettings], settings: SfmSettings, scene: SceneInput, database: Path, matched: MatchedPairs
) -> MatchedPairs:
    """Of pairs that were compared with VIO, those with few inliers matched by the floor, too, in recordings of which
    neighbouring frames have no verified pair that could link them: there a model would break."""
    broken = broken_links(scene.recording_N, scene.frames["t_ns"], matched.pairs[matched.links])
    can_be_drawn = np.isfinite(scene.vio.gravity_cam).all(axis=1) & scene.vio.posed
    can_be_drawn &= np.isin(scene.recording_N, scene.recording_N[broken[:, 0]])
    a, b = matched.pairs.T
    chosen = matched.has_few_inliers & matched.of_poor_frames & (can_be_drawn[a] & can_be_drawn[b])
    chosen &= scene.vio.session[a] == scene.vio.session[b]
    pairs = matched.pairs[chosen]
    if not len(pairs):
        return matched
    task = Task(
        tie_by_floor, (database, scene.floor_source(settings), scene.vio, pairs, matched.verified[chosen]), len(pairs)
    )
    scene.in_child("matching the floor", task)
    tied = replace(matched, inliers=read_pair_results(database, matched.pairs)[1])
    frames = scene.frames["frame_id"]
    links = [f"{frames[first]} and {frames[second]}" for first, second in broken.tolist()]
    r.say(
        f"neighbouring frames without a verified pair of {LINK_INLIERS} inliers: {name_list(links, 3)}; features of "
        f"the floor as seen from above tie {np.count_nonzero(tied.inliers != matched.inliers)} of {len(pairs)} pairs "
        f"there ({setting_of('sfm', 'floor_features')})"
    )
    return tied


def _guided(settings: SfmSettings, scene: SceneInput, database: Path, matched: MatchedPairs) -> MatchedPairs:
    """Weak pairs matched a second time."""
    weak = matched.pairs[matched.weak]
    if not len(weak):
        return matched
    scene.in_child("matching weak pairs", Task(guide_pairs, (database, weak), len(weak)))
    return replace(matched, inliers=read_pair_results(database, matched.pairs)[1])


def _compared_with_vio(settings: SfmSettings, scene: SceneInput, database: Path, matched: MatchedPairs) -> MatchedPairs:
    """The pairs with enough inliers compared with VIO. UserError where most of a session's are inconsistent: then its
    input is wrong, not its pairs."""
    limits = PairLimits(
        settings.vio_drift,
        float(np.radians(settings.vio_gravity_deg)),
        float(np.radians(settings.vio_direction_deg)),
    )
    rows = np.flatnonzero(matched.has_enough_inliers)
    pairs = matched.pairs[rows]
    a_T_b, compared = compare_pairs(database, pairs, scene.vio, limits)
    session, vio_T_cam = scene.vio.session, scene.vio.vio_T_cam
    for name in np.unique(session):
        members = (session[pairs] == name).all(axis=1) & np.isfinite(compared.rotation)
        inconsistent = int(np.count_nonzero(~compared.consistent[members]))
        if members.sum() >= _MIN_COMPARED_PAIRS and inconsistent > members.sum() / 2:
            a, b = pairs[members].T
            motions = compare_motions(a_T_b[members], relative(vio_T_cam[a], vio_T_cam[b]), common_scale=False)
            mistake = motions.mistake
            look = "look at how the session was exported, and at its intrinsics; or leave the session out"
            reason = f"; {MISTAKE_REASONS[mistake]}" if mistake else ""
            raise UserError(
                f"images and VIO of session {name} are inconsistent",
                expected="the same relative motions, within VIO's drift, in all but a few pairs of frames",
                found=f"{inconsistent} of {members.sum()} verified pairs inconsistent with VIO{reason}",
                do=MISTAKE_ADVICE[mistake] if mistake else look,
            )
    return replace(matched, compared=compared.scattered(rows, len(matched.pairs)))


def _zooms(
    settings: SfmSettings, scene: SceneInput, database: Path, sessions: NDArray[np.object_]
) -> dict[str, FocalStep]:
    """Of these sessions, those whose focal length changes, and where."""
    zooms = {}
    for session in sorted(set(sessions.tolist())):
        rows = np.flatnonzero(scene.vio.session == session)
        rows = rows[np.argsort(scene.frames["t_ns"].to_numpy(np.int64)[rows], kind="stable")]
        zoom = zoom_of_session(database, rows, scene.vio, MAX_FOCAL_ERROR)
        if zoom is not None:
            zooms[str(session)] = zoom
    return zooms


def _map(
    seed: int, settings: SfmSettings, scene: SceneInput, database: Path, matched: MatchedPairs, folder: Path
) -> list[BuiltModel]:
    if not matched.verified.any():
        return []
    if not folder.is_dir():
        verified = VerifiedPairs(
            frames=scene.frames,
            pairs=matched.pairs[matched.verified],
            matched=database,
            features=scene.features_file(settings),
        )
        vio, target = scene.vio, folder.with_suffix(".db")
        source = MappingInput(target, scene.images, vio.vio_T_cam, vio.session, seed)
        task = Task(build_models, (verified, source, scene.cameras, settings, folder), len(scene.names))
        scene.in_child("mapping", task)
    return read_built(folder)
