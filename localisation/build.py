"""Building a compact map from frames with known poses."""

from dataclasses import replace

import numpy as np

from groundwalk.geometry.poses import Array
from groundwalk.localisation.calibration import UNCALIBRATED, Trial, calibrated, held_out_trial
from groundwalk.localisation.compact import CompactMap, compact_map
from groundwalk.localisation.localiser_settings import MapSettings
from groundwalk.localisation.pose import NO_VERTICAL, Priors
from groundwalk.localisation.prepared import Prepared, Track, Training, untracked
from groundwalk.localisation.query import MapLocaliser
from groundwalk.localisation.structure import MIN_POINTS, Structure, structure_of

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
            localiser = MapLocaliser(_compact(prepared, structure, settings))
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
    return replace(_compact(prepared, prepared.structure, settings), calibration=calibrated(trials))


def _compact(prepared: Prepared, structure: Structure, settings: MapSettings) -> CompactMap:
    given = prepared.lenses, priors_of(prepared.training, structure), UNCALIBRATED
    return compact_map(prepared.scene, structure, *given, settings, prepared.settings)


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
