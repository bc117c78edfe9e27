"""Which precision is trained in, and that a resumed run keeps it."""

import math
import time
from collections.abc import Callable
from pathlib import Path

import pandas as pd
import pytest
import torch
from torch import Tensor

from groundwalk.store import DataRoot, execute
from groundwalk.store.manifests import load_manifest
from groundwalk.training import precision, stage
from groundwalk.training.data import View
from groundwalk.training.definition import STAGE
from groundwalk.training.models.regressor import PoseBatch
from groundwalk.training.precision import Precision, faster, step_seconds
from tests.training.test_loop import CPU, SmallRegressor, random_frames

SETTINGS = [
    "resize=40",
    "crop=32",
    "device=cpu",
    'models=["PN"]',
    "regressors.PN.epochs=1",
    "regressors.PN.weights=scratch",
]


class SlowIn(SmallRegressor):
    """Its loss takes a twentieth of a second more in one precision."""

    def __init__(self, slow: Precision) -> None:
        super().__init__()
        self.slow = slow

    def loss(self, image_B3HW: Tensor, poses: PoseBatch) -> Tensor:
        if torch.is_autocast_enabled("cpu") == (self.slow == "bf16"):
            until = time.process_time() + 0.05
            while time.process_time() < until:
                pass
        with torch.autocast("cpu", enabled=False):
            return super().loss(image_B3HW, poses)


@pytest.mark.parametrize(("slow", "chosen"), [("fp32", "bf16"), ("bf16", "fp32")])
def test_the_precision_of_the_shorter_steps_is_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slow: Precision, chosen: Precision
) -> None:
    monkeypatch.setattr(precision, "_SECONDS", 0.1)
    model = SlowIn(slow)
    weights = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    state = torch.random.get_rng_state()
    seconds = step_seconds(model, random_frames(tmp_path / "images", 6), 4, View(32, 32), CPU)
    assert seconds[slow] > 0.05 > seconds[chosen]
    assert faster(seconds) == chosen
    assert torch.equal(torch.random.get_rng_state(), state)
    assert all(torch.equal(tensor, weights[name]) for name, tensor in model.state_dict().items())


def test_a_model_that_has_no_bfloat16_trains_in_float32(tmp_path: Path) -> None:
    seconds = step_seconds(SmallRegressor(), random_frames(tmp_path / "images", 6), 4, View(32, 32), CPU)
    assert seconds["bf16"] == math.inf and faster(seconds) == "fp32"


def test_bfloat16_has_to_be_clearly_faster() -> None:
    assert faster({"fp32": 1.05, "bf16": 1.0}) == "fp32"
    assert faster({"fp32": 1.2, "bf16": 1.0}) == "bf16"


@pytest.mark.slow
def test_a_resumed_run_keeps_its_precision(make_scene: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    data = DataRoot(make_scene())
    settings = [*SETTINGS, "regressors.PN.precision=measured"]

    def killed(*arguments: object) -> object:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(stage, "step_seconds", lambda *_: {"fp32": 3.0, "bf16": 1.0})
        patched.setattr(stage, "in_children", killed)
        with pytest.raises(KeyboardInterrupt):
            execute(STAGE, "Wall", "tiny", data, settings)
    monkeypatch.setattr(stage, "step_seconds", lambda *_: {"fp32": 1.0, "bf16": 3.0})
    folder = execute(STAGE, "Wall", "tiny", data, settings)
    manifest = load_manifest(folder)
    assert manifest["resumed"] and manifest["figures"]["PN precision"] == "bf16"
    device = pd.read_parquet(folder / "models.parquet")["device"][0]
    assert device.endswith("trained in bfloat16 (a step in bfloat16 measured 3.00 times as fast as in float32)")


@pytest.mark.slow
def test_a_setting_decides_instead(make_scene: Callable[..., Path], monkeypatch: pytest.MonkeyPatch) -> None:
    data = DataRoot(make_scene())
    monkeypatch.setattr(stage, "step_seconds", lambda *_: {"fp32": 3.0, "bf16": 1.0})
    folder = execute(STAGE, "Wall", "tiny", data, [*SETTINGS, "regressors.PN.precision=fp32"])
    assert load_manifest(folder)["figures"]["PN precision"] == "fp32"
