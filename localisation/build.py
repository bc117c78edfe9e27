"""Building a compact map from frames with known poses."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array
from groundwalk.localisation.calibration import UNCALIBRATED, Trial, calibrated, held_out_trials
from groundwalk.localisation.compact import CompactMap, Lens, compact_map
from groundwalk.localisation.features import Features
from groundwalk.localisation.frames import Views
from groundwalk.localisation.pose import Priors
from groundwalk.localisation.settings import MapSettings
from groundwalk.localisation.structure import Matches, Structure, match_views, structure_of

# Least that priors are taken to be wide: what few frames scatter by says little.
_MIN_ANGULAR_SD, _MIN_VELOCITY_SD, _MIN_FOCAL_SD, _MIN_GRAVITY_SD = 0.05, 0.2, 0.002, np.radians(0.05)
_PIXEL_SD = 0.1
_ENOUGH_TRIALS = 60
_SAME_LENS = 0.02


@dataclass(frozen=True)
class Training:
    """N training frames: their views, cameras as the phone logged them, gravity (N, 3) in the camera, NaN where it's
    not known, and features."""

    views: Views
    logged: tuple[Camera, ...]
    gravity: Array
    features: tuple[Features, ...]


def build_map(
    scene: str,
    training: Training,
    settings: MapSettings,
    track: Callable[[Sequence[NDArray[np.int64]]], Sequence[NDArray[np.int64]]] = lambda pairs: pairs,
) -> tuple[CompactMap, Structure, Matches]:
    """The calibrated map of the training frames, their structure and matches; `track` shows progress over pairs."""
    matches = match_views(training.views, training.features, settings.pairs_per_frame, track)
    folds = settings.calibration_every
    fold = np.arange(len(training.views)) % folds
    trials: list[Trial] = []
    # In a small scene each frame is held out once, in a large one every n-th says enough.
    for number in range(folds):
        if len(trials) < _ENOUGH_TRIALS:
            partial = _compact(scene, training, structure_of(training.views, matches, fold != number), settings)
            rows = np.flatnonzero(fold == number)
            trials += held_out_trials(
                partial,
                [training.features[row] for row in rows],
                [training.logged[row] for row in rows],
                training.gravity[rows],
                training.views.map_T_cam[rows],
            )
    calibration = calibrated(trials)
    structure = structure_of(training.views, matches)
    return replace(_compact(scene, training, structure, settings), calibration=calibration), structure, matches


def _compact(scene: str, training: Training, structure: Structure, settings: MapSettings) -> CompactMap:
    return compact_map(scene, structure, lenses_of(training.views), priors_of(training), UNCALIBRATED, settings)


def lenses_of(views: Views) -> tuple[Lens, ...]:
    """The lenses of N views: those with the same distortion and readout time, and about the same focal length."""
    lenses: list[Lens] = []
    for camera, readout_s in zip(views.cameras, views.readout_s.tolist(), strict=True):
        focal = (camera.fx + camera.fy) / 2 / max(camera.width, camera.height)
        for lens in lenses:
            same = abs(np.log(focal / lens.focal)) < _SAME_LENS
            if same and lens.distortion == camera.distortion and lens.readout_s == readout_s:
                break
        else:
            lenses.append(Lens(focal, camera.distortion, readout_s))
    return tuple(lenses)


def priors_of(training: Training) -> Priors:
    """What queries' cameras are expected to do, as the training frames' did."""
    views = training.views
    scale = [np.log(c.fx / logged.fx) for c, logged in zip(views.cameras, training.logged, strict=True)]
    down = -views.map_T_cam[:, 1, :3]
    known = np.isfinite(training.gravity).all(axis=1)
    off = np.linalg.norm(np.cross(down[known], training.gravity[known]), axis=1)
    return Priors(
        angular_sd=max(_rms(views.angular), _MIN_ANGULAR_SD),
        velocity_sd=max(_rms(views.velocity), _MIN_VELOCITY_SD),
        focal_sd=max(_rms(np.array(scale)), _MIN_FOCAL_SD),
        gravity_sd=max(_rms(off), _MIN_GRAVITY_SD),
        pixel_sd=_PIXEL_SD,
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0
