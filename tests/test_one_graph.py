"""torch.compile makes one graph of each network, so compiling leaves out nothing of it."""

import subprocess
import sys
from pathlib import Path

import one_graph
import pytest


@pytest.mark.slow
@pytest.mark.parametrize("size", one_graph.PARTS)
def test_each_network_is_one_graph_forward_and_backward(size):
    """In a process of its own, because the tests' checks of shapes are no part of a graph."""
    program = [sys.executable, one_graph.__file__, size]
    done = subprocess.run(program, capture_output=True, text=True, cwd=Path(__file__).parent)
    networks = ["autoreconstructor", "encoder", "reconstructor", "regressor", "denoiser"]
    assert done.stdout.split() == networks, done.stderr
