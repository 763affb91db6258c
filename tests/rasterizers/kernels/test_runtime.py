"""Threads, forks, caches and buffers around the kernels."""

import gc
import logging
import multiprocessing
import os
import subprocess
import sys
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
import pytest
import torch
from degenerate_gaussians import camera, healthy
from support import LIMIT

from completesplat.rasterizers.kernels import compilation, drawing
from completesplat.rasterizers.kernels.drawing import parallel
from completesplat.rasterizers.tiled import TiledRasterizer


def image() -> torch.Tensor:
    return TiledRasterizer()(healthy(4), camera()).color


@pytest.fixture
def two_threads() -> object:
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


@pytest.mark.usefixtures("two_threads")
def test_every_task_runs_once_and_exceptions_come_back() -> None:
    done = []
    parallel(done.append, 100)
    assert sorted(done) == list(range(100))
    with pytest.raises(ZeroDivisionError):
        parallel(lambda task: 1 / 0, 2)


@pytest.mark.processes
@pytest.mark.usefixtures("two_threads")
@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_child_renders() -> None:
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
    command = [sys.executable, "-c", code, str(Path(__file__).parents[2])]
    result = subprocess.run(command, capture_output=True, text=True, timeout=LIMIT)
    assert result.stdout.strip() == "[(1, 0), (1, 0), (1, 0)]", result.stderr


def test_without_a_writable_folder_kernels_are_compiled_but_not_kept(tmp_path, monkeypatch, caplog) -> None:
    blocked = tmp_path / "file"
    blocked.touch()  # no folder can be made under a file
    monkeypatch.setattr(compilation.numba_config, "CACHE_DIR", str(blocked))
    compilation.cache_directory.cache_clear()
    try:
        assert compilation.cache_directory() is None
        double = compilation.kernel(_double)
        assert double(3) == 6
        assert double.stats.cache_path is None
        monkeypatch.setattr(compilation.numba_config, "CACHE_DIR", str(tmp_path))
        compilation.cache_directory.cache_clear()
        with caplog.at_level(logging.INFO):
            assert compilation.kernel(_double)(3) == 6
            assert list(tmp_path.glob("kernels-*/*/*.nbc"))
            assert caplog.text.count("compiling its kernels on first use") == 1
            compilation.cache_directory.cache_clear()
            compilation.cache_directory()
            assert caplog.text.count("compiling its kernels on first use") == 1  # they are in the cache
    finally:
        compilation.cache_directory.cache_clear()


def _double(x: int) -> int:
    return 2 * x


def test_buffers_are_aligned_reused_and_not_shared() -> None:
    drawing.release()
    owner, other = drawing.Buffers(), drawing.Buffers()
    first, second = owner.empty((1000, 7)), other.empty((1000, 7))
    assert first.ctypes.data % 64 == second.ctypes.data % 64 == 0
    assert not np.shares_memory(first, second)
    address = first.ctypes.data
    del owner
    gc.collect()
    again = other.empty((7, 1000), np.int32)
    assert again.ctypes.data == address
