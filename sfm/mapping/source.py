"""The database that is mapped, and the matches held out to check the models with."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pycolmap
from numpy.typing import NDArray

from groundwalk.geometry.epipolar import sampson_px
from groundwalk.geometry.lens import undistort
from groundwalk.geometry.poses import Array, relative
from groundwalk.geometry.shutter import readout_fraction, rows_in_camera
from groundwalk.sfm.cameras.adjustment import Cameras
from groundwalk.sfm.database import Ints, create_database, image_id, image_name, read_keypoints
from groundwalk.sfm.mapping.held_out import choose_held_out
from groundwalk.sfm.pairs.candidates import Pairs


@dataclass(frozen=True)
class Matches:
    """M verified matches of the pairs that go into mapping: rows of two frames (M, 2), keypoints as extracted, px
    (M, 2) each, and whether it was held out."""

    frames: Ints
    xy_a: Array
    xy_b: Array
    held_out: NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class VerifiedPairs:
    """The frames, the pairs of their rows to map, the database that they were matched in, and that of the features as
    extracted (before the correction for rolling shutter)."""

    frames: pd.DataFrame
    pairs: Pairs
    matched: Path
    features: Path


def write_mapping_input(verified: VerifiedPairs, target: Path, held_out_fraction: float, seed: int) -> None:
    """Write the database `target` of verified matches without a fraction of the tracks, and beside it what
    `read_matches` reads."""
    frames, pairs = verified.frames, verified.pairs
    names = [image_name(i, image) for i, image in zip(frames["frame_id"], frames["image"], strict=True)]
    target.unlink(missing_ok=True)
    with pycolmap.Database.open(verified.matched) as opened:
        keypoints = [opened.read_keypoints(image_id(row)) for row in range(len(frames))]
        geometries = [opened.read_two_view_geometry(image_id(a), image_id(b)) for a, b in pairs.tolist()]
    counts = np.array([len(k) for k in keypoints])
    each = [np.asarray(g.inlier_matches, np.int64).reshape(-1, 2) for g in geometries]
    pair_M = np.repeat(np.arange(len(pairs)), np.array([len(m) for m in each], np.int64))
    match_M2 = np.concatenate([np.empty((0, 2), np.int64), *each])
    out_M = choose_held_out(pair_M, match_M2, pairs, counts, held_out_fraction, seed)

    partial = target.with_name(target.name + ".partial")
    partial.unlink(missing_ok=True)
    create_database(partial, frames, names)
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
    ends = pairs[pair_M]
    xy_a, xy_b = (every[start[ends[:, side]] + match_M2[:, side]] for side in (0, 1))
    np.savez(target.with_suffix(".npz"), frames=ends, xy_a=xy_a, xy_b=xy_b, held_out=out_M)
    # Last, so that the database is there only when all is.
    partial.replace(target)


def read_matches(target: Path) -> Matches:
    """The matches behind the database that `write_mapping_input` wrote."""
    with np.load(target.with_suffix(".npz")) as file:
        return Matches(**file)


@dataclass(frozen=True)
class HeldOutCheck:
    """Sampson's distance (M,) of each match from the finished poses, px, NaN where its frames aren't in one model or
    are in one place there; the frames of each match (M, 2), the model that has them (M,), -1 where none has, and
    whether it was held out (M,)."""

    error_px: Array
    frames: Ints
    model: Ints
    held_out: NDArray[np.bool_]

    def count(self, *, held_out: bool, model: int | None = None) -> int:
        return int(self._rows(held_out, model).sum())

    def median_px(self, *, held_out: bool, model: int | None = None) -> float | None:
        """None where there is none."""
        errors = self.error_px[self._rows(held_out, model)]
        return float(np.median(errors)) if len(errors) else None

    def by_frame(self, frames: int, *, held_out: bool) -> tuple[Ints, Array]:
        """How many such matches each frame has, (N,), and their median error, (N,), NaN for none."""
        rows = self._rows(held_out, None)
        errors = pd.Series(np.repeat(self.error_px[rows], 2)).groupby(self.frames[rows].ravel())
        count, median = np.zeros(frames, np.int64), np.full(frames, np.nan)
        count[errors.count().index], median[errors.median().index] = errors.count(), errors.median()
        return count, median

    def _rows(self, held_out: bool, model: int | None) -> NDArray[np.bool_]:
        # Frames in one place put no constraint on a match: it has no error.
        has_error = (self.held_out == held_out) & np.isfinite(self.error_px)
        return has_error & (self.model >= 0 if model is None else self.model == model)


def held_out_check(matches: Matches, cameras: Cameras, sfm_T_cam: Array, model_N: Ints) -> HeldOutCheck:
    """Errors of all matches by finished poses (N, 4, 4); `model_N` is the model that has each frame, -1 for none."""
    a, b = matches.frames.T
    model = np.where(model_N[a] == model_N[b], model_N[a], -1)
    in_model = model >= 0
    errors = np.full(len(a), np.nan)
    if in_model.any():
        (ray_a, sfm_T_a), (ray_b, sfm_T_b) = (
            _rays_of(cameras, sfm_T_cam, side[in_model], xy[in_model])
            for side, xy in ((a, matches.xy_a), (b, matches.xy_b))
        )
        focal = np.repeat(cameras.focal.mean(axis=1, keepdims=True), 2, axis=1)
        focal_a, focal_b = focal[a[in_model]], focal[b[in_model]]
        errors[in_model] = sampson_px(relative(sfm_T_a, sfm_T_b), ray_a, ray_b, focal_a, focal_b)
    return HeldOutCheck(errors, matches.frames, model, matches.held_out)


def _rays_of(cameras: Cameras, sfm_T_cam: Array, frame_M: Ints, xy_M2: Array) -> tuple[Array, Array]:
    """Rays (M, 3) with z = 1 through pixels (M, 2), and the frames' cameras at their rows' time (M, 4, 4)."""
    distorted = (xy_M2 - cameras.intrinsics[frame_M, 2:]) / cameras.focal[frame_M]
    rays = np.ones((len(frame_M), 3))
    coefficients = cameras.coefficients[cameras.lens]
    lenses, of_frame = np.unique(coefficients, axis=0, return_inverse=True)
    of_match = of_frame.ravel()[frame_M]
    for number, lens in enumerate(lenses):
        members = of_match == number
        rays[members, :2] = undistort(distorted[members], lens)
    tau = readout_fraction(cameras.readout_line[frame_M], xy_M2) * cameras.readout_s[cameras.lens[frame_M]]
    return rays, sfm_T_cam[frame_M] @ rows_in_camera(cameras.angular[frame_M], cameras.velocity[frame_M], tau)
