"""What all structure localisers are built from: training frames, their features and matches, and points that are
triangulated from these alone; the frames' poses are fixed."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from groundwalk.features.sift import Features
from groundwalk.geometry.cameras import Camera
from groundwalk.geometry.poses import Array
from groundwalk.localisation.frames import Lens, Views, camera_axes, rays_of
from groundwalk.localisation.localisers import SIFT, FeatureKind, StructureSettings
from groundwalk.localisation.matching import covisible_pairs, mutual_matches, unit
from groundwalk.localisation.tracks import Points, Rays, epipolar_error_px, tracks, triangulate
from groundwalk.store.parallel import in_parallel

Ints = NDArray[np.int64]
T = TypeVar("T")

MIN_POINTS = 100
"""Fewer have no principal components and no words."""
# Training frames that each one is matched with, those that see most of the same.
_PAIRS_PER_FRAME = 16
_SAME_LENS = 0.02
_MAX_EPIPOLAR_PX, _MAX_PX, _MIN_ANGLE_DEG = 2.5, 2.0, 1.0
_LARGEST_REACH_M = 15.0


class Track(Protocol):
    """Shows progress over items, as `StageRun.track` does."""

    def __call__(self, items: Iterable[T], text: str, total: int | None = None) -> Iterable[T]: ...


def untracked(items: Iterable[T], text: str, total: int | None = None) -> Iterable[T]:
    """The items, without progress."""
    return items


@dataclass(frozen=True)
class Training:
    """N training frames: their views, cameras as the phone logged them, gravity (N, 3) in the camera, NaN where it's
    not known, and features."""

    views: Views
    logged: tuple[Camera, ...]
    gravity: Array
    features: tuple[Features, ...]

    def rays(self) -> Rays:
        """All features, one frame's after the other's."""
        parts = [rays_of(self.views, number, f.px.astype(float)) for number, f in enumerate(self.features)]
        counts = [len(f) for f in self.features]
        focal = np.repeat([(c.fx + c.fy) / 2 for c in self.views.cameras], counts)
        view = np.repeat(np.arange(len(self.features)), counts)
        return Rays(np.concatenate([o for o, _ in parts]), np.concatenate([d for _, d in parts]), focal, view)


@dataclass(frozen=True)
class Prepared:
    """A scene's training frames; how features are extracted and matched, and of which kind they are; all features as
    `rays`, which of them (M, 2) match, and the points of these."""

    scene: str
    training: Training
    settings: StructureSettings
    kind: FeatureKind
    rays: Rays
    pairs: Ints
    points: Points

    @cached_property
    def px(self) -> NDArray[np.float32]:
        """Of all features (F, 2)."""
        return np.concatenate([f.px for f in self.training.features])

    @cached_property
    def descriptors(self) -> NDArray[Any]:
        """Of all features (F, D)."""
        return np.concatenate([f.descriptors for f in self.training.features])

    def points_of(self, used_N: NDArray[np.bool_]) -> Points:
        """Points of the matches of frames that are used."""
        return _points(self.rays, self.pairs[used_N[self.rays.view[self.pairs]].all(axis=1)])

    @property
    def lenses(self) -> tuple[Lens, ...]:
        """The lenses of the training frames: those with the same distortion and readout time, and about the same focal
        length."""
        views, as_logged = self.training.views, self.training.logged
        lenses: list[Lens] = []
        for camera, logged, readout_s in zip(views.cameras, as_logged, views.readout_s.tolist(), strict=True):
            focal = (camera.fx + camera.fy) / 2 / max(camera.width, camera.height)
            for lens in lenses:
                same = abs(np.log(focal / lens.focal)) < _SAME_LENS
                if same and lens.distortion == camera.distortion and lens.readout_s == readout_s:
                    break
            else:
                off_px = camera_axes(camera) @ [camera.cx - logged.cx, camera.cy - logged.cy]
                centre = (off_px / max(camera.width, camera.height)).tolist()
                lenses.append(Lens(focal, camera.distortion, readout_s, (centre[0], centre[1])))
        return tuple(lenses)


def prepare(
    scene: str, training: Training, settings: StructureSettings, kind: FeatureKind = SIFT, track: Track = untracked
) -> Prepared:
    """The training frames with their matches, of frames that see the same by their poses and where rays meet, and
    points. `track` shows progress over pairs of frames."""
    views, features, rays = training.views, training.features, training.rays()
    first = np.cumsum([0, *(len(f) for f in features)])
    extent = np.array([[c.width / c.fx, c.height / c.fy] for c in views.cameras]) / 2
    positions = views.map_T_cam[:, :3, 3]
    reach_m = min(_LARGEST_REACH_M, max(1.0, float(np.linalg.norm(np.ptp(positions, axis=0)))))
    pairs: Sequence[Ints] = list(covisible_pairs(views.map_T_cam, extent, reach_m, _PAIRS_PER_FRAME))
    descriptors = [unit(f.descriptors) for f in features]

    def matched(pair: Ints) -> Ints:
        a, b = pair.tolist()
        rows = mutual_matches(descriptors[a], descriptors[b], kind.ratio) + first[pair]
        error = epipolar_error_px(rays[rows[:, 0]], rays[rows[:, 1]])
        return rows[error < _MAX_EPIPOLAR_PX]

    found = in_parallel(matched, track(pairs, "matching training frames", len(pairs)))
    matches = np.concatenate([np.empty((0, 2), np.int64), *found])
    return Prepared(scene, training, settings, kind, rays, matches, _points(rays, matches))


def _points(rays: Rays, pairs: Ints) -> Points:
    return triangulate(rays, *tracks(pairs, rays.view), _MAX_PX, _MIN_ANGLE_DEG)
