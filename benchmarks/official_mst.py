"""MS-Transformer's official code, from a folder that the user names; nothing of it is here.

https://github.com/yolish/multi-scene-pose-transformer (MIT), with efficientnet-pytorch 0.7.1 for its backbone. Of
torchvision it asks the version and whether it is traced.
"""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn

from groundwalk.store import UserError
from groundwalk.training.models.ms_transformer import MSTransformer

# Its published configuration for Cambridge Landmarks, which has nothing that another scene would change.
CONFIG: dict[str, Any] = {
    "batch_size": 8,
    "learnable": True,
    "s_x": -3.0,
    "s_q": -6.5,
    "lr": 1e-4,
    "norm": 2,
    "weight_decay": 1e-4,
    "eps": 1e-10,
    "num_t_encoder_layers": 6,
    "num_t_decoder_layers": 6,
    "num_rot_encoder_layers": 6,
    "num_rot_decoder_layers": 6,
    "dim_feedforward": 256,
    "hidden_dim": 256,
    "dropout": 0.1,
    "nheads": 4,
    "reduction": ["reduction_4", "reduction_3"],
}


class GivenMaps(nn.Module):
    """A backbone whose maps are given: `maps` are (B, 40, H/8, W/8) and (B, 112, H/16, W/16)."""

    maps: tuple[Tensor, Tensor]

    def extract_endpoints(self, _: Tensor) -> dict[str, Tensor]:
        return {"reduction_3": self.maps[0], "reduction_4": self.maps[1]}


def official_model(folder: Path, scenes: int, backbone: nn.Module | None = None) -> tuple[nn.Module, nn.Module]:
    """The official network and its pose loss; UserError where the folder hasn't its code, ImportError without
    efficientnet-pytorch, which its backbone is of unless one is given."""
    if not (folder / "models" / "transposenet" / "EMSTransPoseNet.py").is_file():
        raise UserError(
            "this isn't MS-Transformer's official code", where=folder, expected="a folder with models/transposenet"
        )
    if backbone is None:
        from efficientnet_pytorch import EfficientNet

        backbone = EfficientNet.from_name("efficientnet-b0")
    config = {**CONFIG, "num_scenes": scenes}
    with _importable(folder), patch.object(torch, "load", lambda *_, **__: backbone):
        regressors = importlib.import_module("models.transposenet.EMSTransPoseNet")
        losses = importlib.import_module("models.pose_losses")
        return regressors.EMSTransPoseNet(dict(config), "backbone"), losses.CameraPoseLoss(config)


def copy_weights(official: nn.Module, ours: MSTransformer) -> None:
    """Give our network the official one's weights but the backbone's, whose layout differs."""
    given: Any = official
    for name, branch, query, projection in (
        ("t", ours.position_transformer, given.query_embed_t, given.input_proj_t),
        ("rot", ours.rotation_transformer, given.query_embed_rot, given.input_proj_rot),
    ):
        theirs = getattr(given, f"transformer_{name}")
        branch.project.load_state_dict(projection.state_dict())
        branch.queries.load_state_dict(query.state_dict())
        for layer, source in zip(branch.encoder, theirs.encoder.layers, strict=True):
            _copy(source, layer, {"self_attn": "attention", "norm1": "norm1", "norm2": "norm2"})
        for layer, source in zip(branch.decoder, theirs.decoder.layers, strict=True):
            names = {"self_attn": "self_attention", "multihead_attn": "cross_attention"}
            _copy(source, layer, {**names, "norm1": "norm1", "norm2": "norm2", "norm3": "norm3"})
        branch.encoder_norm.load_state_dict(theirs.encoder.norm.state_dict())
        branch.decoder_norm.load_state_dict(theirs.decoder.norm.state_dict())
    place = given.backbone[1]
    ours.row_embedding.load_state_dict({"weight": place.row_embed.weight[: len(ours.row_embedding.weight)]})
    ours.column_embedding.load_state_dict({"weight": place.col_embed.weight[: len(ours.column_embedding.weight)]})
    ours.scene_logit.load_state_dict(given.scene_embed.state_dict())
    for head, source in (
        (ours.position_head, given.regressor_head_t),
        (ours.rotation_head, given.regressor_head_rot),
    ):
        head[0].load_state_dict(source.fc_h.state_dict())
        head[2].load_state_dict(source.fc_o.state_dict())


def _copy(source: Any, layer: Any, names: dict[str, str]) -> None:
    for theirs, mine in names.items():
        getattr(layer, mine).load_state_dict(getattr(source, theirs).state_dict())
    layer.feed_forward[0].load_state_dict(source.linear1.state_dict())
    layer.feed_forward[3].load_state_dict(source.linear2.state_dict())


@contextmanager
def _importable(folder: Path) -> Iterator[None]:
    """With the folder in front of the path, and the little of torchvision that it asks for."""
    version = ModuleType("torchvision")
    version.__version__, version._is_tracing = "0.9.0", lambda: False  # type: ignore[attr-defined]
    before = {name: module for name, module in sys.modules.items() if name.split(".")[0] in ("models", "torchvision")}
    for name in before:
        del sys.modules[name]
    sys.modules["torchvision"] = version
    sys.path.insert(0, str(folder))
    try:
        yield
    finally:
        sys.path.remove(str(folder))
        for name in [name for name in sys.modules if name.split(".")[0] in ("models", "torchvision")]:
            del sys.modules[name]
        sys.modules.update(before)
