"""Objects cut out of their background, by a stand-in for rembg; what tells images of one kind from others."""

import sys
from pathlib import Path

import numpy as np
import pytest
import skimage
import torch
from PIL import Image

from completesplat.data.images.photograph import image_features, read_photograph, without_background
from completesplat.data.toy.module import ToyObjectsDataModule
from completesplat.errors import CompleteSplatError, ImageError


def photo(path: Path, background: str = "red") -> Path:
    """A blue square in the upper left quarter of what EXIF says is upside down."""
    image = Image.new("RGB", (32, 32), background)
    image.paste("blue", (0, 0, 16, 16))
    exif = Image.Exif()
    exif[274] = 3
    image.save(path, exif=exif)
    return path


def test_the_object_stands_on_white_the_right_way_up(rembg, tmp_path):
    result = read_photograph(photo(tmp_path / "a.png"), 32, remove_background=True).image
    expected = torch.ones(3, 32, 32)
    expected[:2, 16:, 16:] = 0
    assert torch.equal(result, expected)
    read_photograph(tmp_path / "a.png", 16, remove_background=True)
    assert rembg.sessions == ["u2net"]  # loaded once, and not rembg's own choice
    assert read_photograph(tmp_path / "a.png", 32).image[0, 0, 0] == 1
    assert read_photograph(tmp_path / "a.png", 32).image[1, 0, 0] == 0


def test_the_object_is_sought_in_all_of_the_image_and_fills_its_share_of_the_square(rembg, tmp_path):
    image = Image.new("RGB", (64, 32), "red")
    image.paste("blue", (2, 4, 14, 10))  # left of the central square
    image.save(tmp_path / "a.png")
    with pytest.raises(ImageError, match="leaves nothing"):
        read_photograph(tmp_path / "a.png", 24, remove_background=True)
    result = read_photograph(tmp_path / "a.png", 24, remove_background=True, background=0.0, object_share=0.5).image
    expected = torch.zeros(3, 24, 24)
    expected[2, 9:15, 6:18] = 1
    assert torch.equal(result, expected)


def test_an_object_as_long_as_an_image_may_be_is_reduced_before_its_square_is_made(tmp_path):
    Image.new("RGBA", (100_000, 8), (0, 0, 255, 254)).save(tmp_path / "a.png")
    result = read_photograph(tmp_path / "a.png", 16, object_share=1.0).image
    assert result[0, 0].min() > 0.9  # white above the line
    deep = Image.fromarray(np.full((16, 16), 40_000, np.uint16))
    deep.save(tmp_path / "deep.png", transparency=40_000)
    assert read_photograph(tmp_path / "deep.png", 16, object_share=0.5).image.min() == 1


def test_without_rembg_or_its_network_it_is_said_what_to_do(rembg, tmp_path, monkeypatch, caplog):
    pytest.importorskip("cv2")
    photo(tmp_path / "a.png")

    def offline(name):
        raise OSError("no route to host\nand more")

    monkeypatch.setattr(rembg, "new_session", offline)
    with caplog.at_level("INFO"):
        read_photograph(tmp_path / "a.png", 16, remove_background=True)
    assert "rembg fails with its network u2net (no route to host)\n" in caplog.text
    assert "removed by GrabCut" in caplog.text
    for name in ("rembg", "cv2"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(
        CompleteSplatError, match=r'needs rembg or OpenCV: .* "completesplat\[background\]", or .*grabcut'
    ):
        read_photograph(tmp_path / "a.png", 16, remove_background=True)


def test_without_rembg_grabcut_keeps_the_largest_piece_that_differs_from_the_border(tmp_path, monkeypatch, caplog):
    pytest.importorskip("cv2")
    monkeypatch.setitem(sys.modules, "rembg", None)
    rows, columns = np.mgrid[:90, :120]
    object_mask = ((columns - 55) / 40) ** 2 + ((rows - 45) / 30) ** 2 < 1
    speck = (columns > 105) & (columns < 112) & (abs(rows - 12) < 4)
    pixels = np.where((object_mask | speck)[..., None], [200, 90, 30], [60, 110, 160])
    noisy = Image.fromarray(
        (pixels + np.random.default_rng(0).normal(0, 20, pixels.shape)).clip(0, 255).astype(np.uint8)
    )
    with caplog.at_level("INFO"):
        alpha = np.array(without_background(noisy).getchannel("A")) > 127
    assert (alpha & object_mask).sum() > 0.97 * (alpha | object_mask).sum()
    assert not alpha[speck].any()
    assert "removed by GrabCut" in caplog.text
    assert "rembg is better" in caplog.text
    thin = Image.new("RGB", (3000, 8), "red")
    with pytest.raises(ImageError, match="no object is found"):
        without_background(thin)


def test_features_are_colours_their_spread_and_how_fine_they_are():
    image = torch.zeros(3, 4, 4)
    image[0], image[1, :, 2:], image[2, 1::2] = 0.25, 1, 1
    expected = [0.25, 0.5, 0.5, 0, 0.5, 0.5, 1 / 9, 1 / 3]  # green has one step in three, blue three of three
    torch.testing.assert_close(image_features(image), torch.tensor(expected))
    assert image_features(image.expand(2, 3, 4, 4)).shape == (2, 8)


@pytest.fixture
def toys(toy_root):
    return ToyObjectsDataModule(str(toy_root), scenes=4, frames=4, image_size=32, box_masks={"probability": 0.25})


def test_data_say_what_weights_are_to_know_of_them(toys):
    facts = toys.training_facts()
    assert facts["box_masks"] == 0.25
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
    names = [
        "astronaut.png",
        "chelsea.png",
        "coffee.png",
        "motorcycle_left.png",
        "rocket.jpg",
        "retina.jpg",
        "camera.png",
    ]
    photographs = torch.stack([read_photograph(folder / name, 64).image for name in names])
    near, far = (
        ((image_features(images) - mean) / deviation).square().mean(-1).sqrt() for images in (own, photographs)
    )
    assert near.max() < 2 < far.min()
