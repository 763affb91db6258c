"""Ways to compute the same: in float32, in bfloat16, compiled."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn


@dataclass(frozen=True)
class Way:
    """How networks are computed.

    Args:
        compile: arguments of `torch.compile`; None leaves them as they are.
    """

    name: str
    precision: str
    compile: Mapping[str, Any] | None = None

    @property
    def graphs(self) -> bool:
        """Whether kernels are recorded and replayed as CUDA graphs."""
        return bool(self.compile)


WAYS = (
    Way("float32", "32-true"),
    Way("bfloat16", "bf16-mixed"),
    Way("bfloat16, compiled", "bf16-mixed", {}),
    Way("bfloat16, CUDA graphs", "bf16-mixed", {"mode": "reduce-overhead"}),
)


@contextmanager
def compiled(networks: list[nn.Module], way: Way) -> Iterator[None]:
    """Within the context, these networks are compiled on their first call."""
    before = [network._compiled_call_impl for network in networks]
    if way.compile is not None:
        torch.compiler.reset()
        for network in networks:
            network.compile(**way.compile)
    try:
        yield
    finally:
        for network, call in zip(networks, before, strict=True):
            network._compiled_call_impl = call
