"""Method `vio_oracle`: odometry laid on the ground truth, the bound for one rigid alignment. Offline.

It reads the true poses of the walk that it answers, so it says nothing of what a phone could do: only how much of a
method's error is odometry's own drift, which no alignment takes away.
"""

from math import radians

import numpy as np
from pydantic import Field

from groundwalk.fusion.methods.localiser import Estimate, Status
from groundwalk.fusion.methods.odometry import OdometryOptions, have_jumped
from groundwalk.fusion.methods.offline import Offline
from groundwalk.fusion.walk import Walk, known
from groundwalk.geometry.fits import fit_poses


class VioOracleOptions(OdometryOptions):
    position_sd_m: float = Field(0.5, gt=0, description="in the fit: position error that weighs as much as ...")
    rotation_sd_deg: float = Field(4.0, gt=0, description="... this rotation error")


class VioOracle(Offline):
    """Each stretch between odometry jumps is aligned by least squares to the true poses of its frames."""

    def __init__(self, options: VioOracleOptions | None = None) -> None:
        self.options = options or VioOracleOptions()

    def estimates(self, walk: Walk) -> list[Estimate]:
        o = self.options
        answers = [Estimate(None, Status.NONE, reasons=("no_odometry",)) for _ in range(len(walk))]
        true = known(walk.map_T_cam)
        for frames in self._stretches(walk):
            fitted = frames[true[frames]]
            if not len(fitted):
                for i in frames:
                    answers[i] = Estimate(None, Status.NONE, reasons=("no_ground_truth",))
                continue
            true_T_cam, vio_T_cam, sd = walk.map_T_cam[fitted], walk.vio_T_cam[fitted], radians(o.rotation_sd_deg)
            map_T_vio = fit_poses(true_T_cam, vio_T_cam, position_sd_m=o.position_sd_m, rotation_sd=sd)
            for i in frames:
                answers[i] = Estimate(map_T_vio @ walk.vio_T_cam[i], Status.OPTIMISED, map_T_vio=map_T_vio)
        return answers

    def _stretches(self, walk: Walk) -> list[np.ndarray]:
        """Indices of the frames with odometry, split at its jumps."""
        frames = np.flatnonzero(known(walk.vio_T_cam))
        seconds = np.diff(walk.t_ns[frames]) * 1e-9
        moved = np.linalg.norm(np.diff(walk.vio_T_cam[frames, :3, 3], axis=0), axis=1)
        jumps = np.flatnonzero(have_jumped(seconds, moved, self.options)) + 1
        return [part for part in np.split(frames, jumps) if len(part)]
