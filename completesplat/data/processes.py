"""Which of several training processes this is."""

import torch


def processes() -> tuple[int, int]:
    """This training process's number, and how many there are."""
    distributed = torch.distributed
    if distributed.is_available() and distributed.is_initialized():
        return distributed.get_rank(), distributed.get_world_size()
    return 0, 1
