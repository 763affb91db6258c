"""Features of images, which tell photographs from toy objects, and what data know of their own."""

from pathlib import Path

import pytest
import skimage
import torch

from completesplat.data.toy.module import ToyObjectsDataModule
from completesplat.photo.features import image_features
from completesplat.photo.reading import Framing, read_square


def test_features_are_colours_their_spread_and_how_fine_they_are():
    image = torch.zeros(3, 4, 4)
    image[0], image[1, :, 2:], image[2, 1::2] = 0.25, 1, 1
    expected = [0.25, 0.5, 0.5, 0, 0.5, 0.5, 1 / 9, 1 / 3]  # green has one step in three, blue three of three
    torch.testing.assert_close(image_features(image), torch.tensor(expected))
    assert image_features(image.expand(2, 3, 4, 4)).shape == (2, 8)


def test_data_say_what_weights_are_to_know_of_them(toy_root):
    toys = ToyObjectsDataModule(str(toy_root), scenes=4, frames=4, image_size=32, box_masks={"probability": 0.25})
    facts = toys.training_facts()
    assert (facts["box_masks"], facts["depth_before"], facts["depth_after"]) == (0.25, 1.0, 4.0)
    store = toys.store("train")
    sequences = [toys.source("train").read(name) for name in store.names]
    photos = torch.stack([store.image(s, frame) for s in sequences for frame in range(4)]).double() / 255
    features = image_features(photos)
    assert facts["picture_mean"] == pytest.approx(features.mean(0).tolist())
    assert facts["picture_std"] == pytest.approx(features.std(0, correction=0).clamp(min=1e-3).tolist())


@pytest.mark.slow
def test_photographs_lie_far_from_toy_objects_and_other_toy_objects_near(tmp_path):
    """None of 60 unseen toy objects is called far, and every photograph is."""
    size = {"scenes": 200, "frames": 4, "image_size": 64, "make": True}
    toys = ToyObjectsDataModule(str(tmp_path), **size)
    toys.prepare_data()
    facts, store = toys.training_facts(), toys.store("test")
    mean, deviation = (torch.tensor(facts[name]) for name in ("picture_mean", "picture_std"))
    own = torch.stack([store.image(store.source.read(name), 0) for name in store.names]).float() / 255
    folder = Path(skimage.__file__).parent / "data"
    names = [f"{name}.png" for name in ("astronaut", "chelsea", "coffee", "motorcycle_left", "camera")]
    names += ["rocket.jpg", "retina.jpg"]
    photographs = torch.stack([read_square(folder / name, Framing(64)).image for name in names])
    features = map(image_features, (own, photographs))
    near, far = (((feature - mean) / deviation).square().mean(-1).sqrt() for feature in features)
    assert near.max() < 2 < far.min()
