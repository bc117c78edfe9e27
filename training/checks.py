"""Does a regressor give what the training loop and the tables need? Asked before training, not hours later."""

import copy

import torch
from torch import Tensor

from groundwalk.training.data import View, normalised
from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.poses import PoseBatch

_IMAGES = 2
_UNIT = 1e-3


def check_regressor(model: PoseRegressor, scenes: int, view: View, gives_covariance: bool) -> None:
    """Run a copy of the model, on a CPU, over two images of noise; ValueError or TypeError naming what isn't as it
    should be. The random numbers of PyTorch go on as if nothing had been drawn."""
    if not isinstance(model, PoseRegressor):
        raise TypeError(f"make returned a {type(model).__name__}, not a PoseRegressor")
    with torch.random.fork_rng(devices=[]):
        model = copy.deepcopy(model)
        image = normalised(torch.rand(_IMAGES, 3, view.height, view.width))
        with torch.no_grad():
            answer = model.eval()(image)
        _check_poses(answer, scenes, gives_covariance)
        truth = PoseBatch(
            torch.randn(_IMAGES, 3),
            torch.nn.functional.normalize(torch.randn(_IMAGES, 4), dim=-1),
            torch.zeros(_IMAGES, dtype=torch.long),
        )
        loss = model.train().loss(image, truth)
    if not isinstance(loss, Tensor) or loss.shape != () or not loss.requires_grad:
        raise ValueError(f"loss returned {_described(loss)}, not a scalar with a gradient")


def _check_poses(answer: object, scenes: int, gives_covariance: bool) -> None:
    if not isinstance(answer, PoseBatch):
        raise TypeError(f"forward returned a {type(answer).__name__}, not a PoseBatch")
    shapes = {"position_B3": (_IMAGES, 3), "quaternion_B4": (_IMAGES, 4), "scene_B": (_IMAGES,)}
    if gives_covariance:
        shapes["covariance_B66"] = (_IMAGES, 6, 6)
    for name, shape in shapes.items():
        tensor = getattr(answer, name)
        if not isinstance(tensor, Tensor) or tensor.shape != shape:
            raise ValueError(f"forward's {name} is {_described(tensor)}, not {shape} for {_IMAGES} images")
    lengths = torch.linalg.vector_norm(answer.quaternion_B4.float(), dim=-1)
    if not bool(((lengths - 1).abs() < _UNIT).all()):
        raise ValueError(f"forward's quaternion_B4 have lengths {lengths.tolist()}, not 1")
    if not bool(((answer.scene_B >= 0) & (answer.scene_B < scenes)).all()):
        raise ValueError(f"forward's scene_B is {answer.scene_B.tolist()}, not from 0 to {scenes - 1}")


def _described(value: object) -> str:
    return f"of shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"
