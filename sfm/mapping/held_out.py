"""The database that is mapped, without the matches that are held out, and how well finished poses explain these.

What is left out are whole tracks, all matches of a feature wherever it was seen: a match whose feature still ties other
frames together would be no independent check. The error is Sampson's, which needs no point fitted to the match, and
is taken of the matches that took part, too: where the poses follow their noise, theirs is the smaller one.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from groundwalk.geometry.epipolar import sampson_px
from groundwalk.geometry.lens import undistort
from groundwalk.geometry.poses import Array, relative
from groundwalk.geometry.shutter import readout_fraction, rows_in_camera
from groundwalk.sfm.cameras.adjustment import Cameras
from groundwalk.sfm.database import Ints, create_database, image_id, image_names, read_keypoints
from groundwalk.sfm.pairs.candidates import Pairs

# Of the tracks: enough for a median in each model, few enough that poses don't miss them.
_FRACTION = 0.05
_AT_ONCE = 500_000  # matches whose errors are worked out together, a kilobyte each


@dataclass(frozen=True)
class Matches:
    """M verified matches of the pairs that go into mapping: rows of two frames (M, 2), keypoints as extracted, px
    (M, 2) each, and whether it was held out. Single precision, as COLMAP has keypoints: they are many."""

    frames: NDArray[np.int32]
    xy_a: NDArray[np.float32]
    xy_b: NDArray[np.float32]
    held_out: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class VerifiedPairs:
    """The frames, the pairs of their rows to map, the database that they were matched in, and that of the features as
    extracted (before the correction for rolling shutter)."""

    frames: pd.DataFrame
    pairs: Pairs
    matched: Path
    features: Path


def write_mapping_input(verified: VerifiedPairs, target: Path, seed: int) -> None:
    """Write the database `target` of verified matches without a fraction of the tracks, and beside it what
    `read_matches` reads."""
    frames, pairs = verified.frames, verified.pairs
    target.unlink(missing_ok=True)
    with pycolmap.Database.open(verified.matched) as opened:
        keypoints = [opened.read_keypoints(image_id(row)) for row in range(len(frames))]
        geometries = [opened.read_two_view_geometry(image_id(a), image_id(b)) for a, b in pairs.tolist()]
    counts = np.array([len(k) for k in keypoints])
    each = [np.asarray(g.inlier_matches, np.int64).reshape(-1, 2) for g in geometries]
    pair_M = np.repeat(np.arange(len(pairs)), np.array([len(m) for m in each], np.int64))
    match_M2 = np.concatenate([np.empty((0, 2), np.int64), *each])
    out_M = choose_held_out(pair_M, match_M2, pairs, counts, _FRACTION, seed)

    partial = target.with_name(target.name + ".partial")
    partial.unlink(missing_ok=True)
    create_database(partial, frames, image_names(frames))
    bounds = np.concatenate([[0], np.cumsum([len(m) for m in each])])
    with pycolmap.Database.open(partial) as database, pycolmap.DatabaseTransaction(database):
        for row, of_frame in enumerate(keypoints):
            database.write_keypoints(image_id(row), of_frame)
        for index, (a, b) in enumerate(pairs.tolist()):
            geometry, is_mapped = geometries[index], ~out_M[bounds[index] : bounds[index + 1]]
            geometry.inlier_matches = each[index][is_mapped].astype(np.uint32)
            database.write_two_view_geometry(image_id(a), image_id(b), geometry)
    start = np.concatenate([[0], np.cumsum(counts)])
    every = np.concatenate([np.empty((0, 2)), *read_keypoints(verified.features, len(frames))])
    ends = pairs[pair_M].astype(np.int32)
    xy_a, xy_b = (every[start[ends[:, side]] + match_M2[:, side]].astype(np.float32) for side in (0, 1))
    np.savez(target.with_suffix(".npz"), frames=ends, xy_a=xy_a, xy_b=xy_b, held_out=out_M)
    # Last, so that the database is there only when all is.
    partial.replace(target)


def read_matches(target: Path) -> Matches:
    """The matches behind the database that `write_mapping_input` wrote."""
    with np.load(target.with_suffix(".npz")) as file:
        return Matches(**file)


def choose_held_out(
    pair_M: Ints, match_M2: Ints, pairs: Pairs, keypoints_N: Ints, fraction: float, seed: int
) -> NDArray[np.bool_]:
    """Which of M matches are left out, (M,): those of a `fraction` of the tracks.

    Match m ties the features `match_M2[m]` of the frames `pairs[pair_M[m]]`. A track that holds two features of one
    frame is wrong somewhere and never left out.
    """
    start = np.concatenate([[0], np.cumsum(keypoints_N)])
    a, b = (start[pairs[pair_M, side]] + match_M2[:, side] for side in (0, 1))
    graph = coo_array((np.ones(len(a), np.int8), (a, b)), shape=(start[-1], start[-1]))
    count, track = connected_components(graph, directed=False)
    frame = np.repeat(np.arange(len(keypoints_N)), keypoints_N)
    places, counts = np.unique(track * np.int64(len(keypoints_N)) + frame, return_counts=True)
    consistent = np.ones(count, bool)
    consistent[places[counts > 1] // len(keypoints_N)] = False
    is_held_out = np.random.default_rng(seed).random(count) < fraction
    return np.asarray((is_held_out & consistent)[track[a]], bool)


def held_out_check(matches: Matches, cameras: Cameras, sfm_T_cam: Array, model_N: Ints) -> pd.DataFrame:
    """Sampson's distance `error_px` of each match from finished poses (N, 4, 4), a row a match: its frames `a` and `b`,
    their `model`, and whether it was `held_out`. `model_N` is the model that has each frame, -1 for none; matches
    between models have no error and no row, nor those of frames in one place, which put no constraint on a match."""
    a, b = matches.frames.T
    rows = np.flatnonzero((model_N[a] == model_N[b]) & (model_N[a] >= 0))
    focal = np.repeat(cameras.focal.mean(axis=1, keepdims=True), 2, axis=1)
    error_px = []
    for part in np.array_split(rows, len(rows) // _AT_ONCE + 1):
        ray_a, sfm_T_a = _rays_of(cameras, sfm_T_cam, a[part], matches.xy_a[part].astype(float))
        ray_b, sfm_T_b = _rays_of(cameras, sfm_T_cam, b[part], matches.xy_b[part].astype(float))
        error_px.append(sampson_px(relative(sfm_T_a, sfm_T_b), ray_a, ray_b, focal[a[part]], focal[b[part]]))
    error = np.concatenate(error_px)
    rows, error = rows[np.isfinite(error)], error[np.isfinite(error)]
    columns = {"a": a[rows], "b": b[rows], "model": model_N[a[rows]], "held_out": matches.held_out[rows]}
    return pd.DataFrame(columns | {"error_px": error}, copy=False)


def held_out_medians(check: pd.DataFrame, groups: pd.Series, count: int) -> pd.DataFrame:
    """Of each of `count` groups of the check's rows, numbered from 0: `held_out_matches`, and the median errors of
    these (`held_out_px`) and of the others (`fitted_px`), NaN for none."""
    errors = pd.DataFrame(
        {
            "held_out_px": check["error_px"].where(check["held_out"]),
            "fitted_px": check["error_px"].where(~check["held_out"]),
        }
    ).groupby(groups.to_numpy())
    table = errors.median().assign(held_out_matches=errors["held_out_px"].count()).reindex(range(count))
    return table.assign(held_out_matches=table["held_out_matches"].fillna(0).astype(np.int64))


def _rays_of(cameras: Cameras, sfm_T_cam: Array, frame_M: Ints, xy_M2: Array) -> tuple[Array, Array]:
    """Rays (M, 3) with z = 1 through pixels (M, 2), and the frames' cameras at their rows' time (M, 4, 4)."""
    distorted = (xy_M2 - cameras.centre[frame_M]) / cameras.focal[frame_M]
    rays = np.ones((len(frame_M), 3))
    coefficients = cameras.coefficients[cameras.lens]
    lenses, of_frame = np.unique(coefficients, axis=0, return_inverse=True)
    of_match = of_frame.ravel()[frame_M]
    for number, lens in enumerate(lenses):
        members = of_match == number
        rays[members, :2] = undistort(distorted[members], lens)
    tau = readout_fraction(cameras.readout_line[frame_M], xy_M2) * cameras.readout_s[cameras.lens[frame_M]]
    return rays, sfm_T_cam[frame_M] @ rows_in_camera(cameras.angular[frame_M], cameras.velocity[frame_M], tau)
