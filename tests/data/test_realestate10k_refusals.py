"""Broken clips and files in both forms: refused with their place and running no code, by source and by data module."""

import json
import logging
import weakref
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from realestate10k_trees import (
    StoredClip,
    assert_refusal,
    chunk_entry,
    encode,
    epoch,
    make_clip,
    module,
    write_chunk_form,
    write_text_form,
)

from completesplat.data.images.crop import Square
from completesplat.data.realestate10k import clips
from completesplat.data.realestate10k.clips import ChunkedClips, TextClips, read_chunk
from completesplat.data.realestate10k.module import RE10KDataModule
from completesplat.data.validation import (
    BadAnnotation,
    BadCamera,
    OutsidePath,
    UnreadableFile,
)
from completesplat.data.validation.audit import check
from completesplat.errors import DataError

BAD, INTACT = "bad", ("one", "two")

CLIPS = [make_clip(key, frames=4) for key in (BAD, *INTACT)]
TEXT, SECOND, CHUNK = f"{BAD}.txt", f"{BAD}/66000.jpg", "000000.torch"
Damage = Callable[[Path], object]


def write(folder: Path, form: str = "chunks", changed: list[StoredClip] = CLIPS) -> Path:
    """One clip a chunk, the broken one in the first; returns the folder."""
    write_text_form(folder, changed) if form == "text" else write_chunk_form(folder, changed, clips_per_chunk=1)
    return folder


class Runs:
    """A pickle of this calls a function when it is loaded carelessly."""

    def __init__(self, *call: Any) -> None:
        self.call = call

    def __reduce__(self) -> tuple:
        return self.call[0], self.call[1:]


def test_a_chunk_runs_no_code(tmp_path):
    path, canary = tmp_path / CHUNK, tmp_path / "canary"
    harmful = chunk_entry(CLIPS[0]) | {"url": Runs(exec, f"open({str(canary)!r}, 'w')")}
    torch.save([harmful], path)
    with pytest.raises(UnreadableFile):
        read_chunk(path)
    assert not canary.exists()
    torch.load(path, weights_only=False)
    assert canary.exists()


def test_a_principal_point_outside_matters_to_its_own_crop_only(tmp_path):
    clip = make_clip(BAD, frames=4)
    clip.rows[:, 2] = 1.5
    folder = write(tmp_path / "train", "text", [clip, *CLIPS[1:]])
    assert check(module(tmp_path).open("train"), workers=1, progress=False).refused == []
    with pytest.raises(BadCamera) as caught:
        module(tmp_path, crop="principal").open("train")["train"].read(BAD)
    assert_refusal(caught.value, BadCamera, folder / TEXT, BAD, 0)


def test_a_missing_frame_may_be_a_png(tmp_path):
    write(tmp_path, "text")
    pixels = np.arange(18 * 32 * 3, dtype=np.uint8).reshape(18, 32, 3)
    (tmp_path / SECOND).unlink()
    (tmp_path / SECOND).with_suffix(".png").write_bytes(encode(pixels, "PNG"))
    image = TextClips(tmp_path).clip(BAD).read(1, Square(0, 0, 18), 18)
    assert torch.equal(image, torch.from_numpy(pixels[:, :18].transpose(2, 0, 1).copy()))


@pytest.mark.parametrize(
    ("index", "kind"), [('{"a": 1}', BadAnnotation), ("[]", BadAnnotation), ("{", UnreadableFile), (None, DataError)]
)
def test_a_folder_without_any_use_is_raised_under_either_policy(tmp_path, index, kind):
    (tmp_path / "train").mkdir()
    if index is not None:
        (tmp_path / "train/index.json").write_text(index)
    for policy in ("raise", "skip"):
        with pytest.raises(kind, match=str(tmp_path / "train")):
            module(tmp_path, on_bad=policy).setup("fit")


def test_entries_of_an_index_that_lead_elsewhere_are_refused(tmp_path, caplog):
    folder = write(tmp_path / "train")
    (tmp_path / "0.torch").write_bytes((folder / CHUNK).read_bytes())
    (folder / "link.torch").symlink_to("../0.torch")
    bad = {"b": "../0.torch", "c": str(tmp_path / "0.torch"), "d": "link.torch", "e": ""}
    index = json.loads((folder / "index.json").read_text())
    (folder / "index.json").write_text(json.dumps({**index, **bad}))
    result = ChunkedClips(folder)
    assert (result.keys, result.missing) == ([BAD, *INTACT], [])
    for error, key in zip(result.refused, bad, strict=True):
        assert_refusal(error, OutsidePath, folder / "index.json", key, None)
    with pytest.raises(OutsidePath):
        module(tmp_path, on_bad="raise").setup("fit")
    module(tmp_path, on_bad="skip").setup("fit")
    (message,) = {record.getMessage() for record in caplog.records if record.levelno >= logging.WARNING}
    assert message == f"4 annotations cannot be used; the first: {result.refused[0]}"


@pytest.fixture
def loads(monkeypatch):
    """Names of the chunks in the order they are read, and the largest number of them alive at once."""
    names, alive, counts = [], [], []
    original = clips.read_chunk

    def watched(path: Path):
        chunk = original(path)
        alive.append(weakref.ref(next(iter(chunk.values()))["timestamps"]))
        counts.append(sum(ref() is not None for ref in alive))
        names.append(path.name)
        return chunk

    monkeypatch.setattr(clips, "read_chunk", watched)
    return names, counts


def test_two_chunks_in_memory_and_each_read_once_an_epoch(tmp_path, loads):
    names, counts = loads
    result = ChunkedClips(write(tmp_path / "few"))
    for key in (BAD, *INTACT[:1], BAD, INTACT[1], BAD, INTACT[0]):
        result.clip(key)
    assert names == [f"{number:06}.torch" for number in (0, 1, 2, 1)]  # The chunk of the longest ago went.
    del result
    for split in ("train", "test"):
        write_chunk_form(tmp_path / split, [make_clip(f"{i:02}", frames=3) for i in range(18)], clips_per_chunk=3)
    data = RE10KDataModule(
        str(tmp_path), image_size=8, batch_size=4, targets=2, references_per_sequence=2, val_fraction=0.0
    )
    loader = data.train_dataloader()
    names.clear()
    assert sum(len(batch.names) for batch in epoch(loader, 0)) == 34
    assert sorted(names) == [f"{i:06}.torch" for i in range(6)]
    assert names != sorted(names)
    list(data.val_dataloader())
    list(data.train_dataloader())
    assert max(counts) == 2
