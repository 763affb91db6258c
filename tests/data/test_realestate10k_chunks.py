"""Chunks run no code, are refused when they are broken, and never lie in memory by the dozen."""

import json
import os
import weakref
import zipfile
from pathlib import Path

import pytest
import torch
from realestate10k_trees import assert_refusal, chunk_entry, make_clip, write_chunk_form

from completesplat.data.realestate10k import chunks
from completesplat.data.realestate10k.chunks import ChunkedClips, read_chunk
from completesplat.data.realestate10k.module import RE10KDataModule
from completesplat.data.validation import BadAnnotation, OutsidePath, UnreadableFile
from completesplat.errors import DataError


class Canary:
    """A pickle of this makes a folder when it is loaded carelessly."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize("legacy", [False, True])
def test_a_malicious_chunk_runs_nothing(tmp_path, legacy):
    canary, path = tmp_path / "canary", tmp_path / "0.torch"
    entry = chunk_entry(make_clip("a")) | {"url": Canary(canary)}
    torch.save([entry], path, _use_new_zipfile_serialization=not legacy)
    with pytest.raises(DataError, match=r"0\.torch"):
        read_chunk(path)
    assert not canary.exists()
    torch.load(path, weights_only=False)
    assert canary.exists()


def test_damaged_chunks_are_refused(tmp_path):
    write_chunk_form(tmp_path, [make_clip("a")])
    path = tmp_path / "000000.torch"
    whole = path.read_bytes()
    for content in (b"", b"<html>", whole[: len(whole) // 2]):
        path.write_bytes(content)
        with pytest.raises(DataError, match=r"000000\.torch"):
            read_chunk(path)
    for content in ({"key": "a"}, [1], [{"key": 1}], [{"key": "a"}, {"key": "a"}]):
        torch.save(content, path)
        with pytest.raises(DataError, match=r"000000\.torch"):
            read_chunk(path)


def test_a_chunk_larger_than_its_file_is_refused(tmp_path):
    write_chunk_form(tmp_path, [make_clip("a")])
    path = tmp_path / "000000.torch"
    with zipfile.ZipFile(path) as archive:
        records = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in {**records, "000000/data/9999": bytes(10**7)}.items():
            archive.writestr(name, content)
    with pytest.raises(DataError, match=r"000000\.torch"):
        read_chunk(path)


@pytest.mark.parametrize(
    ("index", "kind"), [('{"a": 1}', BadAnnotation), ("[]", BadAnnotation), ("{", UnreadableFile), ("", UnreadableFile)]
)
def test_a_malformed_index_is_refused(tmp_path, index, kind):
    (tmp_path / "index.json").write_text(index)
    with pytest.raises(DataError) as caught:
        ChunkedClips(tmp_path)
    assert_refusal(caught.value, kind, tmp_path / "index.json", None, None)


def test_entries_of_an_index_that_lead_elsewhere_are_refused(tmp_path):
    folder = tmp_path / "train"
    write_chunk_form(folder, [make_clip("a")])
    (tmp_path / "0.torch").write_bytes((folder / "000000.torch").read_bytes())
    (folder / "link.torch").symlink_to("../0.torch")
    bad = {"b": "../0.torch", "c": str(tmp_path / "0.torch"), "d": "link.torch", "e": ""}
    (folder / "index.json").write_text(json.dumps({"a": "000000.torch", **bad}))
    clips = ChunkedClips(folder)
    assert (clips.keys, clips.missing) == (["a"], [])
    for error, key in zip(clips.refused, bad, strict=True):
        assert_refusal(error, OutsidePath, folder / "index.json", key, None)


def test_a_clip_in_another_chunk_than_the_index_says_is_refused(tmp_path):
    write_chunk_form(tmp_path, [make_clip("a")])
    (tmp_path / "index.json").write_text(json.dumps({"b": "000000.torch"}))
    with pytest.raises(DataError, match="does not hold this clip") as caught:
        ChunkedClips(tmp_path).clip("b")
    assert_refusal(caught.value, BadAnnotation, tmp_path / "000000.torch", "b", None)


@pytest.fixture
def loads(monkeypatch):
    """Names of the chunks in the order they are read, and the largest number of them alive at once."""
    names, alive, counts = [], [], []
    original = chunks.read_chunk

    def watched(path: Path):
        chunk = original(path)
        alive.append(weakref.ref(next(iter(chunk.values()))["timestamps"]))
        counts.append(sum(ref() is not None for ref in alive))
        names.append(path.name)
        return chunk

    monkeypatch.setattr(chunks, "read_chunk", watched)
    return names, counts


def test_two_chunks_in_memory_and_each_read_once_an_epoch(tmp_path, loads):
    names, counts = loads
    for split in ("train", "test"):
        write_chunk_form(tmp_path / split, [make_clip(f"{i:02}", frames=3) for i in range(18)], clips_per_chunk=3)
    data = RE10KDataModule(str(tmp_path), image_size=8, batch_size=4, references_per_sequence=2, val_fraction=0.0)
    loader = data.train_dataloader()
    loader.sampler.set_epoch(0)
    first = [name for batch in loader for name in batch.names]
    assert len(first) == 34
    assert sorted(names) == [f"{i:06}.torch" for i in range(6)]
    assert names != sorted(names)
    list(data.val_dataloader())
    list(data.train_dataloader())
    assert max(counts) == 2


def test_the_chunk_of_the_longest_ago_goes(tmp_path, loads):
    names, _ = loads
    write_chunk_form(tmp_path, [make_clip(key, frames=2) for key in "abc"], clips_per_chunk=1)
    clips = ChunkedClips(tmp_path)
    for key in "abacab":
        clips.clip(key)
    assert names == ["000000.torch", "000001.torch", "000002.torch", "000001.torch"]
