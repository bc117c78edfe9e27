"""Odometry carried into the map by the first predictions' mean alignment, for ever."""

import numpy as np
from pydantic import Field

from groundwalk.fusion.methods import Method
from groundwalk.fusion.methods.localiser import Estimate, MethodOptions, Status
from groundwalk.geometry.averages import quaternion_mean
from groundwalk.geometry.poses import Array, inverse, pose_from_tq, tq_from_pose


class KeepFirstOptions(MethodOptions):
    """Section [fuse.options.keep_first]."""

    predictions: int = Field(3, gt=0, description="predictions that the alignment is the mean of")


class KeepFirst:
    """`step` gets the frames of a session in order; a session has a fresh one."""

    def __init__(self, options: KeepFirstOptions) -> None:
        self.options = options
        self.alignments: list[Array] = []

    def step(
        self, t_ns: int, vio_T_cam: Array | None, map_T_cam_predicted: Array | None, gravity: Array | None = None
    ) -> Estimate:
        if vio_T_cam is None:
            return Estimate(None, Status.NONE, reasons=("no_odometry",))
        if map_T_cam_predicted is not None and len(self.alignments) < self.options.predictions:
            self.alignments.append(map_T_cam_predicted @ inverse(vio_T_cam))
        if not self.alignments:
            return Estimate(None, Status.NONE, reasons=("no_prediction",))
        position, quaternion = tq_from_pose(np.array(self.alignments))
        map_T_vio = pose_from_tq(position.mean(axis=0), quaternion_mean(quaternion))
        signals = {"predictions": float(len(position))}
        return Estimate(map_T_vio @ vio_T_cam, Status.FUSED, map_T_vio=map_T_vio, signals=signals)


METHOD = Method(
    id="keep_first",
    label="first",
    meaning="the mean alignment of the first predictions",
    colour=(120, 94, 240),
    make=KeepFirst,
    options=KeepFirstOptions,
    causal=True,
    visible=True,
)
