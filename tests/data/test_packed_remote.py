"""A packed store that a web server holds, read by several processes: shards are fetched once, when they are needed."""

import os
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler
from pathlib import Path

import pytest
from packed_sequences import ListedSource, pack, prepared
from realestate10k_trees import equal
from support import flip_bit, serving

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.packed.source import PackedSource, local_root
from completesplat.data.toy.data_sets import SUBSET
from completesplat.errors import ChangedFile, DataError, MissingFile

pytestmark = pytest.mark.processes

NAMES = [f"s{number}" for number in range(6)]


class Logged(SimpleHTTPRequestHandler):
    asked: list[str]

    def log_request(self, *_: object) -> None:
        self.asked.append(f"{self.command} {self.path}")


@pytest.fixture
def served(tmp_path, monkeypatch) -> Iterator[tuple[str, Path, list[str]]]:
    """The address of a folder, the folder, and what is asked for."""
    monkeypatch.setenv("COMPLETESPLAT_CACHE", str(tmp_path / "cache"))
    (tmp_path / "served").mkdir()
    asked: list[str] = []
    handler = type("Handler", (Logged,), {"asked": asked})
    with serving(partial(handler, directory=str(tmp_path / "served"))) as address:
        yield f"{address}/STORE", tmp_path / "served/STORE", asked


def make(out: Path, content: str = "a") -> None:
    pack(ListedSource(NAMES, content=content), out)


def shards_asked(asked: list[str]) -> list[str]:
    return [line.rpartition("/")[2] for line in asked if line.startswith("GET") and line.endswith(".arrow")]


def test_shards_are_fetched_when_they_are_read_once_and_in_their_order(served):
    address, folder, asked = served
    make(folder)
    source = PackedSource(local_root(address), "train")
    assert shards_asked(asked) == []
    assert source.groups(NAMES) == [[0, 1], [2, 3], [4, 5]]
    assert source.groups(["s4", "s0", "s5"]) == [[0, 2], [1]]
    here = PackedSource(folder, "train")
    for name in NAMES:
        sequence, expected = source.read(name), here.read(name)
        assert sequence.frames == expected.frames
        assert all((sequence.read(i).image == expected.read(i).image).all() for i in range(4))
        assert len(shards_asked(asked)) == 1 + NAMES.index(name) // 2
    again = PackedSource(local_root(f"{address}"), "train")
    assert (again.read("s0").name, len(shards_asked(asked))) == ("s0", 3)
    assert again.fingerprint() == here.fingerprint()
    assert again.verify() == []


def test_what_cannot_be_fetched_or_is_another_file_is_said(served):
    address, folder, _ = served
    with pytest.raises(MissingFile, match=r"/STORE/manifest.json: cannot be fetched"):
        local_root(address)
    make(folder)
    source = PackedSource(local_root(address), "train")
    shards = sorted(folder.glob("*.arrow"))
    flip_bit(shards[0], -8)
    shards[1].unlink()
    with pytest.raises(ChangedFile, match="checksum is not that of the manifest"):
        source.read("s0")
    with pytest.raises(MissingFile, match="cannot be fetched"):
        source.read("s2")
    assert source.read("s4").name == "s4"
    assert not list(source.root.rglob("*tmp*"))


def test_a_store_that_was_fetched_is_read_when_its_address_does_not_answer(served, caplog):
    address, folder, _ = served
    make(folder)
    first = local_root(address)
    (folder / "manifest.json").unlink()
    assert local_root(address) == first
    assert "the manifest fetched before is used" in caplog.text


def test_a_store_that_is_made_anew_is_another_one(served):
    address, folder, _ = served
    make(folder)
    first = local_root(address)
    for path in folder.iterdir():
        os.remove(path)
    make(folder, content="b")
    assert local_root(address) != first
    assert PackedSource(local_root(address), "train").fingerprint() == "b"


def test_training_reads_it_in_worker_processes(served, toy_root):
    address, folder, asked = served
    settings = {"subset": SUBSET, "image_size": 16, "batch_size": 2, "targets": 2}
    raw = CO3DDataModule(str(toy_root), "toy_objects", **settings)
    prepared(raw, folder, sequences_per_shard=1)
    data = CO3DDataModule(address, "toy_objects", workers=2, **settings)
    data.setup("fit")
    assert len(list(data.train_dataloader())) == 1
    assert equal(list(data.val_dataloader()), list(raw.val_dataloader()))
    assert len(shards_asked(asked)) == len(set(shards_asked(asked))) == 3
    with pytest.raises(DataError, match="prepared with image_size=16"):
        CO3DDataModule(address, "toy_objects", **settings | {"image_size": 32}).setup("fit")


def test_what_was_not_fetched_is_no_fault_of_the_store(served):
    address, folder, asked = served
    make(folder)
    source = PackedSource(local_root(address), "train")
    assert source.verify() == []
    source.read("s0")
    (fetched,) = source.root.glob("*.arrow")
    fetched.write_bytes(b"another" + fetched.read_bytes()[7:])
    assert [error.file for error in source.verify()] == [str(fetched)]
    assert len(shards_asked(asked)) == 1
