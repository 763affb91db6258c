"""A GPU for fake tensors."""

import ctypes
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

REGISTRY = "_ZN3c104impl26device_guard_impl_registryE"
CUDA = 1
META = 14


@pytest.fixture
def pretended_gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let torch without CUDA dispatch fake tensors of a GPU: its guard becomes that of the device "meta".

    The backward pass would need a real GPU.
    """
    if not torch.backends.cuda.is_built():
        library = ctypes.CDLL(str(Path(torch.__file__).parent / "lib/libc10.so"))
        guards = (ctypes.c_void_p * (META + 1)).in_dll(library, REGISTRY)
        guards[CUDA] = guards[META]
    monkeypatch.setattr("torch.cuda.amp.common.amp_definitely_not_available", lambda: False)
    monkeypatch.setattr("torch.cuda.is_bf16_supported", lambda *_, **__: True)
    yield
    if not torch.backends.cuda.is_built():
        guards[CUDA] = None
