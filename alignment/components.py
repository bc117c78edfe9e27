"""SfM models of one scene: each metric and upright by itself."""

from dataclasses import dataclass

import numpy as np

from groundwalk.alignment.map_frame import MapScale, Vertical
from groundwalk.alignment.segments import Segment
from groundwalk.geometry.fits import Sim3, rotation_to_up


def registered_rows(segments: list[Segment]) -> np.ndarray:
    """Rows of the frames table that SfM has a pose for."""
    return np.concatenate([s.rows[s.registered] for s in segments])


@dataclass(frozen=True)
class ModelSegments:
    """A SfM model's frames: `segments` that are aligned, `pieces` that are cut at all VIO jumps."""

    model_id: str
    segments: list[Segment]
    pieces: list[Segment]

    @property
    def registered_rows(self) -> np.ndarray:
        return registered_rows(self.segments)


@dataclass(frozen=True, kw_only=True)
class Component:
    """A SfM model, numbered by size, with its segments and pieces, scale and vertical. `vio_scale` is its scale by VIO
    alone, the same unless a ruler or a reference sets the scale."""

    index: int
    model_id: str
    segments: list[Segment]
    pieces: list[Segment]
    scale: MapScale
    vertical: Vertical
    vio_scale: MapScale

    @property
    def metric_S_sfm(self) -> Sim3:
        """Metric and upright; origin and heading as they come."""
        return Sim3(float(np.exp(self.scale.log)), rotation_to_up(self.vertical.up_sfm), np.zeros(3))

    @property
    def registered_rows(self) -> np.ndarray:
        return registered_rows(self.segments)

    @property
    def frames(self) -> int:
        """How many frames it has a pose for."""
        return len(self.registered_rows)


@dataclass(frozen=True)
class VioLink:
    """How VIO ties a component to the map: through a session, over `gap_m` of its path without a frame of either. About
    `anchor` (3,) in the map the component may be turned and shifted by the standard errors."""

    session_id: str
    gap_m: float
    path_m: float
    anchor: np.ndarray
    position_sd_m: float
    heading_sd: float


@dataclass(frozen=True)
class PlacedComponent:
    """A component in the map, tied to the first one by a chain of links, which ends with its own."""

    component: Component
    map_S_sfm: Sim3
    links: tuple[VioLink, ...] = ()

    @property
    def link(self) -> VioLink | None:
        """Its own link; None for the first component."""
        return self.links[-1] if self.links else None
