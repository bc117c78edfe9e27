"""Building a compact map from frames with known poses: which points it keeps, and what its answers are worth."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.poses import Array
from groundwalk.geometry.vlad import k_means, nearest_centres
from groundwalk.localisation.calibration import UNCALIBRATED, Trial, calibrated, held_out_trial
from groundwalk.localisation.compact import CompactMap, from_bytes, to_bytes
from groundwalk.localisation.localiser_settings import MapSettings
from groundwalk.localisation.matching import unit
from groundwalk.localisation.pose import NO_VERTICAL, Priors
from groundwalk.localisation.prepared import Prepared, Track, Training, untracked
from groundwalk.localisation.query import MapLocaliser
from groundwalk.localisation.selection import covering_points
from groundwalk.localisation.structure import MIN_POINTS, Structure, structure_of

Ints = NDArray[np.int64]
Floats = NDArray[np.float32]

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
        structure = structure_of(training.views, prepared.matches, fold != number)
        if len(structure.points.xyz) >= MIN_POINTS:
            localiser = MapLocaliser(compact_map(prepared, structure, settings))
            trials += [
                held_out_trial(
                    localiser,
                    training.features[row],
                    training.logged[row],
                    training.gravity[row],
                    training.views.map_T_cam[row],
                )
                for row in track(rows.tolist(), "Map: calibrating by held-out training frames", len(rows))
            ]
    return replace(compact_map(prepared, prepared.structure, settings), calibration=calibrated(trials))


def compact_map(prepared: Prepared, structure: Structure, settings: MapSettings) -> CompactMap:
    """The map, not calibrated, of a structure's most useful points, as many as the settings say."""
    points = structure.points
    sift = _mean_descriptors(structure)
    chosen = covering_points(points.point, _cells(structure), _quality(structure), settings.max_points)
    mean = sift.mean(axis=0)
    basis = np.linalg.eigh(np.cov((sift - mean).T))[1][:, : -_DIMENSIONS - 1 : -1].astype(np.float32)
    basis, mean = basis.astype(np.float16).astype(np.float32), mean.astype(np.float16).astype(np.float32)
    descriptors = unit((sift[chosen] - mean) @ basis)
    rng = np.random.default_rng(0)
    words = k_means(descriptors, max(1, round(np.sqrt(len(chosen)))), rng)
    words = from_bytes(to_bytes(unit(words)))
    word = nearest_centres(descriptors, words)
    order = np.argsort(word, kind="stable")
    chosen = chosen[order]
    row = np.full(len(points.xyz), -1)
    row[chosen] = np.arange(len(chosen))
    observed, view = row[points.point], structure.view[points.feature]
    kept = observed >= 0
    by_view = np.lexsort((observed[kept], view[kept]))
    used = np.unique(view[kept])
    return CompactMap(
        scene=prepared.scene,
        xyz=points.xyz[chosen],
        descriptors=descriptors[order],
        words=words,
        word_bounds=np.searchsorted(word[order], np.arange(len(words) + 1)),
        map_T_view=structure.views.map_T_cam[used],
        seen=observed[kept][by_view],
        seen_bounds=np.r_[0, np.cumsum(np.bincount(view[kept], minlength=len(structure.views))[used])],
        mean=mean,
        basis=basis,
        lenses=prepared.lenses,
        priors=priors_of(prepared.training, structure),
        calibration=UNCALIBRATED,
        max_features=prepared.settings.max_features,
        max_side=prepared.settings.max_side,
    )


def _mean_descriptors(structure: Structure) -> Floats:
    """Unit mean (P, 128) of the unit descriptors of each point's observations."""
    points = structure.points
    descriptors = unit(structure.descriptors[points.feature])
    starts = np.searchsorted(points.point, np.arange(len(points.xyz)))
    return unit(np.add.reduceat(descriptors, starts, axis=0))


def _cells(structure: Structure) -> Ints:
    """The cell (O,) of each observation in its frame's image, numbered over all frames."""
    points = structure.points
    view = structure.view[points.feature]
    size = np.array([[c.width, c.height] for c in structure.views.cameras])[view]
    at = np.clip((structure.px[points.feature] / size * _GRID).astype(np.int64), 0, _GRID - 1)
    return (view * _GRID + at[:, 1]) * _GRID + at[:, 0]


def _quality(structure: Structure) -> Array:
    """What a point (P,) is worth a frame: less where its position is less sure than what a query measures, from the
    frames that saw it."""
    points = structure.points
    covariance = np.linalg.inv(points.information + 1e-12 * np.eye(3))
    view = structure.view[points.feature]
    offset = points.xyz[points.point] - structure.views.map_T_cam[view, :3, 3]
    distance = np.linalg.norm(offset, axis=1)
    across = (
        np.trace(covariance, axis1=1, axis2=2)[points.point]
        - np.einsum("oi,oij,oj->o", offset, covariance[points.point], offset) / np.maximum(distance, 1e-9) ** 2
    )
    focal = np.array([(c.fx + c.fy) / 2 for c in structure.views.cameras])[view]
    variance_px = np.bincount(points.point, focal**2 * across / np.maximum(distance, 1e-3) ** 2, len(points.xyz))
    return np.asarray(1 / (1 + variance_px / np.bincount(points.point, minlength=len(points.xyz))))


def priors_of(training: Training, structure: Structure) -> Priors:
    """What queries' cameras are expected to do, as the training frames' did, and how well these measured points."""
    views = training.views
    scale = [np.log(c.fx / logged.fx) for c, logged in zip(views.cameras, training.logged, strict=True)]
    down = -views.map_T_cam[:, 1, :3]
    known = np.isfinite(training.gravity).all(axis=1)
    off = np.linalg.norm(np.cross(down[known], training.gravity[known]), axis=1)
    return Priors(
        angular_sd=max(_rms(views.angular), _MIN_ANGULAR_SD),
        velocity_sd=max(_rms(views.velocity), _MIN_VELOCITY_SD),
        focal_sd=max(_rms(np.array(scale)), _MIN_FOCAL_SD),
        gravity_sd=max(_rms(off), _MIN_GRAVITY_SD) if known.any() else NO_VERTICAL,
        pixel_sd=_PIXEL_SD,
        point_sd=_measured_sd(structure),
    )


def _measured_sd(structure: Structure) -> float:
    """One sigma, rad, of what the frames measured of points, a coordinate: by residuals, two an observation, less the
    three coordinates of each point."""
    points = structure.points
    focal = np.array([(c.fx + c.fy) / 2 for c in structure.views.cameras])[structure.view[points.feature]]
    free = max(2 * len(points.feature) - 3 * len(points.xyz), 1)
    return float(np.sqrt(np.sum((points.residual_px / focal) ** 2) / free))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
