import torch
from torch import Tensor, nn

from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.poses import PoseBatch
from groundwalk.training.regressor_settings import RegressorSettings
from groundwalk.training.regressors import Regressor


class Constant(PoseRegressor):
    """Always the same pose; `largest` is the largest batch whose loss can be had."""

    def __init__(self, coordinates: int, largest: int) -> None:
        super().__init__()
        self.position = nn.Parameter(torch.zeros(coordinates))
        self.largest = largest

    def forward(self, image_B3HW: Tensor) -> PoseBatch:
        count = len(image_B3HW)
        quaternion = torch.tensor([[0.0, 0.0, 0.0, 1.0]]).repeat(count, 1)
        return PoseBatch(self.position.expand(count, -1), quaternion, torch.zeros(count, dtype=torch.long))

    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        if len(image_B3HW) > self.largest:
            raise RuntimeError("the batch is too large for me")
        return self.position.square().sum()


def make_wrong_shape(settings: RegressorSettings, scenes: int, outdoor: bool) -> Constant:
    return Constant(2, 100)


def make_failing(settings: RegressorSettings, scenes: int, outdoor: bool) -> Constant:
    return Constant(3, 2)


WRONG_SHAPE = Regressor(
    id="wrong_shape",
    label="wrong shape",
    meaning="positions of two coordinates",
    colour=(0, 0, 0),
    settings=RegressorSettings,
    make=make_wrong_shape,
    multi_scene=False,
    gives_covariance=False,
)
FAILS_IN_TRAINING = Regressor(
    id="fails_in_training",
    label="fails in training",
    meaning="has a loss for two images alone",
    colour=(0, 0, 0),
    settings=RegressorSettings,
    make=make_failing,
    multi_scene=False,
    gives_covariance=False,
)
