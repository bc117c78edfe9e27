"""Attention with dropout that costs little on a CPU.

PyTorch draws one random number after the other there, and keeps attention's weights of all heads in memory several
times over: with 784 cells most of a transformer's training step. Here what is left out is decided by bytes that are
made from the weight's number and a seed, so that a weight is left out with a probability of a whole 256th, the
nearest, and the gradient makes them again instead of keeping them; and attention goes by as many heads at a time as a
core's cache holds, one at least, their weights made again for the gradient, too (Dao et al., 2022, do so block by
block). Of the weights everything but the products is done in one compiled pass over each row. Weights are powers of 2,
which takes a product less than powers of e, and are normalised after they are summed up.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from groundwalk.store.compiled import Function, compiled_and_kept

_LEVELS = 256
_CACHED = 1 << 18  # numbers: a megabyte
# Of 2 ** x, for x of half at most: as accurate as float32 is.
_SERIES = tuple(np.float32(math.log(2) ** n / math.factorial(n)) for n in range(7))
# What lets a loop over numbers become one over vectors; infinities and what is no number stay as they are.
_FASTMATH = {"contract", "reassoc", "nsz"}


def _compiled(function: Function) -> Function:
    return compiled_and_kept(function, fastmath=_FASTMATH)


def attention(query: Tensor, key: Tensor, value: Tensor, probability: float) -> Tensor:
    """Attended values (..., N, D) of queries (..., N, D), keys and values (..., M, D), on a CPU; the softmax's weights
    are left out with that probability, and the others scaled so that the mean stays. Computed in float32."""
    # Scores to the base of 2.
    scaled = query * (query.shape[-1] ** -0.5 / math.log(2))
    heads = [x.float().flatten(0, -3).contiguous() for x in (scaled, key, value)]
    attended: Tensor = _Attention.apply(*heads, probability, _seed())
    return attended.view(query.shape).to(query.dtype)


class _Attention(torch.autograd.Function):
    @staticmethod
    def forward(context: Any, q: Tensor, k: Tensor, v: Tensor, probability: float, seed: int) -> Tensor:
        context.seed, context.probability = seed, probability
        out, top, total = torch.empty_like(q), q.new_empty(q.shape[:-1]), q.new_empty(q.shape[:-1])
        limit = _limit(probability)
        with torch.autocast("cpu", enabled=False):
            for heads, weights in _parts(q, k, 1):
                torch.bmm(q[heads], k[heads].mT, out=weights)
                torch.amax(weights, -1, out=top[heads])
                tops, totals = (part[heads].view(-1).numpy() for part in (top, total))
                _weigh(weights.flatten(0, 1).numpy(), tops, totals, seed, heads.start * q.shape[1], limit)
                torch.bmm(weights, v[heads], out=out[heads])
            out.mul_((_scale(probability) / total)[..., None])
        context.save_for_backward(q, k, v, out, top + total.log2())
        return out

    @staticmethod
    def backward(context: Any, gradient: Tensor) -> tuple[Tensor, Tensor, Tensor, None, None]:
        q, k, v, out, log_sum = context.saved_tensors
        limit = _limit(context.probability)
        # What softmax's gradient takes away from each row: the weights' gradients, weighted by them.
        common = (gradient * out).sum(-1)
        scaled = gradient * _scale(context.probability)
        dq, dk, dv = (torch.empty_like(x) for x in (q, k, v))
        for heads, weights, d_weights in _parts(q, k, 2):
            torch.bmm(q[heads], k[heads].mT, out=weights)
            torch.bmm(scaled[heads], v[heads].mT, out=d_weights)
            scores, gradients = (part.flatten(0, 1).numpy() for part in (weights, d_weights))
            logs, commons = (part[heads].view(-1).numpy() for part in (log_sum, common))
            _weigh_gradient(scores, gradients, logs, commons, context.seed, heads.start * q.shape[1], limit)
            torch.bmm(d_weights, k[heads], out=dq[heads])
            torch.bmm(d_weights.mT, q[heads], out=dk[heads])
            torch.bmm(weights.mT, scaled[heads], out=dv[heads])
        # Of scores to the base of 2.
        return dq.mul_(math.log(2)), dk.mul_(math.log(2)), dv, None, None


def _parts(q: Tensor, k: Tensor, matrices: int) -> Iterator[Any]:
    """Slices of heads, and for each so many matrices (heads, N, M) that stay in a core's cache together, or of one head
    where that is too large."""
    size = q.shape[1] * k.shape[1]
    count = max(1, _CACHED // (matrices * size))
    kept = [q.new_empty(min(count, len(q)), q.shape[1], k.shape[1]) for _ in range(matrices)]
    for start in range(0, len(q), count):
        heads = slice(start, min(start + count, len(q)))
        yield heads, *(matrix[: heads.stop - start] for matrix in kept)


def _seed() -> int:
    return int(torch.randint(torch.iinfo(torch.int64).max, ()).item())


def _limit(probability: float) -> int:
    return round(probability * _LEVELS)


def _scale(probability: float) -> float:
    return _LEVELS / (_LEVELS - _limit(probability))


@_compiled
def _draw(words: NDArray[np.uint32], first: int, seed: int) -> None:
    """Random numbers of their own for each seed and number from `first` on (the last steps of MurmurHash3)."""
    low, high = np.uint32(seed & 0xFFFFFFFF), np.uint32(seed >> 32)
    for i in range(len(words)):
        x = np.uint32(np.uint32(first + i) * np.uint32(0x9E3779B1) + low)
        x = np.uint32((x ^ (x >> np.uint32(16)) ^ high) * np.uint32(0x85EBCA6B))
        x = np.uint32((x ^ (x >> np.uint32(13))) * np.uint32(0xC2B2AE35))
        words[i] = x ^ (x >> np.uint32(16))


@_compiled
def _power_of_2(x: np.float32) -> np.float32:
    """2 ** x for x up to about 100; never less than 2 ** -126."""
    x = max(x, np.float32(-126))
    whole = np.floor(x + np.float32(0.5))
    part = x - whole
    value = _SERIES[6]
    value = value * part + _SERIES[5]
    value = value * part + _SERIES[4]
    value = value * part + _SERIES[3]
    value = value * part + _SERIES[2]
    value = value * part + _SERIES[1]
    value = value * part + _SERIES[0]
    return value * np.int32((np.int32(whole) + np.int32(127)) << np.int32(23)).view(np.float32)


@_compiled
def _weigh(
    scores: NDArray[np.float32], top: NDArray[np.float32], total: NDArray[np.float32], seed: int, first: int, limit: int
) -> None:
    """Make scores (N, M) weights, some left out; `total` becomes the sums (N,) of all of them. `first` is the number of
    their first row among those of all heads."""
    rows, columns = scores.shape
    words = np.empty((columns + 3) // 4, np.uint32)
    drawn, least = words.view(np.uint8), np.uint8(limit)
    for r in range(rows):
        row, highest, sum_of_row = scores[r], top[r], np.float32(0)
        _draw(words, (first + r) * len(words), seed)
        for c in range(columns):
            weight = _power_of_2(row[c] - highest)
            sum_of_row += weight
            row[c] = weight if drawn[c] >= least else np.float32(0)
        total[r] = sum_of_row


@_compiled
def _weigh_gradient(
    scores: NDArray[np.float32],
    gradient: NDArray[np.float32],
    log_sum: NDArray[np.float32],
    common: NDArray[np.float32],
    seed: int,
    first: int,
    limit: int,
) -> None:
    """Make scores (N, M) normalised weights, some left out, and the weights' gradient (N, M) that of the scores."""
    rows, columns = scores.shape
    words = np.empty((columns + 3) // 4, np.uint32)
    drawn, least = words.view(np.uint8), np.uint8(limit)
    for r in range(rows):
        row, d_row, log_of_row, common_of_row = scores[r], gradient[r], log_sum[r], common[r]
        _draw(words, (first + r) * len(words), seed)
        for c in range(columns):
            weight = _power_of_2(row[c] - log_of_row)
            kept = drawn[c] >= least
            row[c] = weight if kept else np.float32(0)
            d_row[c] = weight * ((d_row[c] if kept else np.float32(0)) - common_of_row)
