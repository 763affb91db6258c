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
    FORMS,
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
    BadImage,
    MissingFile,
    OutsidePath,
    TooFewFrames,
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


def assert_only_refusal(folder: Path, kind: type[DataError], file: str, frame: int | None) -> None:
    """All training clips are read whole, and one fault is found."""
    source = module(folder.parent, val_fraction=0.0).open("train")["train"]
    assert source.refused == []
    source.names = [BAD, *INTACT]
    (error,) = check({"train": source}, workers=1, progress=False).refused
    assert_refusal(error, kind, folder / file, BAD, frame)


def entry(row: int, column: int | slice, value: float) -> Callable[[StoredClip], object]:
    return lambda clip: clip.rows[row].__setitem__(column, value)


def stored_image(frame: int, make: Callable[[bytes], bytes]) -> Callable[[StoredClip], object]:
    return lambda clip: clip.images.__setitem__(frame, make(clip.images[frame]))


def mirrored(clip: StoredClip) -> None:
    clip.rows[2, 6:10] *= -1


def first(count: int) -> Callable[[StoredClip], object]:
    return lambda clip: vars(clip).update({k: v[:count] for k, v in vars(clip).items() if k != "key"})


# name: (change, kind, frame), in whichever form a clip is stored.
BAD_CLIPS: dict[str, tuple[Callable[[StoredClip], object], type[DataError], int | None]] = {
    "nan_in_a_pose": (entry(2, 9, np.nan), BadAnnotation, 2),
    "a_pose_beyond_float32_squared": (entry(2, 9, 1e30), BadAnnotation, 2),
    "reflection": (mirrored, BadCamera, 2),
    "sheared_rotation": (entry(2, 6, 1.01), BadCamera, 2),
    "zero_focal_length": (entry(3, 1, 0), BadCamera, 3),
    "lens_distortion": (entry(2, 4, 0.1), BadCamera, 2),
    "one_frame": (first(1), TooFewFrames, None),
    "cut_jpeg": (stored_image(2, lambda data: data[: len(data) // 2]), BadImage, 2),
    "html_instead_of_the_first_image": (stored_image(0, lambda _: b"<html>404</html>"), BadImage, 0),
    "another_size_in_the_middle": (stored_image(2, lambda _: make_clip("x", size=(32, 18)).images[0]), BadImage, 2),
}  # fmt: skip


def broken(name: str) -> list[StoredClip]:
    clip = make_clip(BAD, frames=4)
    BAD_CLIPS[name][0](clip)
    return [clip, *CLIPS[1:]]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", BAD_CLIPS)
def test_a_broken_clip_is_refused_with_its_place(name, form, tmp_path):
    _, kind, frame = BAD_CLIPS[name]
    of_text = f"{BAD}/{33_000 * ((frame or 0) + 1)}.jpg" if kind is BadImage else TEXT
    assert_only_refusal(
        write(tmp_path / "train", form, broken(name)), kind, of_text if form == "text" else CHUNK, frame
    )


def line_of(number: int, edit: Callable[[list[str]], list[str]]) -> Damage:
    """Change the columns of a frame's line."""

    def damage(folder: Path) -> None:
        lines = (folder / TEXT).read_text().splitlines()
        lines[1 + number] = " ".join(edit(lines[1 + number].split()))
        (folder / TEXT).write_text("\n".join(lines))

    return damage


def replaced(file: str, make: Callable[[Path], object]) -> Damage:
    return lambda folder: ((folder / file).unlink(), make(folder / file))


# name: (damage, kind, file, frame)
BAD_TEXTS: dict[str, tuple[Damage, type[DataError], str, int | None]] = {
    "an_image": (replaced(TEXT, lambda path: path.write_bytes(CLIPS[0].images[0])), UnreadableFile, TEXT, None),
    "a_folder": (replaced(TEXT, Path.mkdir), MissingFile, TEXT, None),
    "column_too_many": (line_of(1, lambda columns: [*columns, "0"]), BadAnnotation, TEXT, 1),
    "letters": (line_of(2, lambda columns: [*columns[:5], "k1", *columns[6:]]), BadAnnotation, TEXT, 2),
    "timestamp_twice": (line_of(2, lambda columns: ["66000", *columns[1:]]), BadAnnotation, TEXT, 1),
    "no_image": (line_of(2, lambda columns: ["98999", *columns[1:]]), MissingFile, f"{BAD}/98999.jpg", 2),
}


@pytest.mark.parametrize("name", BAD_TEXTS)
def test_a_broken_text_is_refused_with_its_place(name, tmp_path):
    damage, *expected = BAD_TEXTS[name]
    damage(write(tmp_path / "train", "text"))
    assert_only_refusal(tmp_path / "train", *expected)


def large(*shape: int, dtype: torch.dtype = torch.uint8) -> torch.Tensor:
    """Zeros that are one number in the file."""
    return torch.zeros(1, dtype=dtype).expand(shape)


@pytest.mark.parametrize(
    ("fields", "part"),
    [
        ({"cameras": torch.zeros(4, 17)}, "18 columns"),
        ({"cameras": torch.zeros(3, 18)}, "4 images, 3 cameras and 4 timestamps"),
        ({"timestamps": torch.arange(4.0)}, "timestamps are not int64"),
        ({"timestamps": torch.tensor([0, 1, 2, 1])}, "another frame has its timestamp"),
        ({"images": [large(10**6)] * 4}, "images are not a list"),
    ],
)
def test_an_entry_of_another_type_or_shape_is_refused(tmp_path, fields, part):
    torch.save([chunk_entry(CLIPS[0]) | fields], write(tmp_path) / CHUNK)
    with pytest.raises(BadAnnotation, match=part) as caught:
        ChunkedClips(tmp_path).clip(BAD)
    assert_refusal(caught.value, BadAnnotation, tmp_path / CHUNK, BAD, 1 if "another" in part else None)


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


def saved(make: Callable[[dict[str, Any]], object]) -> Damage:
    return lambda path: torch.save(make(chunk_entry(CLIPS[0])), path)


# name: (damage of the broken clip's chunk, kind)
BAD_CHUNKS: dict[str, tuple[Damage, type[DataError]]] = {
    "cut": (lambda path: path.write_bytes(path.read_bytes()[:-500]), UnreadableFile),
    "list_of_tensors": (saved(lambda entry: list(entry["images"])), BadAnnotation),
    "key_twice": (saved(lambda entry: [entry, entry]), BadAnnotation),
    "another_clip": (saved(lambda entry: [entry | {"key": "other"}]), BadAnnotation),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_CHUNKS)
def test_a_bad_chunk_is_refused(name, tmp_path):
    damage, kind = BAD_CHUNKS[name]
    damage(write(tmp_path / "train") / CHUNK)
    assert_only_refusal(tmp_path / "train", kind, CHUNK, None)


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
