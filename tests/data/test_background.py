"""Objects cut out of their background by a stand-in for rembg, hidden parts, and what tells images of a kind apart."""

import math
import sys
from functools import partial
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import skimage
import torch
from PIL import Image
from support import exif_turned

from completesplat.data.images.photograph import (
    by_grabcut,
    image_features,
    outside_of_box,
    outside_of_mask,
    read_photograph,
    without_background,
)
from completesplat.data.toy.module import ToyObjectsDataModule
from completesplat.errors import CompleteSplatError, ImageError


def photo(path: Path, background: str = "red") -> Path:
    """A blue square in the upper left quarter of what EXIF says is upside down."""
    image = Image.new("RGB", (32, 32), background)
    image.paste("blue", (0, 0, 16, 16))
    image.save(path, exif=exif_turned(3))
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


def test_a_network_that_rembg_has_is_taken_and_the_best_first(rembg, tmp_path, monkeypatch):
    monkeypatch.setenv("U2NET_HOME", str(tmp_path))
    for name in ("u2netp", "isnet-general-use"):
        (tmp_path / f"{name}.onnx").touch()
        read_photograph(photo(tmp_path / "a.png"), 16, remove_background=True)
    assert rembg.sessions == ["u2netp", "isnet-general-use"]


def test_the_object_is_sought_in_all_of_the_image_and_fills_its_share_of_the_square(rembg, tmp_path):
    image = Image.new("RGB", (64, 32), "red")
    image.paste("blue", (2, 4, 14, 10))  # left of the central square
    image.save(tmp_path / "a.png")
    result = read_photograph(tmp_path / "a.png", 24, remove_background=True, background=0.0, object_share=0.5).image
    expected = torch.zeros(3, 24, 24)
    expected[2, 9:15, 6:18] = 1
    assert torch.equal(result, expected)


@pytest.mark.parametrize(("fov", "source"), [(40.0, "given"), (None, "default")])
def test_the_central_square_grows_until_it_holds_the_whole_object_and_its_field_of_view_with_it(rembg, fov, source):
    image = Image.new("RGB", (32, 64), "red")
    image.paste("blue", (10, 4, 22, 58))  # a bottle, from 28 above the middle to 26 below
    photo = read_photograph(image, 28, fov, 40.0, remove_background=True, whole_object=True)
    expected = torch.ones(3, 56, 56)
    expected[:2, :54, 22:34] = 0
    assert torch.allclose(photo.image, expected.unflatten(2, (28, 2)).mean(3).unflatten(1, (28, 2)).mean(2), atol=0.2)
    grown = math.degrees(2 * math.atan(56 / 32 * math.tan(math.radians(40) / 2)))
    assert (photo.crop, photo.fov_source) == ("object", source)
    assert photo.fov_degrees == pytest.approx(grown if source == "given" else 40)
    inside = Image.new("RGB", (32, 64), "red")
    inside.paste("blue", (10, 20, 22, 40))
    photo = read_photograph(inside, 32, fov, 40.0, remove_background=True, whole_object=True)
    assert (photo.crop, photo.fov_degrees) == ("center", 40)


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
    monkeypatch.setattr(rembg, "new_session", Mock(side_effect=OSError("no route to host\nand more")))
    with caplog.at_level("INFO"):
        read_photograph(tmp_path / "a.png", 16, remove_background=True)
    assert "rembg fails with its network u2net (no route to host)\n" in caplog.text
    assert "removed roughly, from colours (GrabCut)" in caplog.text
    for name in ("rembg", "cv2"):
        monkeypatch.setitem(sys.modules, name, None)
    advice = r'needs rembg or OpenCV: .* "completesplat\[background\]", or .*grabcut'
    with pytest.raises(CompleteSplatError, match=advice):
        read_photograph(tmp_path / "a.png", 16, remove_background=True)


def test_without_rembg_grabcut_keeps_the_largest_piece_that_differs_from_the_border(tmp_path, monkeypatch, caplog):
    pytest.importorskip("cv2")
    monkeypatch.setitem(sys.modules, "rembg", None)
    rows, columns = np.mgrid[:90, :120]
    object_mask = ((columns - 55) / 40) ** 2 + ((rows - 45) / 30) ** 2 < 1
    speck = (columns > 105) & (columns < 112) & (abs(rows - 12) < 4)
    pixels = np.where((object_mask | speck)[..., None], [200, 90, 30], [60, 110, 160])
    noisy = Image.fromarray(np.random.default_rng(0).normal(pixels, 20).clip(0, 255).astype(np.uint8))
    with caplog.at_level("INFO"):
        alpha = np.array(without_background(noisy).getchannel("A")) > 127
    assert (alpha & object_mask).sum() > 0.97 * (alpha | object_mask).sum()
    assert not alpha[speck].any()
    assert "removed roughly, from colours (GrabCut)" in caplog.text
    assert "rembg is better" in caplog.text
    with pytest.raises(ImageError, match="no object is found"):
        without_background(Image.new("RGB", (3000, 8), "red"))


def test_grabcut_takes_the_object_in_the_middle_not_a_larger_thing_beside_it():
    pytest.importorskip("cv2")
    rows, columns = np.mgrid[:96, :128]
    object_mask = np.hypot(rows - 50, columns - 66) < 17
    pixels = np.where(rows[..., None] < 40, [60, 110, 160], [120, 100, 80])  # wall and floor
    pixels[8:88, 5:21] = [40, 140, 60]
    pixels[object_mask] = [200, 60, 40]
    noisy = np.random.default_rng(0).normal(pixels, 10).clip(0, 255).astype(np.uint8)
    alpha = np.array(by_grabcut(Image.fromarray(noisy)).getchannel("A")) > 127
    assert (alpha & object_mask).sum() > 0.97 * (alpha | object_mask).sum()


SHIPPED = (0.25, 0.5, 0.75, 1.0)


@pytest.fixture
def photos(tmp_path):
    """Two photographs (width, height) that differ in a box of their central square, and a mask of that box."""

    def write(width: int, height: int) -> tuple[Path, Path, Path]:
        rng = np.random.default_rng(0)
        first, second = (rng.integers(0, 256, (height, width, 3), dtype=np.uint8) for _ in range(2))
        side = min(width, height)
        left, top = (width - side) // 2, (height - side) // 2
        inside = np.zeros((height, width), dtype=bool)
        x0, y0, x1, y1 = (round(edge * side) for edge in SHIPPED)
        inside[top + y0 : top + y1, left + x0 : left + x1] = True
        second[~inside] = first[~inside]
        paths = tuple(tmp_path / f"{name}.png" for name in ("first", "second", "mask"))
        for path, pixels in zip(paths, (first, second, np.uint8(255) * inside), strict=True):
            Image.fromarray(pixels).save(path)
        return paths

    return write


@pytest.mark.parametrize("form", ["box", "mask"])
@pytest.mark.parametrize("size", [(32, 32), (100, 80), (61, 97), (20, 24)])
def test_no_visible_pixel_holds_anything_hidden(photos, size, form):
    first, second, mask = photos(*size)
    visible = outside_of_box(first, SHIPPED, 32) if form == "box" else outside_of_mask(first, mask, 32)
    images = [read_photograph(path, 32).image for path in (first, second)]
    assert torch.equal(images[0] * visible, images[1] * visible)
    assert not torch.equal(images[0], images[1])
    assert visible.unique().tolist() == [0, 1]


def test_an_image_of_the_right_size_is_hidden_to_the_pixel_and_others_three_pixels_more_at_most(photos):
    expected, grown = torch.ones(2, 1, 32, 32)
    expected[:, 16:, 8:24] = 0
    grown[:, 13:, 5:27] = 0
    first, _, mask = photos(32, 32)
    assert torch.equal(outside_of_box(first, SHIPPED, 32), expected)
    assert torch.equal(outside_of_mask(first, mask, 32), expected)
    white = Image.new("LA", (32, 32), (255, 0))  # as a paint program saves white strokes
    white.putalpha(Image.open(mask).convert("L"))
    white.save(mask)
    assert torch.equal(outside_of_mask(first, mask, 32), expected)
    assert torch.equal(outside_of_box(photos(640, 640)[0], SHIPPED, 32), grown)


def test_boxes_and_masks_that_are_none_are_refused(photos, tmp_path):
    first = photos(32, 32)[0]
    for box in ((0, 0, 1), (0, 0, 0, 1), (0.5, 0, 0.4, 1), (-0.1, 0, 1, 1), (0, 0, 1, 1.1)):
        with pytest.raises(CompleteSplatError, match="box="):
            outside_of_box(first, box, 32)
    Image.new("L", (32, 32)).save(tmp_path / "black.png")
    Image.new("L", (32, 32), 255).save(tmp_path / "white.png")
    Image.new("L", (32, 64), 255).save(tmp_path / "tall.png")
    for hide in (partial(outside_of_mask, mask=tmp_path / "white.png"), partial(outside_of_box, box=(0, 0, 1, 1))):
        with pytest.raises(CompleteSplatError, match="the whole photo is hidden"):
            hide(first, size=32)
    with pytest.raises(CompleteSplatError, match=r"tall.png: 32 x 64 pixels, another shape than the photo's"):
        outside_of_mask(first, tmp_path / "tall.png", 32)
    with pytest.raises(CompleteSplatError, match=r"black.png: hides nothing"):
        outside_of_mask(first, tmp_path / "black.png", 32)
    with pytest.raises(ImageError, match=r"nowhere.png: no such file"):
        outside_of_mask(first, tmp_path / "nowhere.png", 32)


def test_features_are_colours_their_spread_and_how_fine_they_are():
    image = torch.zeros(3, 4, 4)
    image[0], image[1, :, 2:], image[2, 1::2] = 0.25, 1, 1
    expected = [0.25, 0.5, 0.5, 0, 0.5, 0.5, 1 / 9, 1 / 3]  # green has one step in three, blue three of three
    torch.testing.assert_close(image_features(image), torch.tensor(expected))
    assert image_features(image.expand(2, 3, 4, 4)).shape == (2, 8)


def test_data_say_what_weights_are_to_know_of_them(toy_root):
    toys = ToyObjectsDataModule(str(toy_root), scenes=4, frames=4, image_size=32, box_masks={"probability": 0.25})
    facts = toys.training_facts()
    assert (facts["box_masks"], facts["depth_before"]) == (0.25, 1.0)
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
    photographs = torch.stack([read_photograph(folder / name, 64).image for name in names])
    features = map(image_features, (own, photographs))
    near, far = (((feature - mean) / deviation).square().mean(-1).sqrt() for feature in features)
    assert near.max() < 2 < far.min()
