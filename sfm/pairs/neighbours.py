"""Pairs of images without odometry against the map that neighbouring images alone make.

Of two doors of a corridor the images agree within a pixel, and a map of all pairs that agree folds there. Photos of a
walk and frames of a video have an order: a map of neighbours alone has no such pair in it; it drifts, but doesn't fold.
Images that are farther apart in the order have to see the same points of that map, within its drift.
"""

import itertools
import shutil
from dataclasses import replace
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array, path_length
from groundwalk.sfm.database import Ints, image_id
from groundwalk.sfm.mapping.held_out import VerifiedPairs, write_mapping_input
from groundwalk.sfm.mapping.mappers import incremental
from groundwalk.sfm.plugins import MappingInput
from groundwalk.store.child import Report

NEXT = 10
"""Images so many places apart in the order, or fewer, are neighbours."""
_MIN_FRAMES = 10  # smaller maps say nothing, as of photos in no order
_MIN_POINTS = 5
# How far a map may drift, as a fraction of the way between two images and of their distance to its points.
_DRIFT = 0.1
# Where the map of neighbours breaks, these pairs between its parts have to agree on where the parts are, or none is
# right: of the real corridor's, all of which are wrong, a fifth does.
_MIN_AGREEING = 0.5


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
    models = incremental(source, folder, lambda: report(next(done)))

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
