"""Methods that see the whole of a walk before they answer: bounds and labels, never to be ranked with causal ones."""

from abc import ABC, abstractmethod
from collections.abc import Iterator

import numpy as np

from groundwalk.fusion.localiser import Estimate, Stepping
from groundwalk.fusion.walks import Walk, known


class Offline(ABC):
    """Answers a whole walk at once. Its answers to a frame may hang on later frames, and on the ground truth."""

    @abstractmethod
    def estimates(self, walk: Walk) -> list[Estimate]:
        """One estimate a frame of the walk."""


def stepped(localiser: Stepping, walk: Walk) -> list[Estimate]:
    """What a localiser says to a walk's frames, one after the other, as on a device."""
    return list(steps(localiser, walk))


def steps(localiser: Localiser, walk: Walk) -> Iterator[Estimate]:
    """The same, frame by frame."""
    has_vio, has_apr = known(walk.vio_T_cam), known(walk.map_T_cam_apr)
    has_gravity = np.asarray(np.isfinite(walk.gravity).all(axis=1))
    covariances = walk.apr_covariance
    has_covariance = None if covariances is None else known(covariances)
    for i in range(len(walk)):
        yield localiser.step(
            int(walk.t_ns[i]),
            walk.vio_T_cam[i] if has_vio[i] else None,
            walk.map_T_cam_apr[i] if has_apr[i] else None,
            walk.gravity[i] if has_gravity[i] else None,
            covariances[i] if covariances is not None and has_covariance is not None and has_covariance[i] else None,
        )
