"""Dropout that costs little on a CPU.

PyTorch draws one random number after the other there, and keeps attention's weights of all heads in memory several
times over: with 784 cells most of a transformer's training step. Here a vector of bytes is drawn at once, so that an
element is left out with a probability of a whole 256th, the nearest; and attention goes head by head, its weights and
their mask made again for the gradient (Dao et al., 2022, do so block by block).
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

_LEVELS = 256


class Dropout(nn.Dropout):
    """As nn.Dropout, on a CPU by other random numbers, which torch.manual_seed sets as well."""

    def forward(self, x: Tensor) -> Tensor:
        if not self.training or self.p == 0 or x.device.type != "cpu":
            return super().forward(x)
        keep = _kept(_generator(_seed()), x.shape, _limit(self.p))
        return x * keep.to(x.dtype).mul_(_scale(self.p))


def attention(query: Tensor, key: Tensor, value: Tensor, probability: float) -> Tensor:
    """Attended values (..., N, D) of queries (..., N, D), keys and values (..., M, D), on a CPU; the softmax's weights
    are left out with that probability, and the others scaled so that the mean stays. Computed in float32 at least: the
    products of one head are too small to gain by less."""
    wide = torch.promote_types(query.dtype, torch.float32)
    heads = [x.to(wide).flatten(0, -3).contiguous() for x in (query * query.shape[-1] ** -0.5, key, value)]
    attended: Tensor = _Attention.apply(*heads, probability)
    return attended.view(query.shape).to(query.dtype)


class _Attention(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, q: Tensor, k: Tensor, v: Tensor, probability: float) -> Tensor:
        context.seed, context.probability = _seed(), probability
        out = torch.empty_like(q)
        rng, limit = _generator(context.seed), _limit(probability)
        with torch.autocast("cpu", enabled=False):
            for q_h, k_h, v_h, out_h in zip(q, k, v, out, strict=True):
                weights = torch.softmax(q_h @ k_h.T, dim=-1)
                weights.mul_(_kept(rng, weights.shape, limit))
                torch.mm(weights, v_h, out=out_h)
            out.mul_(_scale(probability))
        context.save_for_backward(q, k, v, out)
        return out

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        q, k, v, out = context.saved_tensors
        rng, limit = _generator(context.seed), _limit(context.probability)
        # What softmax's gradient takes away from each row: the weights' gradients, weighted by them.
        common = (gradient * out).sum(-1, keepdim=True)
        scaled = gradient * _scale(context.probability)
        dq, dk, dv = (torch.empty_like(x) for x in (q, k, v))
        for h in range(len(q)):
            weights = torch.softmax(q[h] @ k[h].T, dim=-1)
            keep = _kept(rng, weights.shape, limit).to(q.dtype)
            d_weights = (scaled[h] @ v[h].T).mul_(keep)
            torch.mm(keep.mul_(weights).T, scaled[h], out=dv[h])
            d_scores = d_weights.sub_(common[h]).mul_(weights)
            torch.mm(d_scores, k[h], out=dq[h])
            torch.mm(d_scores.T, q[h], out=dk[h])
        return dq, dk, dv, None


def _seed() -> int:
    return int(torch.randint(torch.iinfo(torch.int64).max, ()).item())


def _generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.SFC64(seed))


def _kept(rng: np.random.Generator, shape: torch.Size, limit: int) -> Tensor:
    """True where an element is kept."""
    return torch.from_numpy(np.frombuffer(rng.bytes(shape.numel()), np.uint8) >= limit).view(shape)


def _limit(probability: float) -> int:
    return round(probability * _LEVELS)


def _scale(probability: float) -> float:
    return _LEVELS / (_LEVELS - _limit(probability))
