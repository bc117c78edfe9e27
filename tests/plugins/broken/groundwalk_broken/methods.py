import numpy as np

from groundwalk.fusion.methods import Method
from groundwalk.fusion.methods.localiser import Estimate, MethodOptions, Status
from groundwalk.geometry.poses import Array


class WrongCovariance:
    def __init__(self, options: MethodOptions) -> None:
        self.options = options

    def step(
        self, t_ns: int, vio_T_cam: Array | None, map_T_cam_predicted: Array | None, gravity: Array | None = None
    ) -> Estimate:
        return Estimate(np.eye(4), Status.FUSED, covariance=np.eye(3))


WRONG_COVARIANCE = Method(
    id="wrong_covariance",
    label="wrong covariance",
    meaning="covariances of three numbers a side",
    colour=(0, 0, 0),
    make=WrongCovariance,
    options=MethodOptions,
    causal=True,
)
