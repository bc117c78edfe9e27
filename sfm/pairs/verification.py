"""From proposed pairs to verified ones: matching, the comparison with VIO, and further matches where they are few.

Pairs of images without odometry are held against the map that neighbouring images alone make. Of two doors of a
corridor the images agree within a pixel, and a map of all pairs that agree folds there. Photos of a walk and frames of
a video have an order: a map of neighbours has no such pair in it; it drifts, but doesn't fold. Images that are farther
apart in the order have to see the same points of that map, within its drift.
"""

import itertools
import shutil
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray

from groundwalk.consistency.motions import MISTAKE_ADVICE, MISTAKE_REASONS, compare_motions
from groundwalk.geometry.poses import Array, path_length, relative
from groundwalk.sfm.database import Ints, has_results, image_id, read_pair_results
from groundwalk.sfm.mapping.held_out import VerifiedPairs, write_mapping_input
from groundwalk.sfm.mapping.mappers import incremental_mapping
from groundwalk.sfm.pairs.candidates import broken_links, first_origins
from groundwalk.sfm.pairs.floor import PairSource, match_floor
from groundwalk.sfm.pairs.matched import LINK_INLIERS, MIN_INLIERS, are_verified, are_weak, matched_pairs, rows_of
from groundwalk.sfm.pairs.matching import guide_pairs, match_pairs
from groundwalk.sfm.pairs.selection import Proposals, pairs_of_chains
from groundwalk.sfm.pairs.two_views import compare_pairs
from groundwalk.sfm.plugins import MappingInput
from groundwalk.sfm.settings import SfmSettings
from groundwalk.store import UserError
from groundwalk.store.child import Report, Task
from groundwalk.store.choices import PairInconsistency, PairOrigin
from groundwalk.store.text import name_list

_MIN_COMPARED_PAIRS = 8
NEXT = 10
"""Images so many places apart in the order, or fewer, are neighbours."""
_MIN_FRAMES = 10  # smaller maps say nothing, as of photos in no order
_MIN_POINTS = 5
# How far a map may drift, as a fraction of the way between two images and of their distance to its points.
_DRIFT = 0.1
# Where the map of neighbours breaks, these pairs between its parts have to agree on where the parts are, or none is
# right: of the real corridor's, all of which are wrong, a fifth does.
_MIN_AGREEING = 0.5


def match_proposals(
    settings: SfmSettings, source: PairSource, proposals: Proposals, is_new: NDArray[np.bool_]
) -> pd.DataFrame:
    """Match and verify the proposals, then pairs that both match a third frame (module `matched`); only pairs with a
    new frame (N,)."""
    proposals = [(origin, pairs[is_new[pairs].any(axis=1)]) for origin, pairs in proposals]

    def match(text: str) -> pd.DataFrame:
        pairs, origin = first_origins(proposals, len(source.frames))
        if not has_results(source.database, pairs).all():
            source.work.in_child(text, Task(match_pairs, (source.database, pairs, source.seed), len(pairs)))
        return matched_pairs(pairs, origin, *read_pair_results(source.database, pairs))

    matched = match("matching pairs")
    chains = pairs_of_chains(settings, source.vio, rows_of(matched), matched["inliers"].to_numpy(np.int64))
    chains = chains[is_new[chains].any(axis=1)]
    if len(chains):
        proposals = [*proposals, (PairOrigin.TRANSITIVE, chains)]
        matched = match("matching pairs that share a partner")
    return matched


def compared_with_vio(matched: pd.DataFrame, source: PairSource) -> pd.DataFrame:
    """The pairs with enough inliers compared with VIO. UserError where most of a session's are inconsistent: then its
    input is wrong, not its pairs."""
    columns = (matched[name].to_numpy() for name in ("origin", "matches", "inliers"))
    matched, vio = matched_pairs(rows_of(matched), *columns), source.vio
    rows = np.flatnonzero(matched["inliers"] >= MIN_INLIERS)
    pairs = rows_of(matched)[rows]
    a_T_b, compared = compare_pairs(source.database, pairs, vio)
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


def compared_with_neighbours(matched: pd.DataFrame, is_alone_N: NDArray[np.bool_], source: PairSource) -> pd.DataFrame:
    """Verified pairs of images that are alone, without any pose, and far apart in the order of their recording,
    compared with the map that neighbours make."""
    recording, work = source.vio.recording, source.work
    order = np.lexsort((source.vio.t_ns, recording.astype(str)))
    is_next_recording = recording[order[1:]] != recording[order[:-1]]
    place_N = np.empty(len(order), np.int64)
    place_N[order] = np.arange(len(order)) + (NEXT + 1) * np.cumsum(np.concatenate([[False], is_next_recording]))
    pairs = rows_of(matched)
    a, b = pairs.T
    rows = np.flatnonzero(are_verified(matched) & is_alone_N[a] & (recording[a] == recording[b]))
    if not (np.abs(place_N[a[rows]] - place_N[b[rows]]) > NEXT).any():
        return matched
    verified = VerifiedPairs(frames=source.frames, pairs=pairs[rows], matched=source.database, features=source.features)
    arguments = (verified, place_N, MappingInput(work.scratch / "neighbours.db", work.images, source.seed))
    is_wrong = work.in_child("mapping neighbours", Task(contradicted_pairs, arguments, int(is_alone_N.sum())))
    matched.loc[matched.index[rows[is_wrong]], "reason"] = PairInconsistency.NEIGHBOURS
    return matched


def with_floor_matches(matched: pd.DataFrame, source: PairSource, say: Callable[[str], None]) -> pd.DataFrame:
    """Weak pairs matched by the floor, too, in recordings of which neighbouring frames have no verified pair that could
    link them: there a model would break. They were compared with VIO, and are to be again."""
    pairs, vio = rows_of(matched), source.vio
    is_link = are_verified(matched) & (matched["inliers"] >= LINK_INLIERS).to_numpy()
    broken = broken_links(vio.recording, vio.t_ns, pairs[is_link])
    within = vio.session[pairs[:, 0]] == vio.session[pairs[:, 1]]
    broken = broken[np.isin(vio.recording[broken[:, 0]], vio.recording[pairs[within, 0]])]  # not of a map that is held
    can_be_drawn = np.isfinite(vio.gravity_cam).all(axis=1) & vio.posed
    can_be_drawn &= np.isin(vio.recording, vio.recording[broken[:, 0]])
    chosen = are_weak(matched) & can_be_drawn[pairs].all(axis=1) & within
    if not chosen.any():
        return matched
    arguments = (source, pairs[chosen], are_verified(matched)[chosen])
    source.work.in_child("matching the floor", Task(match_floor, arguments, int(chosen.sum())))
    inliers = read_pair_results(source.database, pairs)[1]
    frames = source.frames["frame_id"]
    links = [f"{frames[first]} and {frames[second]}" for first, second in broken.tolist()]
    say(
        f"neighbouring frames without a verified pair of {LINK_INLIERS} inliers: {name_list(links, 3)}; features of "
        f"the floor as seen from above add matches to {np.count_nonzero(inliers != matched['inliers'])} of "
        f"{chosen.sum()} pairs there"
    )
    return matched.assign(inliers=inliers)


def with_guided_matches(matched: pd.DataFrame, compared: pd.DataFrame, source: PairSource) -> pd.DataFrame:
    """Weak pairs with enough inliers matched a second time, along their epipolar lines; compared with VIO again where
    inliers of any pair have changed since they were `compared`."""
    pairs = rows_of(matched)
    chosen = pairs[are_weak(matched) & (matched["inliers"] >= MIN_INLIERS).to_numpy()]
    if len(chosen):
        source.work.in_child("matching weak pairs", Task(guide_pairs, (source.database, chosen), len(chosen)))
    matched = matched.assign(inliers=read_pair_results(source.database, pairs)[1])
    return matched if matched["inliers"].equals(compared["inliers"]) else compared_with_vio(matched, source)


def contradicted_pairs(
    report: Report, verified: VerifiedPairs, order_N: Ints, source: MappingInput
) -> NDArray[np.bool_]:
    """Which of the verified pairs (P,) don't see the same points of a map of neighbours. `order_N` is each frame's
    place in its recording's order; a pair of frames in no map says nothing."""
    pairs = verified.pairs
    is_near = np.abs(order_N[pairs[:, 0]] - order_N[pairs[:, 1]]) <= NEXT
    write_mapping_input(replace(verified, pairs=pairs[is_near]), source.database, source.seed)
    folder = source.database.with_suffix("")
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    done = itertools.count(1)
    models = incremental_mapping(source, folder, lambda: report(min(next(done), len(order_N))))

    model_N, way_N = np.full(len(order_N), -1), np.zeros(len(order_N))
    centre_N3, points_NK3 = np.full((len(order_N), 3), np.nan), [np.empty((0, 3))] * len(order_N)
    for number, model in enumerate(sorted(models, key=lambda model: -model.num_reg_images())):
        rows = [row for row in (i - 1 for i in model.reg_image_ids()) if model_N[row] < 0]
        if len(rows) < _MIN_FRAMES:
            continue
        for row in rows:
            image = model.image(image_id(row))
            seen = [model.point3D(p.point3D_id).xyz if p.has_point3D() else [np.nan] * 3 for p in image.points2D]
            centre_N3[row], points_NK3[row] = image.projection_center(), np.array(seen)
        rows.sort(key=lambda row: order_N[row])
        model_N[rows], way_N[rows] = number, path_length(centre_N3[rows])

    is_wrong = np.zeros(len(pairs), bool)
    models_P2 = np.sort(model_N[pairs], axis=1)
    is_tested = ~is_near & (models_P2[:, 0] >= 0)
    with pycolmap.Database.open(verified.matched) as database:
        for first, second in np.unique(models_P2[is_tested], axis=0).tolist():
            tested = np.flatnonzero(is_tested & (models_P2 == [first, second]).all(axis=1))
            same: list[tuple[Array, Array]] = []
            limits = np.zeros(len(tested))
            for index, (a, b) in enumerate(pairs[tested].tolist()):
                matches = database.read_two_view_geometry(image_id(a), image_id(b)).inlier_matches
                of_a, of_b = points_NK3[a][matches[:, 0]], points_NK3[b][matches[:, 1]]
                is_seen = np.isfinite(of_a[:, 0] + of_b[:, 0])
                if model_N[a] > model_N[b]:
                    a, b, of_a, of_b = b, a, of_b, of_a
                same.append((of_a[is_seen], of_b[is_seen]))
                if is_seen.sum() >= _MIN_POINTS:
                    way = abs(way_N[a] - way_N[b]) if first == second else 0.0
                    limits[index] = _DRIFT * (way + np.median(np.linalg.norm(of_b[is_seen] - centre_N3[b], axis=1)))
            second_S_first = np.eye(3, 4) if first == second else _between(same, limits, source.seed)
            off = [np.linalg.norm(a @ second_S_first[:, :3].T + second_S_first[:, 3] - b, axis=1) for a, b in same]
            agrees = [
                limit > 0 and float(np.median(of_pair)) <= limit for of_pair, limit in zip(off, limits, strict=True)
            ]
            is_wrong[tested] = ~np.array(agrees) | (first != second and np.mean(agrees) < _MIN_AGREEING)
    return is_wrong


def _between(same: list[tuple[Array, Array]], limits: Array, seed: int) -> Array:
    """The similarity (3, 4) from one part's coordinates to the other's on which most points agree that pairs take for
    the same; NaN where there is none."""
    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = max(float(np.median(limits)), 1e-9), seed
    points = [np.concatenate(side) for side in zip(*same, strict=True)]
    estimate: Any = pycolmap.estimate_sim3d_robust  # gives a dictionary, which its stubs don't say
    found = estimate(*points, options)
    return np.full((3, 4), np.nan) if found is None else np.asarray(found["tgt_from_src"].matrix())
