"""SfM models of one scene: each metric and upright by itself, and where it lies in the map."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from groundwalk.alignment.segments import Segment, registered_rows
from groundwalk.consistency.scale import Scale
from groundwalk.geometry.fits import Sim3, rotation_to_up
from groundwalk.geometry.poses import Array
from groundwalk.store.choices import ScaleSource, VerticalSource

# A scale, as a fraction, and a vertical, radians an axis, with larger standard errors are called uncertain: each puts
# points that are a metre apart 2 cm off.
MAX_SCALE_SD, MAX_VERTICAL_SD = 0.02, float(np.radians(1.0))


@dataclass(frozen=True)
class MapScale:
    """Metres per SfM unit by all recordings: logarithm, standard error (NaN: unknown, the unit stays SfM's), and each
    recording's scale. `rulers` names the rulers that logarithm and standard error are by instead, where there are any;
    `reference` says that they are by reference poses, `given_by` that a survey or GPS gives them."""

    log: float
    sd: float
    recordings: dict[str, Scale]
    rulers: tuple[str, ...] = ()
    reference: ScaleSource | None = None
    given_by: str = ""

    @property
    def is_known(self) -> bool:
        """The map is metric."""
        return bool(np.isfinite(self.sd)) and self.reference is not ScaleSource.REFERENCE_UNIT_UNKNOWN

    @property
    def by(self) -> str:
        """What gives it."""
        return f"ruler: {', '.join(self.rulers)}" if self.rulers else self.reference or self.given_by or ScaleSource.VIO

    @property
    def source(self) -> str:
        """What gives it, as tables have it, and whether it is uncertain."""
        if not self.is_known:
            return self.reference or ScaleSource.NONE
        return self.by if self.sd <= MAX_SCALE_SD else f"{self.by}, uncertain"


NO_SCALE = MapScale(0.0, float("nan"), {})


class RecordingVertical(NamedTuple):
    """A recording's up (3,) in SfM's axes, and the standard error of its mean, radians per axis."""

    up_sfm: Array
    sd: float


@dataclass(frozen=True)
class Vertical:
    """The map's up (3,) in SfM's axes, standard error of its tilt in radians (per axis), each recording's vertical, and
    what gives it. Where nothing does, up is any direction, and the standard error NaN. `is_agreed`: most recordings
    have it, so that one that has another is wrong."""

    up_sfm: Array
    sd: float
    recordings: dict[str, RecordingVertical]
    source: VerticalSource = VerticalSource.GRAVITY
    is_agreed: bool = True


@dataclass(frozen=True)
class GivenFrame:
    """Scale and vertical of the first model by what is neither its recordings' nor a ruler's; None where not given."""

    scale: MapScale | None = None
    vertical: Vertical | None = None


NOT_GIVEN = GivenFrame()


@dataclass(frozen=True, kw_only=True)
class Component:
    """A SfM model, numbered by size, with its segments, scale and vertical. `vio_scale` is its scale by VIO alone, the
    same unless a ruler or a reference sets the scale."""

    index: int
    model_id: str
    segments: list[Segment]
    scale: MapScale
    vertical: Vertical
    vio_scale: MapScale

    @property
    def metric_S_sfm(self) -> Sim3:
        """Metric and upright; origin and heading as they come."""
        return Sim3(float(np.exp(self.scale.log)), rotation_to_up(self.vertical.up_sfm), np.zeros(3))

    @property
    def registered_rows(self) -> np.ndarray:
        """Rows of the frames table that it has a pose for."""
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

    def covariance(self, map_xyz: Array) -> Array:
        """Covariances (N, 6, 6) at positions (N, 3) behind the link, all of which it turns and shifts alike."""
        arm = np.asarray(map_xyz, dtype=float) - self.anchor
        jacobian = np.zeros((len(arm), 6, 4))
        jacobian[:, 1, 0] = 1.0
        jacobian[:, 3:, 0] = np.cross([0.0, 1.0, 0.0], arm)
        jacobian[:, 3:, 1:] = np.eye(3)
        variance = np.array([self.heading_sd, *[self.position_sd_m] * 3]) ** 2
        return np.einsum("nij,j,nkj->nik", jacobian, variance, jacobian)


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


Unlinked = tuple[Component, float | None, str]
"""A component that isn't in the map, the shortest VIO path to the map, m, if there is any, and why it isn't."""
