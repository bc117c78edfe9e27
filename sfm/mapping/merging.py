"""Of many frames, the points that are of one track, merged all at once.

COLMAP's merging takes two points at a time, rebuilds their track and looks through all of its matches again: the square
of what one place is seen by, and at 10,000 frames most of the time of triangulating.
"""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.sfm.database import Ints, image_id, pose_of
from groundwalk.sfm.mapping.thinning import matched_features

Indices = NDArray[np.integer[Any]]
"""Single precision, where they are many."""
_MAX_ROUNDS = 100  # some ten are usual


def merge_points(model: pycolmap.Reconstruction, database: Path, limit_px: float) -> None:
    """Merge a model's points whose features a database matches, as far as all of their observations are within
    `limit_px` of the merged one."""
    rows = np.array(sorted(model.reg_image_ids()), np.int64) - image_id(0)
    images = [model.image(image_id(row)) for row in rows.tolist()]
    features = [np.asarray(image.get_observation_point2D_idxs(), np.int64) for image in images]
    frame_M = np.repeat(np.arange(len(rows)), [len(of_frame) for of_frame in features])
    ids = np.array([p.point3D_id for image in images for p in image.get_observation_points2D()], np.int64)
    point_ids, point_M = np.unique(ids, return_inverse=True)
    point_M = point_M.astype(np.int32)
    sfm_T_cam = np.array([pose_of(image) for image in images]).reshape(-1, 4, 4)
    rays = [_rays(model, image, of_frame) for image, of_frame in zip(images, features, strict=True)]
    focal_px = np.array([model.camera(image.camera_id).mean_focal_length() for image in images])
    feature_M = np.concatenate([np.empty(0, np.int64), *features])
    match_K2 = _matched_observations(database, rows[frame_M], feature_M)
    match_K2 = match_K2[point_M[match_K2[:, 0]] != point_M[match_K2[:, 1]]]
    xyz = np.array([model.points3D[i].xyz for i in point_ids.tolist()]).reshape(-1, 3)
    track_P, track_xyz = merged_tracks(
        xyz,
        point_M,
        sfm_T_cam[frame_M, :3, 3],
        np.concatenate([np.empty((0, 3)), *rays]),
        (limit_px / focal_px)[frame_M],
        match_K2,
    )
    is_merged = np.bincount(track_P)[track_P] > 1
    for i in point_ids[is_merged].tolist():
        model.delete_point3D(i)
    own = np.flatnonzero(is_merged[point_M])
    own = own[np.argsort(track_P[point_M[own]], kind="stable")]
    tracks, starts = np.unique(track_P[point_M[own]], return_index=True)
    element_M2 = np.column_stack([rows[frame_M[own]] + image_id(0), feature_M[own]])
    bounds = pairwise([*starts.tolist(), len(own)])
    for track, (first, last) in zip(tracks.tolist(), bounds, strict=True):
        elements = [pycolmap.TrackElement(*element) for element in element_M2[first:last].tolist()]
        model.add_point3D(track_xyz[track], pycolmap.Track(elements))


def _matched_observations(database: Path, row_M: Ints, feature_M: Ints) -> Indices:
    """Which two of M observations, of a row's feature each, are matched, (K, 2)."""
    start, _, _, matched_K2 = matched_features(database)
    observation = np.full(int(start[-1]), -1, np.int32)
    observation[start[row_M] + feature_M] = np.arange(len(row_M))
    match_K2 = observation[matched_K2]
    return match_K2[(match_K2 >= 0).all(axis=1)]


def _rays(model: pycolmap.Reconstruction, image: pycolmap.Image, features: Ints) -> Array:
    """Directions (M, 3) of some features of an image in the model's axes; NaN where its lens has none."""
    px = np.array([image.points2D[k].xy for k in features.tolist()]).reshape(-1, 2)
    ray = np.column_stack([model.camera(image.camera_id).cam_from_img(px), np.ones(len(px))])
    return np.asarray(ray / np.linalg.norm(ray, axis=1, keepdims=True) @ pose_of(image)[:3, :3].T)


def merged_tracks(
    xyz_P3: Array, point_M: Indices, centre_M3: Array, ray_M3: Array, limit_M: Array, match_K2: Indices
) -> tuple[Ints, Array]:
    """Which track each of P points is of (P,), and where the T tracks are (T, 3), the means by their observations.

    Observation m of a point is from `centre_M3[m]` along `ray_M3[m]`, and off by at most `limit_M[m]` rad; `match_K2`
    are two observations each of what may be one track. In each round pairs of tracks that have a match, drawn at
    random, are merged if all of their observations are within their limits of the mean. If those with most matches came
    first, tracks of one walk each would be left: grown, those of walks that have drifted apart are no longer merged.
    """
    track_P, xyz = np.arange(len(xyz_P3), dtype=np.int32), xyz_P3.copy()
    size = np.bincount(point_M, minlength=len(xyz)).astype(float)
    cosine_M, rng = np.cos(limit_M), np.random.default_rng(0)

    def are_off(observation: Ints, at: Array) -> NDArray[np.bool_]:
        along = at - centre_M3[observation]
        cosine = np.sum(along * ray_M3[observation], axis=1) / np.linalg.norm(along, axis=1)
        return np.asarray(~(cosine >= cosine_M[observation]))

    # Each pair of tracks once, with one of its matches.
    pair, match = point_M[match_K2], match_K2
    is_tried = np.zeros(len(pair), bool)
    for _ in range(_MAX_ROUNDS):
        pair, match, is_tried = _joined(pair, match, is_tried)
        middle = np.sum(size[pair, None] * xyz[pair], axis=1) / np.sum(size[pair], axis=1)[:, None]
        untried = np.flatnonzero(~is_tried)
        for side in (0, 1):
            is_tried[untried] |= are_off(match[untried, side], middle[untried])
        untried = untried[~is_tried[untried]]
        if not len(untried):
            break
        score, best = rng.random(len(untried)), np.zeros(len(xyz))
        for side in (0, 1):
            np.maximum.at(best, pair[untried, side], score)
        chosen = untried[(score[:, None] == best[pair[untried]]).all(axis=1)]
        of_track = np.full(len(xyz), -1)
        of_track[pair[chosen]] = chosen[:, None]
        choice_M = of_track[track_P[point_M]]
        observed = np.flatnonzero(choice_M >= 0)
        choice_M = choice_M[observed]
        is_tried[chosen] = True
        chosen = np.setdiff1d(chosen, choice_M[are_off(observed, middle[choice_M])])
        kept, gone = pair[chosen].T
        xyz[kept], size[kept] = middle[chosen], size[kept] + size[gone]
        target = np.arange(len(xyz), dtype=np.int32)
        target[gone] = kept
        track_P, pair = target[track_P], target[pair]
        is_tried &= ~np.isin(pair, kept).any(axis=1)
    tracks, number_P = np.unique(track_P, return_inverse=True)
    return number_P, xyz[tracks]


def _joined(
    pair_K2: Indices, match_K2: Indices, is_tried_K: NDArray[np.bool_]
) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """The same with each pair of two tracks once."""
    pair_K2 = np.sort(pair_K2, axis=1)
    is_pair = pair_K2[:, 0] != pair_K2[:, 1]
    key = pair_K2[is_pair] @ np.array([int(pair_K2.max(initial=0)) + 1, 1])
    first_K = np.flatnonzero(is_pair)[np.unique(key, return_index=True)[1]]
    return pair_K2[first_K], match_K2[first_K], is_tried_K[first_K]
