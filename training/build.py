"""Regressors from settings, and from the weights file that training leaves."""

import pickle
from pathlib import Path
from typing import Any, NamedTuple

import torch

from groundwalk.artefacts import UserError
from groundwalk.training.models.ms_transformer import MSTransformer
from groundwalk.training.models.posenet import PoseNet
from groundwalk.training.models.regressor import PoseRegressor
from groundwalk.training.settings import (
    ModelName,
    MSTransformerSettings,
    PoseNetSettings,
    RegressorSettings,
    TrainSettings,
)


def settings_of(name: ModelName, settings: TrainSettings) -> RegressorSettings:
    """The part of the stage's settings that is this model's."""
    return settings.pn if name == "PN" else settings.mst


def build(settings: RegressorSettings, scenes: int, outdoor: bool) -> PoseRegressor:
    """A regressor with random weights for so many scenes."""
    match settings:
        case PoseNetSettings():
            if scenes != 1:
                raise ValueError("PN holds one scene")
            return PoseNet(settings.dropout, settings.sx, settings.sq)
        case MSTransformerSettings():
            sx, sq = (-3.0, -6.5) if outdoor else (0.0, -3.0)
            return MSTransformer(
                scenes,
                settings.encoder_layers,
                settings.decoder_layers,
                settings.dropout,
                settings.stochastic_depth,
                sx if settings.sx is None else settings.sx,
                sq if settings.sq is None else settings.sq,
            )
    raise TypeError(type(settings).__name__)


class Trained(NamedTuple):
    """A regressor out of a weights file, with what is needed to use it."""

    model: PoseRegressor
    scenes: list[str]
    resize: int
    crop: int
    focal_px: float | None
    """of the pinhole whose images it sees, principal point in the middle; None: images as captured"""


def save_trained(path: Path, name: str, settings: RegressorSettings, trained: Trained) -> None:
    """Write a weights file that `load_trained` can make the model from, without anything else."""
    path.parent.mkdir(exist_ok=True)
    content = {
        "model": name,
        "settings": settings.model_dump(),
        "scenes": trained.scenes,
        "resize": trained.resize,
        "crop": trained.crop,
        "focal_px": trained.focal_px,
        "state": {key: tensor.cpu().contiguous() for key, tensor in trained.model.state_dict().items()},
    }
    torch.save(content, path)


def load_trained(path: Path) -> Trained:
    """The regressor of a weights file, in eval mode on the CPU; UserError where it isn't one."""
    try:
        content: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True)
        kinds: dict[str, type[RegressorSettings]] = {"PN": PoseNetSettings, "MS-T": MSTransformerSettings}
        kind = kinds[content["model"]]
        model = build(kind.model_validate(content["settings"]), len(content["scenes"]), outdoor=True)
        model.load_state_dict(content["state"])
    except (OSError, RuntimeError, EOFError, KeyError, TypeError, ValueError, pickle.UnpicklingError) as error:
        raise UserError(
            "not a trained model", where=path, expected="a file that the train stage wrote", found=type(error).__name__
        ) from None
    return Trained(model.eval(), content["scenes"], content["resize"], content["crop"], content["focal_px"])
