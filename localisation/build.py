"""Building a compact map from frames with known poses: which points it keeps, and what its answers are worth."""

import heapq
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.geometry.vlad import k_means, nearest_centres
from groundwalk.localisation.calibration import UNCALIBRATED, Trial, calibrated, held_out_trial
from groundwalk.localisation.compact import CompactMap, to_bytes
from groundwalk.localisation.entries import MapSettings
from groundwalk.localisation.matching import unit
from groundwalk.localisation.pose import NO_VERTICAL, Priors
from groundwalk.localisation.prepared import MIN_POINTS, Prepared, Track, untracked
from groundwalk.localisation.query import MapLocaliser
from groundwalk.localisation.tracks import Points

Ints = NDArray[np.int64]

# Principal components kept of each descriptor, one byte each: with 28,000 points the demo's map has 2 MB.
_DIMENSIONS = 40
_GRID = 6
# Least that priors are taken to be wide: what few frames scatter by says little.
_MIN_ANGULAR_SD, _MIN_VELOCITY_SD, _MIN_FOCAL_SD, _MIN_GRAVITY_SD = 0.05, 0.2, 0.002, np.radians(0.05)
_PIXEL_SD = 0.1
# Every fifth training frame calibrates the map's answers; in a small scene each one, fold by fold.
_FOLDS, _ENOUGH_TRIALS = 5, 60


def map_localiser(prepared: Prepared, settings: MapSettings, track: Track = untracked) -> MapLocaliser:
    """The localiser of the calibrated map."""
    return MapLocaliser(build_map(prepared, settings, track))


def build_map(prepared: Prepared, settings: MapSettings, track: Track = untracked) -> CompactMap:
    """The calibrated map of the training frames."""
    training = prepared.training
    fold = np.arange(len(training.views)) % _FOLDS
    trials: list[Trial] = []
    for number in range(_FOLDS):
        if len(trials) >= _ENOUGH_TRIALS:
            break
        rows = np.flatnonzero(fold == number)
        points = prepared.points_of(fold != number)
        if len(points.xyz) >= MIN_POINTS:
            localiser = MapLocaliser(compact_map(prepared, points, settings))
            held_out = track(rows.tolist(), "Map: calibrating by held-out training frames", len(rows))
            trials += [held_out_trial(localiser, training, row) for row in held_out]
    return replace(compact_map(prepared, prepared.points, settings), calibration=calibrated(trials))


def compact_map(prepared: Prepared, points: Points, settings: MapSettings) -> CompactMap:
    """The map, not calibrated, of the most useful of some points, as many as the settings say."""
    views, view = prepared.training.views, prepared.rays.view[points.feature]
    # Unit mean (P, 128) of the unit descriptors of each point's observations.
    starts = np.searchsorted(points.point, np.arange(len(points.xyz)))
    sift = unit(np.add.reduceat(unit(prepared.descriptors[points.feature]), starts, axis=0))
    # The cell (O,) of each observation in its frame's image, numbered over all frames.
    size = np.array([[c.width, c.height] for c in views.cameras])[view]
    at = np.clip((prepared.px[points.feature] / size * _GRID).astype(np.int64), 0, _GRID - 1)
    cell = (view * _GRID + at[:, 1]) * _GRID + at[:, 0]
    chosen = covering_points(points.point, cell, _quality(prepared, points), settings.max_points)
    mean = sift.mean(axis=0)
    basis = np.linalg.eigh(np.cov((sift - mean).T))[1][:, : -_DIMENSIONS - 1 : -1].astype(np.float32)
    basis, mean = basis.astype(np.float16).astype(np.float32), mean.astype(np.float16).astype(np.float32)
    descriptors = unit((sift[chosen] - mean) @ basis)
    rng = np.random.default_rng(0)
    words = k_means(descriptors, max(1, round(np.sqrt(len(chosen)))), rng)
    words = unit(to_bytes(unit(words)))
    word = nearest_centres(descriptors, words)
    order = np.argsort(word, kind="stable")
    chosen = chosen[order]
    row = np.full(len(points.xyz), -1)
    row[chosen] = np.arange(len(chosen))
    observed = row[points.point]
    kept = observed >= 0
    by_view = np.lexsort((observed[kept], view[kept]))
    used = np.unique(view[kept])
    return CompactMap(
        scene=prepared.scene,
        xyz=points.xyz[chosen],
        descriptors=descriptors[order],
        words=words,
        word_bounds=np.searchsorted(word[order], np.arange(len(words) + 1)),
        map_T_view=views.map_T_cam[used],
        seen=observed[kept][by_view],
        seen_bounds=np.r_[0, np.cumsum(np.bincount(view[kept], minlength=len(views))[used])],
        mean=mean,
        basis=basis,
        lenses=prepared.lenses,
        priors=priors_of(prepared, points),
        calibration=UNCALIBRATED,
        max_features=prepared.settings.max_features,
        max_side=prepared.settings.max_side,
    )


def covering_points(point_O: Ints, cell_O: Ints, quality_P: Array, count: int) -> Ints:
    """`count` points (rows, sorted) that cover the cells of all frames' images evenly; all where there are no more.

    `point_O` and `cell_O` say which points (sorted) were seen in which cells of which frames. A point's gain is the sum
    over its cells of 1 / (1 + points that the cell has), times its quality: the greedy solution of weighted K-cover
    (Li et al., "Location recognition using prioritized feature matching", ECCV 2010) with diminishing returns.
    """
    points = len(quality_P)
    if count >= points:
        return np.arange(points)
    bounds = np.searchsorted(point_O, np.arange(points + 1))
    covered = np.zeros(int(cell_O.max(initial=-1)) + 1)

    def gain(point: int) -> float:
        return float(quality_P[point] * (1 / (1 + covered[cell_O[bounds[point] : bounds[point + 1]]])).sum())

    # Gains only fall: one that is still the largest after it's computed anew is the largest of all.
    heap = [(-gain(point), point) for point in range(points)]
    heapq.heapify(heap)
    chosen: list[int] = []
    while len(chosen) < count:
        _, point = heapq.heappop(heap)
        now = gain(point)
        if heap and -now > heap[0][0]:
            heapq.heappush(heap, (-now, point))
            continue
        chosen.append(point)
        np.add.at(covered, cell_O[bounds[point] : bounds[point + 1]], 1)
    return np.sort(np.array(chosen, np.int64))


def _quality(prepared: Prepared, points: Points) -> Array:
    """What a point (P,) is worth a frame: less where its position is less sure than what a query measures, from the
    frames that saw it."""
    covariance = np.linalg.inv(points.information + 1e-12 * np.eye(3))
    view = prepared.rays.view[points.feature]
    offset = points.xyz[points.point] - prepared.training.views.map_T_cam[view, :3, 3]
    distance = np.linalg.norm(offset, axis=1)
    across = (
        np.trace(covariance, axis1=1, axis2=2)[points.point]
        - np.einsum("oi,oij,oj->o", offset, covariance[points.point], offset) / np.maximum(distance, 1e-9) ** 2
    )
    focal = prepared.rays.focal_px[points.feature]
    variance_px = np.bincount(points.point, focal**2 * across / np.maximum(distance, 1e-3) ** 2, len(points.xyz))
    return np.asarray(1 / (1 + variance_px / np.bincount(points.point, minlength=len(points.xyz))))


def priors_of(prepared: Prepared, points: Points) -> Priors:
    """What queries' cameras are expected to do, as the training frames' did, and how well these measured points."""
    training, views = prepared.training, prepared.training.views
    scale = [np.log(c.fx / logged.fx) for c, logged in zip(views.cameras, training.logged, strict=True)]
    down = -views.map_T_cam[:, 1, :3]
    known = np.isfinite(training.gravity).all(axis=1)
    off = np.linalg.norm(np.cross(down[known], training.gravity[known]), axis=1)
    # By residuals, two an observation, less the three coordinates of each point.
    free = max(2 * len(points.feature) - 3 * len(points.xyz), 1)
    square = np.sum((points.residual_px / prepared.rays.focal_px[points.feature]) ** 2)
    return Priors(
        angular_sd=max(_rms(views.angular), _MIN_ANGULAR_SD),
        velocity_sd=max(_rms(views.velocity), _MIN_VELOCITY_SD),
        focal_sd=max(_rms(np.array(scale)), _MIN_FOCAL_SD),
        gravity_sd=max(_rms(off), _MIN_GRAVITY_SD) if known.any() else NO_VERTICAL,
        pixel_sd=_PIXEL_SD,
        point_sd=float(np.sqrt(square / free)),
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
