"""Dropout whose random numbers cost little on a CPU.

PyTorch draws one number after the other there, which takes most of a transformer's training step. Here a vector of
16-bit integers is drawn at once: an element is left out with a probability of the nearest 65,536th.
"""

import numpy as np
import torch
from torch import Tensor, nn

_LEVELS = 1 << 16


class Dropout(nn.Dropout):
    """As nn.Dropout, on a CPU by other random numbers, which torch.manual_seed sets as well."""

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or self.p == 0 or x.device.type != "cpu":
            return super().forward(x)
        return dropped(x, self.p)


def dropped(x: Tensor, probability: float) -> Tensor:
    """`x` with elements left out at random and the others scaled so that the mean stays."""
    limit = round(probability * _LEVELS)
    seed = torch.randint(torch.iinfo(torch.int64).max, ()).item()
    drawn = np.random.Generator(np.random.SFC64(seed)).bytes(2 * x.numel())
    keep = torch.from_numpy(np.frombuffer(drawn, np.uint16) >= limit).view(x.shape)
    return _Masked.apply(x, keep, _LEVELS / (_LEVELS - limit))


class _Masked(torch.autograd.Function):
    """Product with a mask and a number; keeps the mask alone for its gradient."""

    @staticmethod
    def forward(context: torch.autograd.function.FunctionCtx, x: Tensor, keep: Tensor, scale: float) -> Tensor:
        context.save_for_backward(keep)
        context.scale = scale  # type: ignore[attr-defined]
        return (x * keep).mul_(scale)

    @staticmethod
    def backward(  # type: ignore[override]
        context: torch.autograd.function.FunctionCtx, gradient: Tensor
    ) -> tuple[Tensor, None, None]:
        (keep,) = context.saved_tensors  # type: ignore[attr-defined]
        return (gradient * keep).mul_(context.scale), None, None  # type: ignore[attr-defined]
