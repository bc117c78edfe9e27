"""What all structure localisers are built from: training frames, their features, matches and points."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from groundwalk.features.sift import Features
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array
from groundwalk.localisation.feature_kinds import SIFT, FeatureKind
from groundwalk.localisation.frames import Lens, Views
from groundwalk.localisation.localiser_settings import StructureSettings
from groundwalk.localisation.structure import Matches, Structure, matched_features, matches_of, structure_of

Ints = NDArray[np.int64]
T = TypeVar("T")


class Track(Protocol):
    """Shows progress over items, as `StageRun.track` does."""

    def __call__(self, items: Iterable[T], text: str, total: int | None = None) -> Iterable[T]: ...


def untracked(items: Iterable[T], text: str, total: int | None = None) -> Iterable[T]:
    """The items, without progress."""
    return items


# Training frames that each one is matched with, those that see most of the same.
_PAIRS_PER_FRAME = 16
_SAME_LENS = 0.02


@dataclass(frozen=True)
class Training:
    """N training frames: their views, cameras as the phone logged them, gravity (N, 3) in the camera, NaN where it's
    not known, and features."""

    views: Views
    logged: tuple[Camera, ...]
    gravity: Array
    features: tuple[Features, ...]


@dataclass(frozen=True)
class Prepared:
    """A scene's training frames, their matches and the points of these; how features are extracted and matched, and of
    which kind they are."""

    scene: str
    training: Training
    settings: StructureSettings
    matches: Matches
    structure: Structure
    kind: FeatureKind = SIFT

    @property
    def lenses(self) -> tuple[Lens, ...]:
        """The lenses of the training frames: those with the same distortion and readout time, and about the same focal
        length."""
        views = self.training.views
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


def prepare(
    scene: str, training: Training, settings: StructureSettings, track: Track = untracked, kind: FeatureKind = SIFT
) -> Prepared:
    """The training frames, matched; `track` shows progress over pairs."""
    return prepared_from(scene, training, settings, match(training, track, kind), kind)


def match(training: Training, track: Track = untracked, kind: FeatureKind = SIFT) -> Ints:
    """Which of the training frames' features (M, 2) match, numbered over all frames."""
    return matched_features(
        training.views,
        training.features,
        _PAIRS_PER_FRAME,
        kind.ratio,
        lambda pairs: track(pairs, "matching training frames", len(pairs)),
    )


def prepared_from(
    scene: str, training: Training, settings: StructureSettings, pairs: Ints, kind: FeatureKind = SIFT
) -> Prepared:
    """The training frames with the pairs that `match` gave."""
    matches = matches_of(training.views, training.features, pairs)
    return Prepared(scene, training, settings, matches, structure_of(training.views, matches), kind)
