"""Method `smoother`: the model of `drift_aware`, offline: each frame is answered from the whole walk. For labelling.

The filter runs over the walk forwards and backwards. What the frames up to one say of it and what the later ones say
are independent but for the prior, so their Gaussians multiply (the two-filter smoother; Fraser and Potter, IEEE
Transactions on Automatic Control 14, 1969). Both passes begin with the scales of errors that a first pass has learnt.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from groundwalk.fusion.drift_aware import DriftAware, DriftAwareOptions
from groundwalk.fusion.error_map import ErrorMap, Expected
from groundwalk.fusion.localiser import Estimate, Status
from groundwalk.fusion.offline import Offline, stepped
from groundwalk.fusion.walks import Walk
from groundwalk.geometry.poses import Array

# Information of the prior that both passes hold: the bias has unit variance, the alignment is unknown.
_PRIOR = np.diag([0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 1.0])
_MOST_PRIOR = 0.9  # of what is known in any direction may be taken away as prior


class SmootherOptions(DriftAwareOptions):
    """The filter's options."""


class _Gaussian(NamedTuple):
    x: Array  # (8,)
    P: Array  # (8, 8)


class _Known(NamedTuple):
    """What a pass knew of a frame before and after its prediction; None where nothing."""

    before: _Gaussian | None
    after: _Gaussian | None


class _Pass(DriftAware):
    """The filter, which notes what it knew of each frame."""

    def __init__(self, options: SmootherOptions, error_map: ErrorMap | None, learnt: DriftAware | None = None) -> None:
        super().__init__(options, error_map)
        self.known: list[_Known] = []
        self._before: _Gaussian | None = None
        if learnt is not None:
            self._scale, self._change = list(learnt._scale), list(learnt._change)

    def step(
        self,
        t_ns: int,
        vio_T_cam: Array | None,
        map_T_cam_apr: Array | None,
        gravity: Array | None = None,
        apr_covariance: Array | None = None,
    ) -> Estimate:
        self._before = None
        estimate = super().step(t_ns, vio_T_cam, map_T_cam_apr, gravity, apr_covariance)
        after = _Gaussian(*self._mean()) if estimate.status is Status.FUSED else None
        uncorrected = "no_prediction" in estimate.reasons
        self.known.append(_Known(after if uncorrected else self._before, after))
        return estimate

    def _correct(
        self, measured: Array, tilt: float, signals: dict[str, float], expected: Expected
    ) -> tuple[float, float]:
        self._before = _Gaussian(*self._mean())
        return super()._correct(measured, tilt, signals, expected)

    def posed(self, vio_T_cam: Array, gaussian: _Gaussian, reasons: tuple[str, ...]) -> Estimate:
        """The estimate that a state gives."""
        return self._estimate(vio_T_cam, gaussian.x, gaussian.P, reasons, {})


class Smoother(Offline):
    """Both passes and their product. Frames without odometry are answered with their raw prediction."""

    def __init__(self, options: SmootherOptions | None = None, error_map: ErrorMap | None = None) -> None:
        self.options = options or SmootherOptions()
        self._error_map = error_map

    def estimates(self, walk: Walk) -> list[Estimate]:
        first = _Pass(self.options, self._error_map)
        stepped(first, walk)
        forward, backward = (_Pass(self.options, self._error_map, first) for _ in range(2))
        answers = stepped(forward, walk)
        stepped(backward, _reversed(walk))
        smoothed = []
        for i, (now, later) in enumerate(zip(forward.known, reversed(backward.known), strict=True)):
            both = [g for g in (now.after, later.before if now.after else later.after) if g is not None]
            if not both:
                smoothed.append(answers[i])
                continue
            gaussian = _product(*both) if len(both) == 2 else both[0]
            smoothed.append(forward.posed(walk.vio_T_cam[i], gaussian, answers[i].reasons))
        return smoothed


def _product(a: _Gaussian, b: _Gaussian) -> _Gaussian:
    """What two passes know together. Yaws are brought to the same turn."""
    x_b = b.x.copy()
    x_b[0] = a.x[0] + (x_b[0] - a.x[0] + np.pi) % (2 * np.pi) - np.pi
    information_a, information_b = np.linalg.inv(a.P), np.linalg.inv(b.P)
    information = information_a + information_b
    # Filters that disagree spread wider than the prior, and then there isn't all of it to take away.
    share = float(np.linalg.eigvals(np.linalg.solve(information, _PRIOR)).real.max())
    P = np.linalg.inv(information - min(1.0, _MOST_PRIOR / share) * _PRIOR)
    x = P @ (information_a @ a.x + information_b @ x_b)
    return _Gaussian(x, (P + P.T) / 2)


def _reversed(walk: Walk) -> Walk:
    """The walk from its end to its beginning."""
    return replace(
        walk,
        frame_id=walk.frame_id[::-1],
        t_ns=walk.t_ns[-1] + walk.t_ns[0] - walk.t_ns[::-1],
        gravity=walk.gravity[::-1],
        vio_T_cam=walk.vio_T_cam[::-1],
        map_T_cam_apr=walk.map_T_cam_apr[::-1],
        map_T_cam=walk.map_T_cam[::-1],
    )
