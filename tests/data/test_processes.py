"""Work for several processes."""

import resource
from functools import partial

import pytest
import torch
from torch import Tensor

from completesplat.data.processes import map_in_processes


def _total(tensors: list[Tensor], place: int) -> float:
    return float(tensors[place].sum())


def test_what_the_processes_get_may_hold_more_tensors_than_a_process_may_open_files():
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    total = partial(_total, [torch.full((3,), float(value)) for value in range(300)])
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    try:
        assert list(map_in_processes(total, [0, 150, 299], workers=2)) == pytest.approx([0, 450, 897])
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
