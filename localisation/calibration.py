"""What answers are worth, by training frames that are held out of a map built for that."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize

from groundwalk.geometry.poses import Array, inverse, transform
from groundwalk.localisation.compact import Calibration
from groundwalk.localisation.frames import with_lens
from groundwalk.localisation.prepared import Training
from groundwalk.localisation.query import MapLocaliser
from groundwalk.localisation.results import QueryResult
from groundwalk.scoring.errors import BOUND_95, normalised_squares, pose_error

UNCALIBRATED = Calibration(min_inliers=6, covariance_factor=1.0, position_floor_m=0.0, rotation_floor_rad=0.0)
# Queries have half as many features again as the frames that calibrate, and so more matches by chance.
_MARGIN = 1.75
_MIN_INLIERS, _WITHOUT_EVIDENCE = 10, 30
_LARGEST_ERROR_M, _LARGEST_ERROR_DEG = 0.25, 2.0
_TRIMMED = 0.98
_MIN_ANSWERS = 10


@dataclass(frozen=True)
class Trial:
    """A held-out frame's answer, its true pose (4, 4), and the inliers that it has where nothing it sees is in the
    map."""

    answer: QueryResult
    truth: Array
    inliers_elsewhere: int


def held_out_trial(localiser: MapLocaliser, training: Training, row: int) -> Trial:
    """The answer of a training frame that took no part in the localiser's map, with its true pose. For the inliers
    elsewhere, the map's points within the frame's view, be they hidden by walls or not, are left out."""
    features, logged, map_T_cam = training.features[row], training.logged[row], training.views.map_T_cam[row]
    down = training.gravity[row] if np.isfinite(training.gravity[row]).all() else None
    camera = with_lens(logged, localiser.map.lenses)[0]
    cam = transform(inverse(map_T_cam), localiser.map.xyz)
    ahead = cam[:, 2] > 0.01
    half = 1.1 * np.array([camera.width / camera.fx, camera.height / camera.fy]) / 2
    at = np.abs(cam[:, :2]) / np.where(ahead, cam[:, 2], 1.0)[:, None]
    hidden = np.asarray(ahead & (at <= half).all(axis=1))
    elsewhere = localiser.localise_features(features, logged, down, hidden=hidden).inliers
    return Trial(localiser.localise_features(features, logged, down), map_T_cam, elsewhere)


def calibrated(trials: Sequence[Trial]) -> Calibration:
    """Inliers that an answer needs, beyond those that wrong ones had; covariances by the errors of right ones."""
    errors, covariances, wrong = [], [], [0]
    for trial in trials:
        wrong.append(trial.inliers_elsewhere)
        if trial.answer.map_T_cam is None:
            continue
        error = pose_error(trial.answer.map_T_cam, trial.truth)
        if np.linalg.norm(error[3:]) < _LARGEST_ERROR_M and np.linalg.norm(error[:3]) < np.radians(_LARGEST_ERROR_DEG):
            errors.append(error)
            covariances.append(trial.answer.covariance)
        else:
            wrong.append(trial.answer.inliers)
    if len(errors) < _MIN_ANSWERS:
        return Calibration(_WITHOUT_EVIDENCE, 3.0, 0.01, float(np.radians(0.1)))
    limit = max(_MIN_INLIERS, int(np.ceil(_MARGIN * max(wrong))))
    return _fitted(np.array(errors), np.array(covariances), limit)


def _fitted(errors: Array, covariances: Array, min_inliers: int) -> Calibration:
    """Factor and floors of greatest likelihood, the worst 2 % left out; then larger where 95 % bounds hold too few."""

    def grown(logs: Array) -> Array:
        factor, rotation, position = np.exp(logs)
        return factor**2 * covariances + np.diag(np.r_[np.full(3, rotation), np.full(3, position)] ** 2)

    def cost(logs: Array) -> float:
        c = grown(logs)
        terms = sum(
            square + np.linalg.slogdet(c[:, part, part])[1]
            for square, part in zip(normalised_squares(errors, c), (slice(0, 3), slice(3, 6)), strict=True)
        )
        return float(np.sort(terms)[: int(np.ceil(_TRIMMED * len(errors)))].mean())

    best = minimize(cost, np.log([1.5, 1e-4, 1e-3]), method="Nelder-Mead", options={"maxiter": 400})
    squares = normalised_squares(errors, grown(best.x))
    short = max(np.quantile(s, 0.95) for s in squares) / BOUND_95
    factor, rotation, position = np.exp(best.x) * np.sqrt(max(short, 1.0))
    return Calibration(min_inliers, float(factor), float(position), float(rotation))
