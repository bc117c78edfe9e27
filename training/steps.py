"""The loss and gradient of a batch, in float32 or bfloat16: on a GPU, where the model allows it, as one CUDA graph.

MS-T's step is three thousand kernels of some microseconds each, which a processor takes longer to launch one by one
than a GPU to run. Recorded once for each shape of a batch, they are launched as one.
"""

from contextlib import ExitStack
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.attention import SDPBackend, sdpa_kernel

from groundwalk.training import processes
from groundwalk.training.models.regressor import FrozenRegressor, PoseRegressor
from groundwalk.training.poses import PoseBatch
from groundwalk.training.processes import Loss

Precision = Literal["fp32", "bf16"]
WORDS: dict[Precision, str] = {"fp32": "float32", "bf16": "bfloat16"}
_WARM_UP = 3  # steps before recording, in which libraries choose kernels and allocate


def gradient_step(model: PoseRegressor, precision: Precision, device: torch.device) -> "GradientStep":
    """The regressor's loss and gradient in a precision, recorded where a GPU can run it so. Its inputs are images, of a
    FrozenRegressor the reduced features."""

    def loss(inputs: Tensor, poses: PoseBatch) -> Tensor:
        with ExitStack() as stack:
            if precision == "bf16":
                stack.enter_context(torch.autocast(device.type, torch.bfloat16))
                if device.type == "cpu":
                    # The fused attention's bfloat16 backward is several times slower on a CPU than plain products.
                    stack.enter_context(sdpa_kernel(SDPBackend.MATH))
            if isinstance(model, FrozenRegressor):
                return model.feature_loss(inputs, poses)
            return model.loss(inputs, poses)

    record = model.recordable and device.type == "cuda" and processes.count() == 1
    return GradientStep(model, processes.shared(model, loss), record)


class _Recording(NamedTuple):
    inputs: Tensor
    poses: PoseBatch
    graph: Any
    loss: Tensor


class GradientStep:
    """Computes the loss of a batch, detached, and leaves its gradient in the model's parameters.

    With `record` the kernels of the first batch of each shape are recorded and run again for every later one, on its
    own numbers: `loss` must do the same for all batches of a shape and not look at a tensor's value in Python.
    """

    def __init__(self, model: nn.Module, loss: Loss, record: bool) -> None:
        self.model, self.loss, self.record = model, loss, record
        self._recordings: dict[Any, _Recording] = {}
        self._gradients: list[tuple[nn.Parameter, Tensor]] = []  # where all recordings leave them

    def __call__(self, inputs: Tensor, poses: PoseBatch) -> Tensor:
        if not self.record:
            loss = self.loss(inputs, poses)
            self.model.zero_grad()
            loss.backward()
            return loss.detach()
        shape = inputs.shape, inputs.dtype, inputs.stride()
        if shape not in self._recordings:
            self._recordings[shape] = self._recorded(inputs, poses)
        recording = self._recordings[shape]
        for kept, new in zip((recording.inputs, *recording.poses[:3]), (inputs, *poses[:3]), strict=True):
            kept.copy_(new)
        recording.graph.replay()
        self._point_at_gradients()
        return recording.loss.clone()

    def _recorded(self, inputs: Tensor, poses: PoseBatch) -> _Recording:
        """The step on copies of the batch. The model's buffers and the random numbers stay as they are."""
        inputs, poses = inputs.clone(), PoseBatch(*(part.clone() for part in poses[:3]))
        buffers = [(buffer, buffer.clone()) for buffer in self.model.buffers()]
        random = torch.cuda.get_rng_state(inputs.device)
        self.model.zero_grad()
        self._point_at_gradients()
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(_WARM_UP):
                self._accumulate(inputs, poses)
        torch.cuda.current_stream().wait_stream(stream)
        self._gradients = [(p, p.grad) for p in self.model.parameters() if p.grad is not None]
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            loss = self._accumulate(inputs, poses)
        torch.cuda.set_rng_state(random, inputs.device)
        for buffer, before in buffers:
            buffer.copy_(before)
        return _Recording(inputs, poses, graph, loss)

    def _point_at_gradients(self) -> None:
        for parameter, gradient in self._gradients:
            parameter.grad = gradient

    def _accumulate(self, inputs: Tensor, poses: PoseBatch) -> Tensor:
        """Gradients stay where they are in memory."""
        gradients = [p.grad for p in self.model.parameters() if p.grad is not None]
        if gradients:
            torch._foreach_zero_(gradients)
        loss = self.loss(inputs, poses)
        loss.backward()
        return loss.detach()
