"""Broken clips and files in pixelSplat's form: each at its source, and one of each kind through the data module.

60 cases by name: 20 in which the clip's content is wrong, 18 in which its entry is, 22 in which its file is.
"""

import functools
import io
import json
import logging
import os
import subprocess
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from bad_clips import (
    BAD,
    BAD_CLIPS,
    CLIPS,
    HELD_OUT,
    INTACT,
    SETTINGS,
    changed,
    check_policies,
    check_source,
    read_tree,
)  # fmt: skip
from bad_inputs import one_of_each_kind
from realestate10k_trees import assert_refusal, chunk_entry, module, write_chunk_form, write_tree

from completesplat.data.realestate10k.module import RE10KDataModule
from completesplat.data.validation import BadAnnotation, OutsidePath, UnreadableFile
from completesplat.errors import DataError

CHUNK = "000000.torch"
Damage = Callable[[Path], object]


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> RE10KDataModule:
    """What the damaged trees would be."""
    root = write_tree(tmp_path_factory.mktemp("intact"), "chunks", CLIPS, CLIPS)
    return module(root, **SETTINGS, cache=True)


def write(folder: Path, clips: list = CLIPS) -> Path:
    """One clip a chunk, the broken one in the first; returns that."""
    write_chunk_form(folder, clips, clips_per_chunk=1)
    return folder / CHUNK


@pytest.mark.parametrize("name", BAD_CLIPS)
def test_a_clip_of_bad_content_is_refused_by_the_source_with_its_place(name, tmp_path):
    change, kind, frame = BAD_CLIPS[name]
    path = write(tmp_path / "train", changed(change))
    check_source(path.parent, kind, path, frame)


@pytest.mark.parametrize("policy", ["raise", "skip"])
@pytest.mark.parametrize("name", one_of_each_kind(BAD_CLIPS, 1))
def test_a_clip_of_bad_content_never_gets_into_a_batch(name, policy, tmp_path, intact):
    change, kind, frame = BAD_CLIPS[name]
    path = write(tmp_path / "train", changed(change))
    check_policies(path.parent, policy, intact, kind, path, frame)


def large(*shape: int, dtype: torch.dtype = torch.uint8) -> torch.Tensor:
    """Zeros that are one number in the file."""
    return torch.zeros(1, dtype=dtype).expand(shape)


# name: (what the entry has instead, part of the message); for a clip of four frames.
BAD_ENTRIES: dict[str, tuple[dict[str, Any], str]] = {
    "cameras_of_17_columns": ({"cameras": torch.zeros(4, 17)}, "18 columns"),
    "cameras_of_integers": ({"cameras": torch.zeros(4, 18, dtype=torch.int64)}, "18 columns of floats"),
    "cameras_of_three_axes": ({"cameras": torch.zeros(4, 18, 1)}, "18 columns"),
    "cameras_are_a_list": ({"cameras": [[0.5] * 18] * 4}, "18 columns"),
    "sparse_cameras": ({"cameras": torch.zeros(4, 18).to_sparse()}, "18 columns"),
    "cameras_without_numbers": ({"cameras": torch.zeros(4, 18, device="meta")}, "18 columns"),
    "cameras_of_a_graph": ({"cameras": torch.nn.Parameter(torch.zeros(4, 18))}, "18 columns"),
    "cameras_too_few": ({"cameras": torch.zeros(3, 18)}, "4 images, 3 cameras and 4 timestamps"),
    "timestamps_of_floats": ({"timestamps": torch.arange(4.0)}, "timestamps are not int64"),
    "timestamps_are_a_list": ({"timestamps": [0, 1, 2, 3]}, "timestamps are not int64"),
    "sparse_timestamps": ({"timestamps": torch.arange(4).to_sparse()}, "timestamps are not int64"),
    "timestamps_too_many": ({"timestamps": large(10**12, dtype=torch.int64)}, "1000000000000 timestamps"),
    "images_are_missing": ({"images": None}, "images are not a list"),
    "images_of_floats": ({"images": [torch.zeros(9)] * 4}, "images are not a list"),
    "images_decoded": ({"images": [torch.zeros(18, 32, dtype=torch.uint8)] * 4}, "images are not a list"),
    "images_of_a_terabyte": ({"images": [large(10**12)] * 4}, "images are not a list"),
    "images_without_numbers": ({"images": [torch.zeros(9, dtype=torch.uint8, device="meta")] * 4}, "not a list"),
    "images_too_few": ({"images": []}, "0 images, 4 cameras and 4 timestamps"),
}


@pytest.mark.parametrize("name", BAD_ENTRIES)
def test_an_entry_of_another_type_or_shape_is_refused_by_the_source(name, tmp_path):
    fields, part = BAD_ENTRIES[name]
    path = write(tmp_path / "train")
    torch.save([chunk_entry(CLIPS[0]) | fields], path)
    with pytest.raises(DataError, match=part):
        module(tmp_path, **SETTINGS).source("train").read(BAD)
    check_source(path.parent, BadAnnotation, path, None)


@pytest.mark.parametrize("policy", ["raise", "skip"])
def test_an_entry_of_another_shape_never_gets_into_a_batch(policy, tmp_path, intact):
    path = write(tmp_path / "train")
    torch.save([chunk_entry(CLIPS[0]) | BAD_ENTRIES["cameras_of_17_columns"][0]], path)
    check_policies(path.parent, policy, intact, BadAnnotation, path, None)


class Runs:
    """A pickle of this calls a function when it is loaded carelessly."""

    def __init__(self, *call: Any) -> None:
        self.call = call

    def __reduce__(self) -> tuple:
        return self.call[0], self.call[1:]


def hub(folder: Path, canary: Path) -> Runs:
    (folder.parent / "hub").mkdir(exist_ok=True)
    (folder.parent / "hub/hubconf.py").write_text(f"def run():\n    open({str(canary)!r}, 'w')\n")
    return Runs(functools.partial(torch.hub.load, str(folder.parent / "hub"), "run", source="local"))


GADGETS: dict[str, Callable[[Path, Path], Runs]] = {
    "os_system": lambda folder, canary: Runs(os.system, f"touch '{canary}'"),
    "builtins_exec": lambda folder, canary: Runs(exec, f"open({str(canary)!r}, 'w')"),
    "builtins_eval": lambda folder, canary: Runs(eval, f"open({str(canary)!r}, 'w')"),
    "torch_hub_load": hub,
    "functools_partial": lambda folder, canary: Runs(functools.partial(os.mkdir, str(canary))),
    "subprocess": lambda folder, canary: Runs(subprocess.call, ["touch", str(canary)]),
}


def runs(name: str, **options: Any) -> Damage:
    def damage(path: Path) -> None:
        gadget = GADGETS[name](path.parent, path.parent.parent / "canary")
        torch.save([chunk_entry(CLIPS[0]) | {"url": gadget}], path, **options)

    return damage


def content(data: bytes) -> Damage:
    return lambda path: path.write_bytes(data)


def saved(make: Callable[[dict[str, Any]], object], **options: Any) -> Damage:
    return lambda path: torch.save(make(chunk_entry(CLIPS[0])), path, **options)


def flipped(data: Callable[[], bytes]) -> Damage:
    """One bit in the middle of these bytes of the file."""

    def damage(path: Path) -> None:
        whole = bytearray(path.read_bytes())
        whole[whole.index(data()) + len(data()) // 2] ^= 1
        path.write_bytes(whole)

    return damage


def bomb(path: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        records = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in {**records, f"{next(iter(records)).split('/')[0]}/data/9999": bytes(10**7)}.items():
            archive.writestr(name, data)


def other_zip() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("readme.txt", "nothing")
    return buffer.getvalue()


# name: (damage of the broken clip's chunk, kind)
BAD_FILES: dict[str, tuple[Damage, type[DataError]]] = {
    "empty": (content(b""), UnreadableFile),
    "html": (content(b"<html>404</html>"), UnreadableFile),
    "cut": (lambda path: path.write_bytes(path.read_bytes()[:-500]), UnreadableFile),
    "flipped_bit_in_a_camera": (flipped(CLIPS[0].rows.tobytes), UnreadableFile),
    "flipped_bit_in_a_picture": (flipped(lambda: CLIPS[0].pictures[2]), UnreadableFile),
    "flipped_bit_in_the_pickle": (flipped(lambda: b"timestamps"), UnreadableFile),
    "zip_of_something_else": (content(other_zip()), UnreadableFile),
    "legacy_form": (saved(lambda entry: [entry], _use_new_zipfile_serialization=False), UnreadableFile),
    "bomb": (bomb, UnreadableFile),
    **{f"pickle_that_runs_{name}": (runs(name), UnreadableFile) for name in GADGETS},
    "legacy_pickle_that_runs_code": (runs("os_system", _use_new_zipfile_serialization=False), UnreadableFile),
    "table_instead_of_a_list": (saved(lambda entry: {BAD: entry}), BadAnnotation),
    "list_of_tensors": (saved(lambda entry: list(entry["images"])), BadAnnotation),
    "no_key": (saved(lambda entry: [{k: v for k, v in entry.items() if k != "key"}]), BadAnnotation),
    "key_is_a_number": (saved(lambda entry: [entry | {"key": 7}]), BadAnnotation),
    "key_twice": (saved(lambda entry: [entry, entry]), BadAnnotation),
    "another_clip": (saved(lambda entry: [entry | {"key": "other"}]), BadAnnotation),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_a_bad_file_is_refused_by_the_source_and_runs_nothing(name, tmp_path, monkeypatch):
    damage, kind = BAD_FILES[name]
    path = write(tmp_path / "train")
    damage(path)
    calls: list[object] = []
    for module_name in ("os", "posix"):
        monkeypatch.setattr(f"{module_name}.system", calls.append)
    check_source(path.parent, kind, path, None)
    assert not calls
    assert not (tmp_path / "canary").exists()


@pytest.mark.parametrize("policy", ["raise", "skip"])
@pytest.mark.parametrize("name", [*one_of_each_kind(BAD_FILES, 1), "pickle_that_runs_torch_hub_load"])
def test_a_bad_file_never_gets_into_a_batch(name, policy, tmp_path, intact):
    damage, kind = BAD_FILES[name]
    path = write(tmp_path / "train")
    damage(path)
    check_policies(path.parent, policy, intact, kind, path, None)
    assert not (tmp_path / "canary").exists()


@pytest.mark.parametrize("name", GADGETS)
def test_the_gadgets_would_run_if_chunks_were_read_carelessly(name, tmp_path):
    path = write(tmp_path / "train")
    runs(name)(path)
    torch.load(path, weights_only=False)
    assert (tmp_path / "canary").exists()


@pytest.mark.parametrize("policy", ["raise", "skip"])
def test_an_index_that_leads_outside_is_raised_or_told(policy, tmp_path, caplog):
    path = write(tmp_path / "train")
    path.rename(tmp_path / CHUNK)
    index = json.loads((path.parent / "index.json").read_text())
    (path.parent / "index.json").write_text(json.dumps(index | {BAD: f"../{CHUNK}"}))
    data = read_tree(path.parent, policy)
    if policy == "raise":
        with pytest.raises(DataError) as caught:
            data.setup("fit")
        error = caught.value
    else:
        assert {name for batch in data.train_dataloader() for name in batch.names} == set(INTACT)
        (error,) = data.source("train").refused
        (message,) = [r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING]
        assert message == f"1 annotations cannot be used; the first: {error}"
    assert_refusal(error, OutsidePath, path.parent / "index.json", BAD, None)


@pytest.mark.parametrize("policy", ["raise", "skip"])
def test_a_missing_chunk_is_no_fault_and_counted(policy, tmp_path):
    """People download a part of the chunks."""
    path = write(tmp_path / "train")
    path.unlink()
    data = read_tree(path.parent, policy)
    loader = data.train_dataloader()
    assert {name for batch in loader for name in batch.names} == set(INTACT)
    assert loader.refused == data.source("train").refused == []
    assert data.source("train").left_out == {"frames are missing": [BAD]}


def test_the_catalogues_are_complete():
    assert (len(BAD_CLIPS), len(BAD_ENTRIES), len(BAD_FILES)) == (20, 18, 22)
    assert HELD_OUT not in INTACT
