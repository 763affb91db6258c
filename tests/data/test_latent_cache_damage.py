import hashlib
import json
import pickle
import random
import shutil
from functools import reduce
from operator import getitem
from pathlib import Path

import numpy as np
import pytest
from latent_caches import rooms, small_autoreconstructor, sound_rooms

from completesplat.data.loading.latent_cache import ArrayWriter, LatentCache, open_array
from completesplat.errors import DataError
from completesplat.training.encoding import encode_training_set


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    data = rooms(sound_rooms(folder / "root"))
    return encode_training_set(small_autoreconstructor(), data, folder / "store", progress=False).folder


@pytest.fixture
def copy(sound, tmp_path) -> Path:
    return Path(shutil.copytree(sound, tmp_path / "copy"))


@pytest.mark.parametrize("damage", ["cut", "longer", "gone", "other", "objects"])
def test_a_damaged_array_is_refused_by_its_name(copy, damage):
    path = copy / "log_variance.npy"
    content = path.read_bytes()
    changed = {"cut": content[:-1], "longer": content + b"x"}
    path.unlink()
    if damage in changed:
        path.write_bytes(changed[damage])
    elif damage != "gone":
        np.save(path, np.zeros((3, 4), np.float32) if damage == "other" else np.array([{}, []], dtype=object))
    with pytest.raises(DataError) as caught:
        LatentCache(copy)
    assert caught.value.file == str(path)
    assert "\n" not in str(caught.value)


def read_all(folder: Path) -> None:
    store = LatentCache(folder)
    for name, sequence in store.sequences.items():
        for frame in sequence.stored:
            store.scene(name, frame)


def test_every_changed_byte_of_every_file_is_refused(copy):
    """Changed standard deviations in the manifest are refused too."""
    read_all(copy)
    chance = random.Random(0)
    for path in sorted(copy.iterdir()):
        content = path.read_bytes()
        begin = content.index(b"\n") + 1  # behind the header of an array
        for place in [*chance.sample(range(begin, len(content) - 1), 6), len(content) - 2]:
            changed = bytearray(content)
            changed[place] ^= 1
            path.write_bytes(changed)
            with pytest.raises(DataError, match=r"^[^\n]*$"):
                read_all(copy)
        path.write_bytes(content)
    text = (copy / "manifest.json").read_text()
    digits = json.loads(text)["std"][0]
    (copy / "manifest.json").write_text(text.replace(str(digits), str(digits * 2)))
    with pytest.raises(DataError, match=r"manifest\.json: its checksum is another"):
        read_all(copy)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("format",), 99),
        (("arrays", "mean", "file"), "../mean.npy"),
        (("arrays", "mean", "dtype"), "object"),
        (("origin", "frames"), "all"),
    ],
)
def test_a_manifest_that_cannot_be_true_is_refused(copy, place, value):
    path = copy / "manifest.json"
    content = json.loads(path.read_text())
    reduce(getitem, place[:-1], content)[place[-1]] = value
    text = json.dumps(content | {"sha256": "0" * 64})
    path.write_text(text.replace("0" * 64, hashlib.sha256(text.encode()).hexdigest()))
    with pytest.raises(DataError, match=r"^(?!.*its checksum is another)"):
        LatentCache(copy)


def test_a_store_goes_to_other_processes_without_its_arrays_and_a_cut_manifest_is_refused(sound, copy):
    store = LatentCache(sound)
    again = pickle.loads(pickle.dumps(store))
    assert len(pickle.dumps(store)) < 1000
    assert all(isinstance(array, np.memmap) for array in again.arrays.values())
    assert again.manifest == store.manifest
    path = copy / "manifest.json"
    path.write_text(path.read_text()[:-20])
    with pytest.raises(DataError, match="not a JSON file"):
        LatentCache(copy)


@pytest.mark.parametrize("parts", [[], [1], [3, 0, 100_000]])
def test_rows_are_read_as_they_were_written_and_those_of_an_interrupted_writing_are_removed(tmp_path, parts):
    with pytest.raises(KeyboardInterrupt), ArrayWriter(tmp_path / "rows.npy", (1, 2, 1), "float16"):
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []
    rng = np.random.default_rng(0)
    blocks = [rng.normal(size=(count, 1, 2, 1)).astype(np.float16) for count in parts]
    with ArrayWriter(tmp_path / "rows.npy", (1, 2, 1), "float16") as writer:
        for block in blocks:
            writer.append(block)
    expected = np.concatenate([np.zeros((0, 1, 2, 1), np.float16), *blocks])
    assert np.array_equal(np.load(tmp_path / "rows.npy"), expected)
    if parts:
        assert np.array_equal(open_array(tmp_path, writer.described()), expected)
