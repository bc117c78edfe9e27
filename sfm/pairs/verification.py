"""From proposed pairs to verified ones: matching, the comparison with VIO, and further matches where they are few."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from groundwalk.consistency.motions import MISTAKE_ADVICE, MISTAKE_REASONS, compare_motions
from groundwalk.geometry.poses import relative
from groundwalk.sfm.database import Workspace, has_results, read_pair_results
from groundwalk.sfm.mapping.held_out import VerifiedPairs
from groundwalk.sfm.pairs.candidates import broken_links, first_origins
from groundwalk.sfm.pairs.floor import FloorSource, match_floor
from groundwalk.sfm.pairs.matched import LINK_INLIERS, MIN_INLIERS, are_verified, are_weak, matched_pairs, rows_of
from groundwalk.sfm.pairs.matching import guide_pairs, match_pairs
from groundwalk.sfm.pairs.neighbours import NEXT, contradicted_pairs
from groundwalk.sfm.pairs.odometry import Odometry
from groundwalk.sfm.pairs.selection import Proposals, pairs_of_chains
from groundwalk.sfm.pairs.two_views import compare_pairs
from groundwalk.sfm.plugins import MappingInput
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import UserError
from groundwalk.store.child import Task
from groundwalk.store.choices import PairInconsistency, PairOrigin
from groundwalk.store.text import name_list

_MIN_COMPARED_PAIRS = 8


def match_proposals(
    settings: SfmSettings,
    vio: Odometry,
    proposals: Proposals,
    database: Path,
    work: Workspace,
    seed: int,
    is_new: NDArray[np.bool_],
) -> pd.DataFrame:
    """Match and verify the proposals, then pairs that both match a third frame (module `matched`); only pairs with a
    new frame (N,)."""
    proposals = [(origin, pairs[is_new[pairs].any(axis=1)]) for origin, pairs in proposals]

    def match(text: str) -> pd.DataFrame:
        pairs, origin = first_origins(proposals, len(vio.session))
        if not has_results(database, pairs).all():
            work.in_child(text, Task(match_pairs, (database, pairs, seed), len(pairs)))
        return matched_pairs(pairs, origin, *read_pair_results(database, pairs))

    matched = match("matching pairs")
    chains = pairs_of_chains(settings, vio, rows_of(matched), matched["inliers"].to_numpy(np.int64))
    chains = chains[is_new[chains].any(axis=1)]
    if len(chains):
        proposals = [*proposals, (PairOrigin.TRANSITIVE, chains)]
        matched = match("matching pairs that share a partner")
    return matched


def compared_with_vio(matched: pd.DataFrame, vio: Odometry, database: Path) -> pd.DataFrame:
    """The pairs with enough inliers compared with VIO. UserError where most of a session's are inconsistent: then its
    input is wrong, not its pairs."""
    columns = (matched[name].to_numpy() for name in ("origin", "matches", "inliers"))
    matched = matched_pairs(rows_of(matched), *columns)
    rows = np.flatnonzero(matched["inliers"] >= MIN_INLIERS)
    pairs = rows_of(matched)[rows]
    a_T_b, compared = compare_pairs(database, pairs, vio)
    is_wrong = (compared["reason"] != PairInconsistency.NONE).to_numpy()
    for name in np.unique(vio.session):
        members = (vio.session[pairs] == name).all(axis=1) & compared["rotation"].notna().to_numpy()
        inconsistent = int(np.count_nonzero(is_wrong[members]))
        if members.sum() >= _MIN_COMPARED_PAIRS and inconsistent > members.sum() / 2:
            a, b = pairs[members].T
            by_vio = relative(vio.vio_T_cam[a], vio.vio_T_cam[b])
            mistake = compare_motions(a_T_b[members], by_vio, common_scale=False).mistake
            look = "look at how the session was exported, and at its intrinsics; or leave the session out"
            reason = f"; {MISTAKE_REASONS[mistake]}" if mistake else ""
            raise UserError(
                f"images and VIO of session {name} are inconsistent",
                expected="the same relative motions, within VIO's drift, in all but a few pairs of frames",
                found=f"{inconsistent} of {members.sum()} verified pairs inconsistent with VIO{reason}",
                do=MISTAKE_ADVICE[mistake] if mistake else look,
            )
    for column in compared:
        matched.loc[rows, column] = compared[column].to_numpy()
    return matched


def compared_with_neighbours(
    matched: pd.DataFrame,
    is_alone_N: NDArray[np.bool_],
    vio: Odometry,
    source: FloorSource,
    database: Path,
    work: Workspace,
    seed: int,
) -> pd.DataFrame:
    """Verified pairs of images that are alone, without any pose, and far apart in the order of their recording,
    compared with the map that neighbours make."""
    order = np.lexsort((vio.t_ns, vio.recording.astype(str)))
    is_next_recording = vio.recording[order[1:]] != vio.recording[order[:-1]]
    place_N = np.empty(len(order), np.int64)
    place_N[order] = np.arange(len(order)) + (NEXT + 1) * np.cumsum(np.concatenate([[False], is_next_recording]))
    a, b = rows_of(matched).T
    rows = np.flatnonzero(are_verified(matched) & is_alone_N[a] & (vio.recording[a] == vio.recording[b]))
    if not (np.abs(place_N[a[rows]] - place_N[b[rows]]) > NEXT).any():
        return matched
    pairs = VerifiedPairs(
        frames=source.frames, pairs=rows_of(matched)[rows], matched=database, features=source.features
    )
    arguments = (pairs, place_N, MappingInput(work.scratch / "neighbours.db", work.images, seed))
    is_wrong = work.in_child("mapping neighbours", Task(contradicted_pairs, arguments, int(is_alone_N.sum())))
    matched.loc[matched.index[rows[is_wrong]], "reason"] = PairInconsistency.NEIGHBOURS
    return matched


def with_floor_matches(
    matched: pd.DataFrame,
    source: FloorSource,
    vio: Odometry,
    database: Path,
    work: Workspace,
    say: Callable[[str], None],
) -> pd.DataFrame:
    """Weak pairs matched by the floor, too, in recordings of which neighbouring frames have no verified pair that could
    link them: there a model would break. They were compared with VIO, and are to be again."""
    pairs = rows_of(matched)
    is_link = are_verified(matched) & (matched["inliers"] >= LINK_INLIERS).to_numpy()
    broken = broken_links(vio.recording, vio.t_ns, pairs[is_link])
    within = vio.session[pairs[:, 0]] == vio.session[pairs[:, 1]]
    broken = broken[np.isin(vio.recording[broken[:, 0]], vio.recording[pairs[within, 0]])]  # not of a map that is held
    can_be_drawn = np.isfinite(vio.gravity_cam).all(axis=1) & vio.posed
    can_be_drawn &= np.isin(vio.recording, vio.recording[broken[:, 0]])
    chosen = are_weak(matched) & can_be_drawn[pairs].all(axis=1) & within
    if not chosen.any():
        return matched
    arguments = (database, source, vio, pairs[chosen], are_verified(matched)[chosen])
    work.in_child("matching the floor", Task(match_floor, arguments, int(chosen.sum())))
    inliers = read_pair_results(database, pairs)[1]
    frames = source.frames["frame_id"]
    links = [f"{frames[first]} and {frames[second]}" for first, second in broken.tolist()]
    say(
        f"neighbouring frames without a verified pair of {LINK_INLIERS} inliers: {name_list(links, 3)}; features of "
        f"the floor as seen from above add matches to {np.count_nonzero(inliers != matched['inliers'])} of "
        f"{chosen.sum()} pairs there"
    )
    return matched.assign(inliers=inliers)


def with_guided_matches(
    matched: pd.DataFrame, compared: pd.DataFrame, vio: Odometry, database: Path, work: Workspace
) -> pd.DataFrame:
    """Weak pairs with enough inliers matched a second time, along their epipolar lines; compared with VIO again where
    inliers of any pair have changed since they were `compared`."""
    pairs = rows_of(matched)
    chosen = pairs[are_weak(matched) & (matched["inliers"] >= MIN_INLIERS).to_numpy()]
    if len(chosen):
        work.in_child("matching weak pairs", Task(guide_pairs, (database, chosen), len(chosen)))
    matched = matched.assign(inliers=read_pair_results(database, pairs)[1])
    return matched if matched["inliers"].equals(compared["inliers"]) else compared_with_vio(matched, vio, database)
