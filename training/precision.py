"""float32 or bfloat16 (autocast) in training: which one is faster is measured, since what the processor claims doesn't
say it."""

import contextlib
import copy
import math
import time
from collections.abc import Iterator
from typing import Literal

import numpy as np
import torch
from torch import Tensor
from torch.nn.attention import SDPBackend, sdpa_kernel

from groundwalk.training.data import Frames, View, normalised
from groundwalk.training.models.regressor import FrozenRegressor, PoseBatch, PoseRegressor
from groundwalk.training.steps import GradientStep

Precision = Literal["fp32", "bf16"]
WORDS: dict[Precision, str] = {"fp32": "float32", "bf16": "bfloat16"}
_GAIN = 1.1  # bfloat16 is coarser, so it has to be so many times as fast
_SECONDS = 1.0
_MIN_STEPS = 2


@contextlib.contextmanager
def autocast(precision: Precision, device: torch.device) -> Iterator[None]:
    """bfloat16 where that is the precision."""
    with contextlib.ExitStack() as stack:
        if precision == "bf16":
            stack.enter_context(torch.autocast(device.type, torch.bfloat16))
            if device.type == "cpu":
                # The fused attention's bfloat16 backward is several times slower on a CPU than plain products.
                stack.enter_context(sdpa_kernel(SDPBackend.MATH))
        yield


def gradient_step(model: PoseRegressor, precision: Precision, device: torch.device) -> GradientStep:
    """The regressor's loss and gradient in a precision, recorded where a GPU can run it so. Its inputs are images, of a
    FrozenRegressor the reduced features."""

    def loss(inputs: tuple[Tensor, ...], poses: PoseBatch) -> Tensor:
        with autocast(precision, device):
            if isinstance(model, FrozenRegressor):
                return model.feature_loss(inputs, poses)
            return model.loss(inputs[0], poses)

    return GradientStep(model, loss, record=model.recordable and device.type == "cuda")


def step_seconds(
    model: PoseRegressor, training: Frames, batch: int, view: View, device: torch.device
) -> dict[Precision, float]:
    """How long a training step's loss and gradient take in each precision: the shortest of the steps of about a second,
    the precisions in turn. On a CPU in seconds of the processor, which other work disturbs least.

    Infinite in bfloat16 where the model can't compute in it. The steps are those of a copy: the model and PyTorch's
    random numbers stay as they are.
    """
    with torch.random.fork_rng(devices=[] if device.type == "cpu" else [device]):
        model = copy.deepcopy(model).to(device, memory_format=torch.channels_last).train()  # type: ignore[call-overload]
        rows = training.sequences(np.arange(batch) % len(training), *model.sequence())
        frames = training.select(rows)
        image = normalised(frames.training_crops(view, None, np.random.default_rng(0), device)[0])
        image, poses = image.contiguous(memory_format=torch.channels_last), frames.poses(device)
        inputs = model.reduced_features(image) if isinstance(model, FrozenRegressor) else (image,)

        gradients = {precision: gradient_step(model, precision, device) for precision in WORDS}

        def step(precision: Precision) -> float:
            started = seconds_on(device)
            gradients[precision](inputs, poses)
            return seconds_on(device) - started

        seconds: dict[Precision, float] = dict.fromkeys(WORDS, math.inf)
        step("fp32")  # the first steps choose kernels and allocate
        try:
            step("bf16")
        except RuntimeError:  # an operation that mixes both or has no bfloat16
            return {"fp32": step("fp32"), "bf16": math.inf}
        steps, spent = 0, 0.0
        while steps < _MIN_STEPS or spent < _SECONDS * len(WORDS):
            for precision in WORDS:
                took = step(precision)
                seconds[precision] = min(seconds[precision], took)
                spent += took
            steps += 1
    return seconds


def faster(seconds: dict[Precision, float]) -> Precision:
    """bf16 where its steps are clearly the shorter ones."""
    return "bf16" if seconds["bf16"] * _GAIN <= seconds["fp32"] else "fp32"


def seconds_on(device: torch.device) -> float:
    """Seconds, of the processor or of the clock, after what the device has been asked for is done."""
    if device.type == "cpu":
        return time.process_time()
    torch.cuda.synchronize(device)
    return time.perf_counter()
