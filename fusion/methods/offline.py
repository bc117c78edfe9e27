"""Methods that see the whole of a walk before they answer: bounds and labels, never to be ranked with causal ones."""

from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np

from groundwalk.fusion.methods.localiser import Estimate, Localiser, Stepping
from groundwalk.fusion.walk import Walk, known


class Offline(ABC):
    """Answers a whole walk at once. Its answers to a frame may hang on later frames, and on the ground truth."""

    @abstractmethod
    def estimates(self, walk: Walk) -> list[Estimate]:
        """One estimate a frame of the walk."""


def stepped(localiser: Stepping, walk: Walk) -> list[Estimate]:
    """What a localiser says to a walk's frames, one after the other, as on a device."""
    return list(steps(localiser, walk))


def steps(localiser: Stepping, walk: Walk) -> Iterator[Estimate]:
    """The same, frame by frame. A `Localiser` also gets the covariances that predictions bring."""
    has_vio, has_apr = known(walk.vio_T_cam), known(walk.map_T_cam_apr)
    has_gravity = np.asarray(np.isfinite(walk.gravity).all(axis=1))
    covariances = walk.apr_covariance
    has_covariance = np.zeros(len(walk), dtype=bool) if covariances is None else known(covariances)
    for i in range(len(walk)):
        frame = (
            int(walk.t_ns[i]),
            walk.vio_T_cam[i] if has_vio[i] else None,
            walk.map_T_cam_apr[i] if has_apr[i] else None,
            walk.gravity[i] if has_gravity[i] else None,
        )
        if isinstance(localiser, Localiser) and covariances is not None and has_covariance[i]:
            yield localiser.step(*frame, covariances[i])
        else:
            yield localiser.step(*frame)
