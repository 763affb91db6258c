"""Many sequences from a few, and what a process has in memory."""

import mmap
from pathlib import Path

import numpy as np
import pytest
import torch
from packed_sequences import ListedSource

from completesplat.benchmarks import data
from completesplat.benchmarks.data import RepeatedSource, resident_megabytes
from completesplat.data.sequences import SequenceSource

needs_proc = pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="the system has no /proc")


def test_sequences_come_again_under_other_names() -> None:
    few = ListedSource(["a", "b", "c"])
    many = RepeatedSource(few, 7)
    assert isinstance(many, SequenceSource)
    assert len(set(many.names)) == 7
    for name, original in zip(many.names, "abcabca", strict=True):
        found, expected = many.read(name), few.read(original)
        assert (found.name, found.frames) == (name, expected.frames)
        assert torch.equal(found.cameras.world_to_camera, expected.cameras.world_to_camera)
        assert torch.equal(found.read(1).image, expected.read(1).image)


def test_their_groups_hold_every_one_once() -> None:
    many = RepeatedSource(ListedSource(["a", "b"]), 5)
    assert sorted(number for group in many.groups(many.names) for number in group) == list(range(5))


@needs_proc
def test_what_an_array_takes_is_memory_of_the_process_itself() -> None:
    before = resident_megabytes()
    # Fresh pages from the system: an allocator may give out memory that the process has already.
    kept = np.frombuffer(mmap.mmap(-1, 60 * 2**20, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS), np.uint8)
    kept[:] = 1
    after = resident_megabytes()
    assert before is not None
    assert after is not None
    assert 55 < after["anonymous"] - before["anonymous"] < 70
    assert kept.all()


@needs_proc
def test_pages_of_a_mapped_file_are_counted_apart(tmp_path: Path) -> None:
    np.save(tmp_path / "array.npy", np.ones(60 * 2**20, np.uint8))
    before = resident_megabytes()
    mapped = np.load(tmp_path / "array.npy", mmap_mode="r")
    assert all(mapped[::4096])
    after = resident_megabytes()
    assert before is not None
    assert after is not None
    assert 55 < after["file"] - before["file"] < 70
    assert after["anonymous"] - before["anonymous"] < 20


def test_without_proc_memory_is_unknown(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(data, "STATUS", tmp_path / "status")
    assert resident_megabytes() is None
