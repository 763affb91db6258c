import pickle
import random
import shutil
from dataclasses import fields
from pathlib import Path

import pytest
import torch
from latent_caches import broken_rooms, rooms, small_autoreconstructor, sound_rooms
from readers import read_latents
from support import flip_bit

from completesplat.data.loading.latent_cache import LatentCache
from completesplat.data.loading.loader import SceneLoader
from completesplat.errors import CompleteSplatError, DataError
from completesplat.scene import CachedScene
from completesplat.training.encoding import FrameEncoder, encode_training_set

BOXES = {"probability": 0.7}
STRENGTHS = ("brightness", "contrast", "saturation", "hue")
SEQUENCES = 6  # of nine clips one is for validation, and two could not be packed


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    return broken_rooms(tmp_path_factory.mktemp("root"))


@pytest.fixture(scope="module")
def cache(root, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("cache")
    encode_training_set(FrameEncoder(small_autoreconstructor()), rooms(root), out, progress=False)
    return out


def drawn(loader: SceneLoader, number: int) -> list[list]:
    """All that the batches of an epoch hold, to be compared bit by bit."""
    loader.sampler.set_epoch(number)
    values = [[getattr(batch, field.name) for field in fields(CachedScene)] for batch in loader]
    return [[v.tolist() if isinstance(v, torch.Tensor) else v for v in batch] for batch in values]


@pytest.mark.parametrize("references", [1, 3])
def test_an_item_is_the_sequence_and_the_encoded_reference_that_images_give(root, cache, references):
    settings = {"box_masks": BOXES, "references_per_sequence": references}
    from_images = rooms(root, **settings).train_dataloader()
    cached = rooms(root, latent_cache=str(cache), **settings).train_dataloader()
    assert [list(part) for part in cached.sampler.groups] == [list(part) for part in from_images.sampler.groups]
    assert len(cached.dataset) == len(from_images.dataset) == SEQUENCES * references
    encoder = small_autoreconstructor().encoder
    for key in [(number, index) for number in (0, 1) for index in range(len(from_images.dataset))]:
        scene, drawn = cached.dataset[key].scenes, from_images.dataset[key].scenes
        assert (scene.names, scene.reference_frame.item()) == (drawn.names, drawn.reference_frame.item())
        assert torch.equal(scene.condition, drawn.reference.images * drawn.visible)
        with torch.no_grad():
            posterior, _ = encoder(drawn.reference.images[None])
        torch.testing.assert_close(scene.mean, posterior.mean[0], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(scene.log_variance, posterior.log_variance[0], rtol=1e-4, atol=1e-5)


def test_batches_are_stacked_items_and_a_resumed_epoch_continues_exactly(root, cache):
    data = rooms(root, latent_cache=str(cache), box_masks=BOXES)
    interrupted, resumed = data.train_dataloader(), data.train_dataloader()
    expected = drawn(interrupted, 1)
    assert drawn(interrupted, 0) != expected
    interrupted.sampler.set_epoch(1)
    batch = next(iter(interrupted))
    assert batch.mean.shape == (3, 4, 2, 2)
    assert batch.condition.shape == (3, 3, 16, 16)
    assert len(batch.names) == len(batch.reference_frame) == 3
    assert batch[1].names == batch.names[1]
    resumed.load_state_dict(interrupted.state_dict())
    assert drawn(resumed, 1) == expected[1:]
    workers = rooms(root, latent_cache=str(cache), box_masks=BOXES, workers=2).train_dataloader()
    assert drawn(workers, 1) == expected
    # Validation reads images.
    assert next(iter(data.val_dataloader())).targets.images.shape[-3:] == (3, 16, 16)


def test_where_few_frames_are_encoded_the_nearest_takes_the_references_place(tmp_path):
    root = sound_rooms(tmp_path / "root")
    store = encode_training_set(
        FrameEncoder(small_autoreconstructor()), rooms(root), tmp_path / "cache", frames=2, progress=False
    )
    assert {sequence.stored for sequence in store.manifest.sequences} == {(1, 3)}
    from_images = rooms(root).train_dataloader()
    cached = rooms(root, latent_cache=str(tmp_path / "cache")).train_dataloader()
    nearest = {0: 1, 1: 1, 2: 1, 3: 3, 4: 3}
    seen = set()
    for key in [(number, index) for number in range(6) for index in range(4)]:
        drawn, scene = from_images.dataset[key].scenes, cached.dataset[key].scenes
        assert scene.names == drawn.names
        assert scene.reference_frame.item() == nearest[drawn.reference_frame.item()]
        seen.add(drawn.reference_frame.item())
    assert len(seen) > 2
    name = next(iter(store.sequences))
    with pytest.raises(DataError, match="was not encoded"):
        store.scene(name, 0)


class Halves(torch.nn.Module):
    """A frozen conditioning: the mean of each quarter of an image."""

    frozen = True

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.avg_pool2d(images, 8)


def test_features_are_given_as_they_were_stored_and_cannot_be_changed(tmp_path):
    root, out = sound_rooms(tmp_path / "root"), tmp_path / "cache"
    encode_training_set(FrameEncoder(small_autoreconstructor(), Halves()), rooms(root), out, progress=False)
    from_images, cached = rooms(root).train_dataloader(), rooms(root, latent_cache=str(out)).train_dataloader()
    expected = Halves()(from_images.dataset[0, 1].scenes.reference.images)
    torch.testing.assert_close(cached.dataset[0, 1].scenes.condition, expected)
    for changes in (
        {"color_jitter": dict.fromkeys(STRENGTHS, 0.1)},
        {"horizontal_flip": True},
        {"random_background": 0.5},
    ):
        with pytest.raises(CompleteSplatError, match=r"data\.color_jitter=null"):
            rooms(root, latent_cache=str(out), **changes)
    masked = rooms(root, latent_cache=str(out), box_masks=BOXES)
    with pytest.raises(CompleteSplatError, match=r"data\.box_masks cannot"):
        masked.setup("fit")


def test_encodings_of_other_data_are_refused_before_training(cache, root, tmp_path):
    other, raw = rooms(sound_rooms(tmp_path / "other"), latent_cache=str(cache)), root.with_name("raw")
    with pytest.raises(DataError, match="made from other data"):
        other.setup("fit")
    with pytest.raises(DataError, match=r"crop=center \(asked for: principal\), image_size=16 \(asked for: 8\)"):
        rooms(raw, latent_cache=str(cache), image_size=8, crop="principal").setup("fit")
    rooms(root, latent_cache=str(cache)).setup("fit")
    # Testing needs no encodings.
    rooms(root, latent_cache=str(tmp_path / "gone")).setup("test")
    with pytest.raises(DataError, match="no finished latent cache"):
        rooms(root, latent_cache=str(tmp_path / "gone")).setup("fit")


@pytest.fixture
def copy(cache, tmp_path) -> Path:
    return Path(shutil.copytree(cache, tmp_path / "copy"))


def test_every_changed_byte_of_every_file_is_refused_or_changes_nothing(copy):
    values = read_latents(copy)
    chance = random.Random(0)
    noticed = dict.fromkeys(copy.iterdir(), 0)
    for path in noticed:
        content = path.read_bytes()
        for place in [*chance.sample(range(len(content)), 60), len(content) - 2]:
            flip_bit(path, 8 * place)
            try:
                assert read_latents(copy) == values
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
    flip_bit(path, 8 * place)
    store = LatentCache(copy)
    with pytest.raises(DataError, match="its checksum is another") as caught:
        store.scene("c2", 3)
    assert (caught.value.sequence, caught.value.frame) == ("c2", 3)
    assert store.scene("c2", 2).names == "c2"


def test_a_store_goes_to_other_processes_without_its_values(cache):
    store = LatentCache(cache)
    again = pickle.loads(pickle.dumps(store))
    assert len(pickle.dumps(store)) < 1000
    assert again.manifest == store.manifest
