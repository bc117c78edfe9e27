"""Where a backbone's first weights come from: ImageNet, a file, or chance."""

import hashlib
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

_ANSWER_WITHIN_S = 5.0
SETTING = setting_of("train.regressors.<model>", "weights")


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
            do = f"fetch the file elsewhere and put it at {path}, or name it, or scratch, in {SETTING}"
            raise UserError("ImageNet weights can't be fetched", where=url, found=error, do=do) from None
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


def _load_file(backbone: nn.Module, path: Path) -> str:
    """Load torchvision's state dict, every tensor of it but a classifier that the backbone lacks; returns the start of
    the file's sha256. UserError naming what is missing, unknown or of another shape."""
    name, expected = f"torchvision's {type(backbone).__name__}", backbone.state_dict()
    state, digest = read_state(path, f"the state dict of {name}")
    state = {k: v for k, v in state.items() if not k.startswith("fc.")}  # ResNet-34's classifier
    refuse_other_network(state, {k: v.shape for k, v in expected.items()}, path, name)
    backbone.load_state_dict(expected | state)
    return digest


def read_state(path: Path, expected: str) -> tuple[dict[str, Tensor], str]:
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
        found, do = f"NaN or infinity in {len(broken)} tensors ({broken[0]}, ...)", "fetch the file again"
        raise UserError("a weights file isn't finite", where=path, expected="numbers", found=found, do=do)
    return dict(state), digest


def refuse_other_network(
    state: Mapping[str, Tensor], expected: Mapping[str, torch.Size | None], path: Path, name: str
) -> None:
    """UserError where a state dict lacks tensors, has others, or some of another shape (None: of any). Batch counters,
    which files from before PyTorch 0.4 don't have and nothing here reads, may be missing."""
    faults = {
        "missing": [k for k in expected if k not in state and not k.endswith("num_batches_tracked")],
        "unknown": [k for k in state if k not in expected],
        "of another shape": [k for k in state if expected.get(k) is not None and state[k].shape != expected[k]],
    }
    if any(faults.values()):
        raise UserError(
            "a weights file is of another network",
            where=path,
            expected=f"{name}, {len(expected)} tensors",
            found="; ".join(f"{len(names)} {what} ({names[0]}, ...)" for what, names in faults.items() if names),
        )
