import hashlib
import json
import pickle
import random
import shutil
from functools import reduce
from operator import getitem
from pathlib import Path

import pyarrow as pa
import pytest
from latent_caches import rooms, small_autoreconstructor, sound_rooms

from completesplat.data.loading.latent_cache import LatentCache
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


@pytest.mark.parametrize("damage", ["cut", "longer", "gone", "other", "columns"])
def test_a_damaged_file_is_refused_by_its_name(copy, damage):
    path = copy / "latents.arrow"
    content = path.read_bytes()
    changed = {"cut": content[:-1], "longer": content + b"x", "other": bytes(len(content))}
    path.unlink()
    if damage in changed:
        path.write_bytes(changed[damage])
    elif damage == "columns":
        table = pa.ipc.open_stream(content).read_all()
        with pa.ipc.new_stream(path, table.select(["name", "mean"]).schema) as writer:
            writer.write_table(table.select(["name", "mean"]))
        path.write_bytes(path.read_bytes().ljust(len(content), b"\0"))
    with pytest.raises(DataError) as caught:
        LatentCache(copy)
    assert caught.value.file == str(path)
    assert "\n" not in str(caught.value)


def read_all(folder: Path) -> list[tuple]:
    store = LatentCache(folder)
    scenes = [store.scene(name, frame) for name, sequence in store.sequences.items() for frame in sequence.stored]
    return [(scene.mean.tolist(), scene.log_variance.tolist(), scene.condition.tolist()) for scene in scenes]


def test_every_changed_byte_of_every_file_is_refused_or_changes_nothing(copy):
    values = read_all(copy)
    chance = random.Random(0)
    noticed = dict.fromkeys(copy.iterdir(), 0)
    for path in noticed:
        content = path.read_bytes()
        for place in [*chance.sample(range(len(content)), 60), len(content) - 2]:
            changed = bytearray(content)
            changed[place] ^= 1
            path.write_bytes(changed)
            try:
                assert read_all(copy) == values
            except DataError as error:
                noticed[path] += 1
                assert "\n" not in str(error)  # noqa: PT017
        path.write_bytes(content)
    assert noticed[copy / "manifest.json"] == 61
    assert noticed[copy / "latents.arrow"] > 40


def test_a_changed_value_of_a_frame_is_refused_with_its_place_and_others_are_read(copy):
    store, path = LatentCache(copy), copy / "latents.arrow"
    scene = store.scene("c2", 3)
    place = path.read_bytes().index(scene.mean.numpy().tobytes())
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)
    store = LatentCache(copy)
    with pytest.raises(DataError, match="its checksum is another") as caught:
        store.scene("c2", 3)
    assert (caught.value.sequence, caught.value.frame) == ("c2", 3)
    assert store.scene("c2", 2).names == "c2"


def test_standard_deviations_that_were_changed_are_refused(copy):
    text = (copy / "manifest.json").read_text()
    digits = json.loads(text)["std"][0]
    (copy / "manifest.json").write_text(text.replace(str(digits), str(digits * 2)))
    with pytest.raises(DataError, match=r"manifest\.json: its checksum is another"):
        read_all(copy)


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("format",), 99),
        (("shapes", "mean"), [4, 2]),
        (("origin", "precision"), "object"),
        (("bytes",), 3),
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
        read_all(copy)


def test_a_store_goes_to_other_processes_without_its_values_and_a_cut_manifest_is_refused(sound, copy):
    store = LatentCache(sound)
    again = pickle.loads(pickle.dumps(store))
    assert len(pickle.dumps(store)) < 1000
    assert again.manifest == store.manifest
    path = copy / "manifest.json"
    path.write_text(path.read_text()[:-20])
    with pytest.raises(DataError, match="not a JSON file"):
        LatentCache(copy)
