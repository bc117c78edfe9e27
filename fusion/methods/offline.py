"""Methods that see the whole of a walk before they answer: bounds and labels, never to be ranked with causal ones."""

from abc import ABC, abstractmethod

import numpy as np

from groundwalk.fusion.methods.localiser import Estimate, Localiser, Stepping
from groundwalk.fusion.walk import Walk
from groundwalk.geometry.poses import Array


class Offline(ABC):
    """Answers a whole walk at once. Its answers to a frame may hang on later frames, and on the ground truth."""

    @abstractmethod
    def estimates(self, walk: Walk) -> list[Estimate]:
        """One estimate a frame of the walk."""


def stepped(localiser: Stepping, walk: Walk) -> list[Estimate]:
    """What a localiser says to a walk's frames, one after the other, as on a device. A `Localiser` also gets the
    covariances that predictions bring."""
    return [localiser.step(*f) if isinstance(localiser, Localiser) else localiser.step(*f[:4]) for f in frames(walk)]


def frames(walk: Walk) -> list[tuple[int, Array | None, Array | None, Array | None, Array | None]]:
    """What `Localiser.step` takes of each frame, None for what is missing."""
    vio_T_cam, predicted, gravity, covariance = (
        [None] * len(walk) if values is None else [value if np.isfinite(value).all() else None for value in values]
        for values in (walk.vio_T_cam, walk.map_T_cam_predicted, walk.gravity, walk.predicted_covariance)
    )
    return list(zip(map(int, walk.t_ns), vio_T_cam, predicted, gravity, covariance, strict=True))
