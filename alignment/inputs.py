"""What the alignment works on: tables of import and SfM, rulers in the images, and a data set's reference poses."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import pandas as pd

from groundwalk.alignment.components import ModelSegments
from groundwalk.alignment.reference.poses import Reference
from groundwalk.alignment.rulers.measurement import RulerMeasurement
from groundwalk.alignment.segments import cut_segments, frame_components
from groundwalk.alignment.settings import AlignSettings
from groundwalk.alignment.sfm_tables import SfmTables


@dataclass(frozen=True, kw_only=True)
class AlignInputs:
    """`frames` and `jumps` are import's tables, `recordings` names each session's recording; `rulers` are measured in
    SfM's models. `gravity_tested`: the recordings whose gravity import has found confirmed by the images."""

    frames: pd.DataFrame
    sfm: SfmTables
    jumps: pd.DataFrame
    recordings: dict[str, str]
    rulers: Sequence[RulerMeasurement] = ()
    reference: Reference | None = None
    gravity_tested: frozenset[str] = frozenset()

    @property
    def registered(self) -> np.ndarray:
        """(N,) frames that SfM has a pose for."""
        return self.sfm.images["registered"].to_numpy(bool)

    @property
    def not_registered(self) -> np.ndarray:
        """(N,) why SfM has no pose for a frame, empty where it has."""
        why = self.sfm.images["not_registered"]
        reasons = np.where(why.isna(), "SfM didn't register it", "SfM didn't register it: " + why.fillna(""))
        return np.where(self.registered, "", reasons).astype(object)

    def models(self, settings: AlignSettings) -> list[ModelSegments]:
        """SfM's models, largest first: cut at the VIO jumps of the settings, and in pieces at all VIO jumps, as scale
        and motion are compared between these."""
        images = self.sfm.images
        names, component_of = frame_components(self.frames, images)
        cut = partial(cut_segments, self.frames, images, self.jumps, self.recordings, component_of)
        segments = cut(jump_m=settings.segment_jump_m, jump_deg=settings.segment_jump_deg)
        pieces = cut(jump_m=0.0, jump_deg=0.0)
        return [
            ModelSegments(name, [s for s in segments if s.component == i], [p for p in pieces if p.component == i])
            for i, name in enumerate(names)
        ]

    def rulers_of(self, model_id: str) -> list[RulerMeasurement]:
        """The rulers that a model's frames see."""
        return [ruler for ruler in self.rulers if ruler.model_id == model_id]
