"""Training in several processes that share each batch, with the gradient of the whole batch: what they exchange.

A process alone exchanges nothing.
"""

import os
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from pathlib import Path

import torch
import torch.distributed as dist
from torch import Tensor, nn
from torch.distributed.nn.functional import all_reduce
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.parallel import DistributedDataParallel

from groundwalk.training.poses import PoseBatch

# Of inputs and true poses the loss, a scalar: the mean over the batch's images.
Loss = Callable[[Tensor, PoseBatch], Tensor]
_LONGEST = timedelta(days=30)  # who started a process ends it where another one fails


@dataclass(frozen=True)
class Part:
    """One of `count` processes, which find each other by the file `meeting`."""

    rank: int
    count: int
    meeting: Path


def rank() -> int:
    """The number of this process among those that share a training, from 0."""
    return dist.get_rank() if dist.is_initialized() else 0


def count() -> int:
    """How many processes share this training."""
    return dist.get_world_size() if dist.is_initialized() else 1


def share() -> slice:
    """Which rows of a batch are this process's."""
    return slice(rank(), None, count())


@contextmanager
def joined(part: Part, device: torch.device) -> Iterator[torch.device]:
    """Share a training with the other processes in the block; gives this process's device, a GPU each."""
    if part.count == 1:
        yield device
        return
    if device.type == "cuda":
        device = torch.device("cuda", part.rank)
        torch.cuda.set_device(device)
    # All are on this machine, and nobody else is to reach them. The first interface is the loopback.
    os.environ.setdefault("GLOO_SOCKET_IFNAME", socket.if_nameindex()[0][1])
    store = dist.FileStore(str(part.meeting), part.count)
    backend = "nccl" if device.type == "cuda" else "gloo"
    dist.init_process_group(backend, store=store, rank=part.rank, world_size=part.count, timeout=_LONGEST)
    yield device
    dist.destroy_process_group()  # not after an error, where it would wait for the others


@contextmanager
def first_alone() -> Iterator[None]:
    """The others run the block when the first process has."""
    if rank():
        dist.barrier()
    yield
    if count() > 1 and not rank():
        dist.barrier()


def mean(value: Tensor) -> Tensor:
    """The mean of a number over the processes."""
    if count() > 1:
        dist.all_reduce(value)
    return value / count()


def shared(model: nn.Module, loss: Loss) -> Loss:
    """The loss whose mean over the processes is the whole batch's, and so is its gradient in the model's parameters."""
    if count() == 1:
        return loss
    for module in model.modules():
        if isinstance(module, _BatchNorm):
            module.forward = partial(_norm_of_whole_batch, module)  # type: ignore[method-assign]

    def weighted(inputs: Tensor, poses: PoseBatch) -> Tensor:
        images = torch.tensor(float(len(inputs)), device=inputs.device)
        return loss(inputs, poses) * (images / mean(images.clone()))

    # Buffers stay equal, as batch norm's are of the whole batch.
    return DistributedDataParallel(_Loss(model, weighted), broadcast_buffers=False, find_unused_parameters=True)


class _Loss(nn.Module):
    def __init__(self, model: nn.Module, loss: Loss) -> None:
        super().__init__()
        self.model, self.loss = model, loss

    def forward(self, inputs: Tensor, poses: PoseBatch) -> Tensor:
        return self.loss(inputs, poses)


def _norm_of_whole_batch(norm: _BatchNorm, x: Tensor) -> Tensor:
    """Batch norm of this process's part of a batch (B, C, ...) with the whole batch's statistics, in float32. PyTorch's
    SyncBatchNorm does the same, but not on a CPU."""
    if not norm.training or norm.running_mean is None or norm.running_var is None:
        return type(norm).forward(norm, x)
    with torch.autocast(x.device.type, enabled=False):
        others = [axis for axis in range(x.dim()) if axis != 1]
        shape = [1, -1, *(1 for _ in others[1:])]
        values = x.float()
        numbers = values.new_tensor([x.numel() / x.shape[1]])
        total = all_reduce(torch.cat([values.sum(others), numbers]))
        number, mean_C = total[-1].detach(), total[:-1] / total[-1].detach()
        centred = values - mean_C.view(shape)
        variance_C = all_reduce(centred.square().sum(others)) / number
        with torch.no_grad():
            assert norm.num_batches_tracked is not None
            norm.num_batches_tracked += 1
            momentum = 1 / float(norm.num_batches_tracked) if norm.momentum is None else norm.momentum
            norm.running_mean.lerp_(mean_C, momentum)
            norm.running_var.lerp_(variance_C * (number / (number - 1)), momentum)
        y = centred * (variance_C + norm.eps).rsqrt().view(shape)
        if norm.affine:
            y = y * norm.weight.view(shape) + norm.bias.view(shape)
        return y.to(x.dtype)
