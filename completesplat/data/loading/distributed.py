"""Rank of this training process, and values gathered from all of them."""

from typing import TypeVar

import torch
from torch import Tensor

from completesplat.errors import CompleteSplatError

T = TypeVar("T")


def processes() -> tuple[int, int]:
    """Return this training process's rank and the number of processes."""
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def gather_values(value: T) -> list[T]:
    """Gather the values of all processes in rank order. Every process must call this."""
    count = processes()[1]
    if count == 1:
        return [value]
    values = [value] * count
    torch.distributed.all_gather_object(values, value)
    return values


def mean_of_processes(values: dict[str, Tensor]) -> dict[str, Tensor]:
    """Average scalars on one device over all processes. Every process must call this with the same names."""
    count = processes()[1]
    if count == 1:
        return values
    totals = torch.stack(list(values.values()))
    torch.distributed.all_reduce(totals)
    return dict(zip(values, totals / count, strict=True))


def batch_per_process(batch_size: int, count: int, accumulated: int) -> int:
    """Return the batch size of a process, where `count` processes with `accumulated` batches each make one step.

    Raises:
        CompleteSplatError: `batch_size`, the scenes of a step, is not a multiple of count * accumulated.
    """
    share, rest = divmod(batch_size, count * accumulated)
    if rest:
        raise CompleteSplatError(
            f"data.batch_size={batch_size} is the batch of an optimizer step: it must be a multiple of "
            f"{count} processes (trainer.devices x num_nodes) x {accumulated} (trainer.accumulate_grad_batches)"
        )
    return share
