"""Dropout that costs little on a CPU.

PyTorch draws one random number after the other there, and keeps attention's weights of all heads in memory several
times over: with 784 cells most of a transformer's training step. Here a vector of bytes is drawn at once, so that an
element is left out with a probability of a whole 256th, the nearest; and attention goes head by head, its weights and
their mask made again for the gradient (Dao et al., 2022, do so block by block). Weights are powers of 2, which PyTorch
computes twice as fast as powers of e, and are normalised after they are summed up.
"""

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

_LEVELS = 256


class Dropout(nn.Dropout):
    """As nn.Dropout, on a CPU by other random numbers, which torch.manual_seed sets as well."""

    def forward(self, x: Tensor) -> Tensor:
        return dropped(x, self.p, self.training)


def dropped(x: Tensor, probability: float, training: bool) -> Tensor:
    """As nn.functional.dropout, in the same way."""
    if not training or probability == 0 or x.device.type != "cpu":
        return nn.functional.dropout(x, probability, training)
    keep = _kept(_generator(_seed()), x.shape, _limit(probability))
    return x * keep.to(x.dtype).mul_(_scale(probability))


def attention(query: Tensor, key: Tensor, value: Tensor, probability: float) -> Tensor:
    """Attended values (..., N, D) of queries (..., N, D), keys and values (..., M, D), on a CPU; the softmax's weights
    are left out with that probability, and the others scaled so that the mean stays. Computed in float32 at least: the
    products of one head are too small to gain by less."""
    wide = torch.promote_types(query.dtype, torch.float32)
    # Scores to the base of 2.
    scaled = query * (query.shape[-1] ** -0.5 / math.log(2))
    heads = [x.to(wide).flatten(0, -3).contiguous() for x in (scaled, key, value)]
    attended: Tensor = _Attention.apply(*heads, probability)
    return attended.view(query.shape).to(query.dtype)


class _Attention(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, q: Tensor, k: Tensor, v: Tensor, probability: float) -> Tensor:
        context.seed, context.probability = _seed(), probability
        out, log_sum = torch.empty_like(q), q.new_empty(*q.shape[:-1], 1)
        rng, limit = _generator(context.seed), _limit(probability)
        weights = q.new_empty(q.shape[1], k.shape[1])
        with torch.autocast("cpu", enabled=False):
            for h in range(len(q)):
                torch.mm(q[h], k[h].T, out=weights)
                top = weights.amax(-1, keepdim=True)
                total = weights.sub_(top).exp2_().sum(-1, keepdim=True)
                weights.mul_(_kept(rng, weights.shape, limit))
                torch.mm(weights, v[h], out=out[h]).div_(total)
                torch.add(top, total.log2_(), out=log_sum[h])
            out.mul_(_scale(probability))
        context.save_for_backward(q, k, v, out, log_sum)
        return out

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        q, k, v, out, log_sum = context.saved_tensors
        rng, limit = _generator(context.seed), _limit(context.probability)
        # What softmax's gradient takes away from each row: the weights' gradients, weighted by them.
        common = (gradient * out).sum(-1, keepdim=True)
        scaled = gradient * _scale(context.probability)
        dq, dk, dv = (torch.empty_like(x) for x in (q, k, v))
        weights, d_weights = (q.new_empty(q.shape[1], k.shape[1]) for _ in range(2))
        for h in range(len(q)):
            torch.mm(q[h], k[h].T, out=weights).sub_(log_sum[h]).exp2_()
            keep = _kept(rng, weights.shape, limit)
            torch.mm(scaled[h], v[h].T, out=d_weights).mul_(keep).sub_(common[h]).mul_(weights)
            torch.mm(d_weights, k[h], out=dq[h])
            torch.mm(d_weights.T, q[h], out=dk[h])
            torch.mm(weights.mul_(keep).T, scaled[h], out=dv[h])
        # Of scores to the base of 2.
        return dq.mul_(math.log(2)), dk.mul_(math.log(2)), dv, None


def _seed() -> int:
    return int(torch.randint(torch.iinfo(torch.int64).max, ()).item())


def _generator(seed: int) -> np.random.SFC64:
    return np.random.SFC64(seed)


def _kept(bits: np.random.SFC64, shape: torch.Size, limit: int) -> Tensor:
    """1 where an element is kept, else 0: bytes, which PyTorch turns into floats faster than it does truth values."""
    count = shape.numel()
    drawn = bits.random_raw(-(-count // 8)).view(np.uint8)[:count]
    return torch.from_numpy((drawn >= limit).view(np.uint8)).view(shape)


def _limit(probability: float) -> int:
    return round(probability * _LEVELS)


def _scale(probability: float) -> float:
    return _LEVELS / (_LEVELS - _limit(probability))
