"""Regressors on a GPU; skipped where there is none."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from groundwalk.training.data import View, normalised
from groundwalk.training.loop import take_best, train
from groundwalk.training.models.efficientnet import MBConv
from groundwalk.training.models.regressor import FrozenRegressor, PoseRegressor
from groundwalk.training.poses import PoseBatch
from groundwalk.training.predict import answers, pose_errors
from groundwalk.training.regressor_settings import RegressorSettings
from groundwalk.training.regressors import REGRESSORS
from groundwalk.training.sources import Run
from groundwalk.training.steps import GradientStep, gradient_step
from tests.training.test_loop import CPU, random_frames, silent

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="PyTorch sees no GPU")
CUDA, VIEW = torch.device("cuda"), View(32, 32)


def made(name: str, poses: PoseBatch, random: bool = True) -> tuple[PoseRegressor, RegressorSettings]:
    """A regressor with its first weights, on the CPU; `random`: with dropout and stochastic depth."""
    torch.manual_seed(0)
    entry = REGRESSORS[name]
    chosen = entry.settings(batch=8, epochs=5)
    model = entry.make(chosen, 1, False)
    for module in model.modules() if not random else ():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.0
        if isinstance(module, torch.nn.MultiheadAttention):
            module.dropout = 0.0
        if isinstance(module, MBConv):
            module.drop_probability = 0.0
    model.initialise(poses, chosen, Path("nowhere"))
    return model, chosen


@pytest.mark.parametrize("name", list(REGRESSORS.builtin))
def test_trains_and_answers(tmp_path: Path, name: str) -> None:
    frames = random_frames(tmp_path / "images", 20)
    model, chosen = made(name, frames.poses(CPU))
    train(silent, model, frames, frames, Run("test", chosen, CUDA, "bf16", VIEW, 0, tmp_path))
    assert np.isfinite([row["train_loss"] for row in take_best(model, tmp_path)]).all()
    estimates = answers(model, frames, VIEW, CUDA)
    assert estimates.position_B3.device.type == "cuda"
    model.calibrate(estimates, frames.poses(CUDA))
    on_gpu = pose_errors(model, frames, VIEW, CUDA)
    for errors, on_cpu in zip(on_gpu, pose_errors(model.to(CPU), frames, VIEW, CPU), strict=True):
        assert errors == pytest.approx(on_cpu, rel=0.05, abs=0.05)


@pytest.mark.parametrize("name", ["PN", "MS-T", "PN-Lite"])
def test_a_recorded_step_is_the_same_step(tmp_path: Path, name: str) -> None:
    """For batches of two shapes in turn, whose numbers differ each time."""
    frames = random_frames(tmp_path / "images", 30)
    model, _ = made(name, frames.poses(CPU), random=False)
    assert model.recordable
    model.to(CUDA).train()

    def batch(count: int, first: int) -> tuple[Tensor, PoseBatch]:
        chosen = frames.select(np.arange(first, first + count))
        image = normalised(chosen.training_crops(VIEW, None, np.random.default_rng(0), CUDA)[0])
        inputs = model.reduced(model.features(image)) if isinstance(model, FrozenRegressor) else image
        return inputs, chosen.poses(CUDA)

    if isinstance(model, FrozenRegressor):
        model.fit_features(model.features(normalised(frames.centre_crops(VIEW, CUDA))))

    recorded = gradient_step(model, "fp32", CUDA)
    plain = GradientStep(model, recorded.loss, record=False)
    assert recorded.record
    before = {key: value.clone() for key, value in model.state_dict().items()}
    for count, first in ((9, 0), (6, 9), (9, 15), (6, 24)):
        values, gradients, buffers = [], [], []
        for step in (plain, recorded):
            model.load_state_dict(before)
            values.append(step(*batch(count, first)).item())
            gradients.append([p.grad.clone() for p in model.parameters() if p.grad is not None])
            buffers.append([buffer.clone() for buffer in model.buffers()])
        assert values[1] == pytest.approx(values[0], rel=1e-4)
        for a, b in zip(*gradients, strict=True):
            assert torch.allclose(a, b, rtol=1e-2, atol=1e-3 * float(a.abs().max()) + 1e-6)
        for a, b in zip(*buffers, strict=True):
            assert torch.allclose(a, b, rtol=1e-3, atol=1e-5)
