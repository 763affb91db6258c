"""Which of several processes this is, and what the others know."""

from typing import Any

import torch


def processes() -> tuple[int, int]:
    """This training process's number, and how many there are."""
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1


def gathered(value: Any) -> list[Any]:
    """The values of all processes, in their order; each of them must call it."""
    count = processes()[1]
    if count == 1:
        return [value]
    values: list[Any] = [None] * count
    torch.distributed.all_gather_object(values, value)
    return values
