"""Which of several processes this is, and what the others know."""

from typing import Any

import torch
from torch import Tensor

from completesplat.errors import CompleteSplatError


def processes() -> tuple[int, int]:
    """This training process's number, and how many there are."""
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def is_first() -> bool:
    """Whether this is the first process, or the only one."""
    return processes()[0] == 0


def gathered(value: Any) -> list[Any]:
    """The values of all processes, in their order; each of them must call it."""
    count = processes()[1]
    if count == 1:
        return [value]
    values: list[Any] = [None] * count
    torch.distributed.all_gather_object(values, value)
    return values


def mean_of_processes(values: dict[str, Tensor]) -> dict[str, Tensor]:
    """Scalars on one device, averaged over all processes, each of which must call it with the same names."""
    count = processes()[1]
    if count == 1:
        return values
    totals = torch.stack(list(values.values()))
    torch.distributed.all_reduce(totals)
    return dict(zip(values, totals / count, strict=True))


def batch_per_process(batch_size: int, count: int, accumulated: int) -> int:
    """Scenes of one batch of one of `count` processes, so that an optimizer step sees `batch_size` scenes.

    `accumulated` batches of each process make one step. `CompleteSplatError` if `batch_size` cannot be divided so.
    """
    share, rest = divmod(batch_size, count * accumulated)
    if rest:
        raise CompleteSplatError(
            f"data.batch_size={batch_size} is the batch of an optimizer step: it must be a multiple of "
            f"{count} processes (trainer.devices x num_nodes) x {accumulated} (trainer.accumulate_grad_batches)"
        )
    return share
