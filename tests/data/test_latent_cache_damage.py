import pickle
import random
import shutil
from pathlib import Path

import pytest
from latent_caches import rooms, small_autoreconstructor, sound_rooms

from completesplat.data.loading.latent_cache import LatentCache
from completesplat.errors import DataError
from completesplat.training.encoding import FrameEncoder, encode_training_set


@pytest.fixture(scope="module")
def sound(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    data = rooms(sound_rooms(folder / "root"))
    return encode_training_set(FrameEncoder(small_autoreconstructor()), data, folder / "store", progress=False).folder


@pytest.fixture
def copy(sound, tmp_path) -> Path:
    return Path(shutil.copytree(sound, tmp_path / "copy"))


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


def test_a_store_goes_to_other_processes_without_its_values(sound):
    store = LatentCache(sound)
    again = pickle.loads(pickle.dumps(store))
    assert len(pickle.dumps(store)) < 1000
    assert again.manifest == store.manifest
