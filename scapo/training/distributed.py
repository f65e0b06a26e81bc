# SPDX-License-Identifier: MIT
"""The processes of one training: each takes its share of every batch, all hold the same weights.

Started by `torchrun`, joined by PyTorch's collectives: gloo between CPUs, NCCL between GPUs. One
process alone is one rank, and every function here then does nothing.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta

import torch
import torch.distributed as dist
from torch import Tensor, nn

PATIENCE = timedelta(hours=24)
"""The others wait this long for the first rank, whose start of a stage may search for minutes."""


def launched() -> bool:
    """Whether torchrun started this process."""
    return all(name in os.environ for name in ("RANK", "WORLD_SIZE", "LOCAL_RANK", "MASTER_ADDR"))


def own_device(name: str) -> str:
    """The device of this rank: its own GPU of the machine where `name` is just `cuda`."""
    return f"cuda:{os.environ['LOCAL_RANK']}" if launched() and name == "cuda" else name


@contextmanager
def joined(device: str) -> Iterator[Ranks]:
    """Join the other processes of torchrun for the time of the block; alone: one rank."""
    if not launched():
        yield Ranks()
        return
    if device.startswith("cuda"):
        torch.cuda.set_device(device)
        dist.init_process_group("nccl", timeout=PATIENCE, device_id=torch.device(device))
    else:
        dist.init_process_group("gloo", timeout=PATIENCE)
    try:
        yield present()
    finally:
        dist.destroy_process_group()


def present() -> Ranks:
    """This process among those that have joined."""
    if not (dist.is_available() and dist.is_initialized()):
        return Ranks()
    return Ranks(rank=dist.get_rank(), count=dist.get_world_size())


@dataclass(frozen=True, slots=True, kw_only=True)
class Ranks:
    """This process and how many there are."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """Whether this one writes and logs."""
        return self.rank == 0

    def share(self, index: Tensor) -> Tensor:
        """This rank's part of a batch; sizes differ by one at most."""
        return index.tensor_split(self.count)[self.rank]

    def total(self, values: Tensor) -> Tensor:
        """The sum over the ranks, in place."""
        if self.count > 1:
            dist.all_reduce(values)
        return values

    def wait(self) -> None:
        """Until all are here."""
        if self.count > 1:
            dist.barrier()

    def every(self, value: Tensor, device: str) -> list[Tensor]:
        """The equally long vectors of all ranks, on the CPU."""
        if self.count == 1:
            return [value]
        out = [torch.empty_like(value, device=device) for _ in range(self.count)]
        dist.all_gather(out, value.to(device))
        return [other.cpu() for other in out]

    def from_first(self, data: bytes, device: str) -> bytes:
        """The first rank's bytes."""
        if self.count == 1:
            return data
        size = torch.tensor([len(data)], device=device)
        dist.broadcast(size, 0)
        buffer = torch.zeros(int(size), dtype=torch.uint8, device=device)
        if self.first:
            buffer.copy_(torch.frombuffer(bytearray(data), dtype=torch.uint8))
        dist.broadcast(buffer, 0)
        return buffer.cpu().numpy().tobytes()


FINE, BAD_LOSS, BAD_GRADIENT = 0, 1, 2
"""What a rank says of its own share of a step."""


@torch.no_grad()
def sum_gradients(module: nn.Module, share: float, fine: bool, ranks: Ranks) -> list[int]:
    """Replace every gradient by the sum over the ranks of share * gradient, in one exchange.

    Args:
        module: Holds the gradients; a parameter without one counts as 0 where other ranks have
            one, and stays without where none has.
        share: This rank's part of the batch, so that the sum is the gradient of the whole.
        fine: Whether this rank's loss is finite.
        ranks: Who takes part.

    Returns:
        FINE, BAD_LOSS or BAD_GRADIENT of every rank; the gradients are of use if all are fine.
    """
    active = [parameter for parameter in module.parameters() if parameter.requires_grad]
    if ranks.count == 1 or not active:
        return [FINE if fine else BAD_LOSS]
    there = torch.stack([p.new_tensor(float(p.grad is not None)) for p in active])
    grads = [torch.zeros_like(p) if p.grad is None else p.grad for p in active]
    own = share * torch.cat([grad.flatten() for grad in grads])
    flags = torch.zeros(ranks.count, device=own.device)
    flags[ranks.rank] = BAD_LOSS if not fine else BAD_GRADIENT * float(~own.isfinite().all())
    flat = ranks.total(torch.cat([flags, there, own]))
    flags, there, total = flat.split([ranks.count, len(active), len(own)])
    pieces = total.split([parameter.numel() for parameter in active])
    for parameter, piece, known in zip(active, pieces, there.tolist(), strict=True):
        parameter.grad = piece.view_as(parameter) if known else None
    return [round(flag) for flag in flags.tolist()]


@torch.no_grad()
def average_buffers(module: nn.Module, ranks: Ranks) -> None:
    """Give all ranks the mean of their floating-point buffers, such as the norms' statistics.

    As the first rank's plus the mean difference from it: a buffer that is equal everywhere stays
    as it is, bit for bit.
    """
    buffers = [buffer for buffer in module.buffers() if buffer.is_floating_point()]
    if ranks.count == 1 or not buffers:
        return
    own = torch.cat([buffer.flatten() for buffer in buffers])
    first = own.clone()
    dist.broadcast(first, 0)
    mean = first + ranks.total(own - first) / ranks.count
    for buffer, value in zip(buffers, mean.split([b.numel() for b in buffers]), strict=True):
        buffer.copy_(value.view_as(buffer))
