"""SfM's models as they were placed and checked: what ground truth, tables and pictures are made of."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from groundwalk.alignment.checks.results import CheckResult
from groundwalk.alignment.components import Component, PlacedComponent
from groundwalk.alignment.segments import SegmentWindow
from groundwalk.geometry.poses import Array


@dataclass(frozen=True, kw_only=True)
class FrameVerdicts:
    """What the checks say of frames (N,): whether SfM has a pose, why a frame gets no ground truth (`exclusion`, empty
    where it does), why one that does is of class C at best (`problem`), and its largest residuals against VIO (or the
    reference that gives the map), metres and radians, NaN where there are none."""

    registered: np.ndarray
    exclusion: np.ndarray
    problem: np.ndarray
    residual_m: Array
    residual_rad: Array

    @property
    def has_ground_truth(self) -> np.ndarray:
        """(N,) frames with ground truth."""
        return self.registered & (self.exclusion == "")


@dataclass(frozen=True, kw_only=True)
class CheckedMap:
    """The models that are metric and upright, where each lies in the map, all checks, and what they say of the rows of
    the frames table. `windows` are what was compared with VIO; `reference_limit` is how far frames may be from the
    reference poses that give the map, in its unit and radians, None where VIO gives it."""

    components: list[Component]
    placed: list[PlacedComponent]
    checks: list[CheckResult]
    frames: FrameVerdicts
    windows: Sequence[SegmentWindow] = ()
    reference_limit: tuple[float, float] | None = None

    def where(self, mask: np.ndarray) -> "CheckedMap":
        """Of the rows of the frames table for which `mask` (N,) holds, numbered from 0; windows and checks stay as they
        are."""
        row_of = np.cumsum(mask) - 1
        components: dict[int, Component] = {}
        for component in self.components:
            segments = [s.where(mask[s.rows]) for s in component.segments if mask[s.rows].any()]
            if segments:
                segments = [replace(s, rows=row_of[s.rows]) for s in segments]
                components[component.index] = replace(component, segments=segments)
        return replace(
            self,
            components=list(components.values()),
            placed=[
                replace(p, component=components[p.component.index])
                for p in self.placed
                if p.component.index in components
            ],
            frames=FrameVerdicts(**{name: values[mask] for name, values in vars(self.frames).items()}),
        )
