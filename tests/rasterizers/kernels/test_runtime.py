"""Threads, forks, caches and buffers around the kernels."""

import gc
import logging
import multiprocessing
import os
import runpy
import subprocess
import sys
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
import torch
from degenerate_gaussians import camera, healthy
from numba.core.caching import CacheImpl
from support import LIMIT, python

from completesplat.data.toy import raytracing
from completesplat.rasterizers.kernels import compilation, runtime
from completesplat.rasterizers.kernels.runtime import parallel
from completesplat.rasterizers.tiled import TiledRasterizer


def image() -> torch.Tensor:
    return TiledRasterizer()(healthy(4), camera()).color


def test_every_task_runs_once_and_exceptions_come_back(set_threads: Callable[[int], None]) -> None:
    set_threads(2)
    done = []
    parallel(done.append, 100)
    assert sorted(done) == list(range(100))
    with pytest.raises(ZeroDivisionError):
        parallel(lambda task: 1 / 0, 2)


@pytest.mark.processes
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_renders(set_threads: Callable[[int], None]) -> None:
    set_threads(2)
    expected = image()  # starts the threads of this process
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)

    def child(connection: Connection) -> None:
        connection.send(image().numpy())

    process = context.Process(target=child, args=(sender,))
    process.start()
    try:
        assert receiver.poll(LIMIT), "the child hangs"
        assert np.array_equal(receiver.recv(), expected.numpy())
    finally:
        process.kill()
        process.join()


@pytest.mark.processes
def test_a_second_process_compiles_nothing() -> None:
    image()
    if compilation.cache_directory() is None:
        pytest.skip("no cache folder can be written here")
    code = (
        "import sys; sys.path.insert(0, sys.argv[1]); from degenerate_gaussians import camera, healthy; "
        "from completesplat.rasterizers.tiled import TiledRasterizer; TiledRasterizer()(healthy(4), camera()); "
        "from completesplat.rasterizers.kernels import composite, project; "
        "kernels = [composite.composite, project.prepare, project.project]; "
        "print([(sum(k.stats.cache_hits.values()), sum(k.stats.cache_misses.values())) for k in kernels])"
    )
    assert python(code, Path(__file__).parents[2], timeout=LIMIT) == "[(1, 0), (1, 0), (1, 0)]\n"


@pytest.fixture
def no_writable_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    (tmp_path / "file").touch()  # no folder can be made under a file
    monkeypatch.setattr(compilation.numba_config, "CACHE_DIR", str(tmp_path / "file"))
    compilation.cache_directory.cache_clear()
    yield
    compilation.cache_directory.cache_clear()


@pytest.mark.usefixtures("no_writable_folder")
def test_without_a_writable_folder_kernels_are_compiled_but_not_kept(tmp_path, monkeypatch, caplog) -> None:
    assert compilation.cache_directory() is None
    double = compilation.kernel(_double)
    assert double(3) == 6
    assert double.stats.cache_path is None
    monkeypatch.setattr(compilation.numba_config, "CACHE_DIR", str(tmp_path))
    compilation.cache_directory.cache_clear()
    with caplog.at_level(logging.INFO):
        assert compilation.kernel(_double)(3) == 6
        assert list(tmp_path.glob("kernels-*/*/*.nbc"))
        assert caplog.text.count("compiling the kernels on first use") == 1
        compilation.cache_directory.cache_clear()
        compilation.cache_directory()
        assert caplog.text.count("compiling the kernels on first use") == 1  # they are in the cache


@pytest.mark.usefixtures("no_writable_folder")
def test_the_ray_tracer_compiles_where_numba_can_write_nowhere(monkeypatch) -> None:
    """As in a read-only installation of a user without a home: numba finds no folder for its cache."""
    monkeypatch.setattr(CacheImpl, "_locator_classes", [])
    assert runpy.run_path(raytracing.__file__)["_trace"].stats.cache_path is None


def _double(x: int) -> int:
    return 2 * x


def test_memory_is_aligned_reused_and_not_shared() -> None:
    """Memory is in use as long as any view of the array."""
    runtime.release()
    first = runtime.empty((1000, 7))
    second = runtime.empty((1000, 7))
    assert first.ctypes.data % 64 == second.ctypes.data % 64 == 0
    assert not np.shares_memory(first, second)
    address = first.ctypes.data
    part = first[1:].T.view(np.int32)
    del first
    gc.collect()
    third = runtime.empty((7, 1000))
    assert not np.shares_memory(part, third)
    del part
    gc.collect()
    assert runtime.empty((7, 1000), np.int32).ctypes.data == address


def test_free_memory_beyond_the_limit_is_given_up_oldest_first_and_only_for_new_memory(monkeypatch) -> None:
    """New memory costs more than writing to it, so a large scene that is drawn again needs none."""
    monkeypatch.setattr(runtime, "MOST_FREE_BYTES", 20_000)
    runtime.release()
    arrays = [runtime.empty((2**size,), np.uint8) for size in (13, 14, 15)]
    while arrays:
        del arrays[0]
    sizes = [2**13, 2**14, 2**15]
    assert [len(memory) for memory in runtime._free] == sizes
    again = runtime.empty((2**15,), np.uint8)
    assert [len(memory) for memory in runtime._free] == sizes[:2]
    larger = runtime.empty((2**17,), np.uint8)
    assert [len(memory) for memory in runtime._free] == sizes[1:2]
    del again, larger


def test_a_scene_that_is_drawn_again_needs_no_new_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    runtime.release()
    gaussians = healthy(500).map(lambda tensor: tensor.requires_grad_())
    pools = []
    for _ in range(3):
        rendering = TiledRasterizer()(gaussians, camera())
        gradients = torch.autograd.grad(rendering.color.sum(), list(vars(gaussians).values()))
        address = gradients[0].data_ptr()
        del rendering, gradients
        gc.collect()
        pools.append({id(memory) for memory in runtime._free})
        assert address in {np.frombuffer(memory, np.uint8).ctypes.data for memory in runtime._free}
    assert pools[0] == pools[1] == pools[2]


def test_the_system_may_take_large_free_memory() -> None:
    """Linux counts it, and the pages are not taken while nothing else needs them."""
    rollup = Path("/proc/self/smaps_rollup")
    if not rollup.exists():
        pytest.skip("needs Linux's /proc")

    def lazily_freed() -> int:
        return next(int(line.split()[1]) for line in rollup.read_text().splitlines() if line.startswith("LazyFree:"))

    runtime.release()
    before = lazily_freed()
    array = runtime.empty((2**22,))
    array.fill(1)
    assert lazily_freed() == before
    del array
    gc.collect()
    assert lazily_freed() - before > 15 * 1024


@pytest.mark.processes
def test_memory_that_is_in_use_when_the_interpreter_ends() -> None:
    """Python clears the kernels' module before the main one, which holds the array."""
    code = "from completesplat.rasterizers.kernels import runtime; array = runtime.empty((3,))"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=LIMIT)
    assert (result.returncode, result.stderr) == (0, "")
