"""The weights file that training leaves, and the regressor out of it."""

import pickle
from pathlib import Path
from typing import Any, NamedTuple

import torch

from groundwalk.store import UserError
from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.regressor_settings import RegressorSettings
from groundwalk.training.regressors import REGRESSORS


class Trained(NamedTuple):
    """A regressor out of a weights file, with what is needed to use it."""

    model: PoseRegressor
    scenes: list[str]
    resize: int
    crop: int
    focal_px: float | None
    """of the pinhole whose images it sees, principal point in the middle; None: images as captured"""
    width: int
    """of the window in the middle of the image, `crop` being its height"""
    upright: bool
    """images are turned about their middle until gravity points down; the poses are those of the turned camera"""


_ABOUT = Trained._fields[1:]


def save_trained(path: Path, name: str, settings: RegressorSettings, trained: Trained) -> None:
    """Write a weights file that `load_trained` can make the model from, without anything else."""
    path.parent.mkdir(exist_ok=True)
    state = {key: tensor.cpu().contiguous() for key, tensor in trained.model.state_dict().items()}
    about = {key: getattr(trained, key) for key in _ABOUT}
    torch.save({"model": name, "settings": settings.model_dump(), **about, "state": state}, path)


def load_trained(path: Path) -> Trained:
    """The regressor of a weights file, in eval mode on the CPU; UserError where it isn't one."""
    try:
        content: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        name, state = content["model"], content["state"]
        regressor = REGRESSORS.find(name)
    except (OSError, RuntimeError, EOFError, KeyError, TypeError, ValueError, pickle.UnpicklingError) as error:
        raise UserError(
            "not a trained model", where=path, expected="a file that the train stage wrote", found=type(error).__name__
        ) from None
    try:
        model = regressor.make(regressor.settings.model_validate(content["settings"]), len(content["scenes"]), True)
        model.load_state_dict(state)
        about = [content[key] for key in _ABOUT]
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            "the weights don't fit the model that their file names",
            where=path,
            expected=f"weights of {name} as this version of groundwalk builds it",
            found=" ".join(str(error).split())[:200],
            do="run the stage train again",
        ) from None
    return Trained(model.eval(), *about)
