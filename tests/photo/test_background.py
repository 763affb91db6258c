"""Objects cut out of their background, by a stand-in for rembg or by GrabCut."""

import math
import re
import sys
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from PIL import Image
from support import exif_turned

from completesplat.errors import CompleteSplatError, ImageError
from completesplat.installation import install_command
from completesplat.photo.background import by_grabcut, without_background
from completesplat.photo.reading import Framing, read_square


def photo(path: Path, background: str = "red") -> Path:
    """A blue square in the upper left quarter of what EXIF says is upside down."""
    image = Image.new("RGB", (32, 32), background)
    image.paste("blue", (0, 0, 16, 16))
    image.save(path, exif=exif_turned(3))
    return path


def test_the_object_stands_on_white_the_right_way_up(rembg, tmp_path):
    result = read_square(photo(tmp_path / "a.png"), Framing(32), remove_background=True).image
    expected = torch.ones(3, 32, 32)
    expected[:2, 16:, 16:] = 0
    assert torch.equal(result, expected)
    read_square(tmp_path / "a.png", Framing(16), remove_background=True)
    assert rembg.sessions == ["u2net"]  # loaded once, and not rembg's own choice
    assert read_square(tmp_path / "a.png", Framing(32)).image[0, 0, 0] == 1
    assert read_square(tmp_path / "a.png", Framing(32)).image[1, 0, 0] == 0


def test_a_network_that_rembg_has_is_taken_and_the_best_first(rembg, tmp_path, monkeypatch):
    monkeypatch.setenv("U2NET_HOME", str(tmp_path))
    for name in ("u2netp", "isnet-general-use"):
        (tmp_path / f"{name}.onnx").touch()
        read_square(photo(tmp_path / "a.png"), Framing(16), remove_background=True)
    assert rembg.sessions == ["u2netp", "isnet-general-use"]


def test_the_object_is_sought_in_all_of_the_image_and_fills_its_share_of_the_square(rembg, tmp_path):
    image = Image.new("RGB", (64, 32), "red")
    image.paste("blue", (2, 4, 14, 10))  # left of the central square
    image.save(tmp_path / "a.png")
    framing = Framing(24, background=0.0, object_share=0.5)
    result = read_square(tmp_path / "a.png", framing, remove_background=True).image
    expected = torch.zeros(3, 24, 24)
    expected[2, 9:15, 6:18] = 1
    assert torch.equal(result, expected)


def test_a_given_square_is_where_the_object_is_sought(rembg):
    image = Image.new("RGB", (64, 32), "red")
    image.paste("blue", (2, 4, 14, 10))
    image.paste("blue", (40, 8, 56, 24))
    right = read_square(image, Framing(24, object_share=0.5), remove_background=True, crop=[0.5, 0, 1])
    assert right.window == (32, 0, 64, 32)
    assert right.image[0].min() == 0
    assert read_square(image, Framing(24, object_share=0.5), remove_background=True).window[2] > 64


@pytest.mark.parametrize(("fov", "source"), [(40.0, "given"), (None, "default")])
def test_the_central_square_grows_until_it_holds_the_whole_object_and_its_field_of_view_with_it(rembg, fov, source):
    image = Image.new("RGB", (32, 64), "red")
    image.paste("blue", (10, 4, 22, 58))  # a bottle, from 28 above the middle to 26 below
    across = None if fov is None else math.degrees(2 * math.atan(2 * math.tan(math.radians(fov) / 2)))
    photo = read_square(image, Framing(28, 40.0, whole_object=True), across, remove_background=True)
    expected = torch.ones(3, 56, 56)
    expected[:2, :54, 22:34] = 0
    assert torch.allclose(photo.image, expected.unflatten(2, (28, 2)).mean(3).unflatten(1, (28, 2)).mean(2), atol=0.2)
    grown = math.degrees(2 * math.atan(56 / 32 * math.tan(math.radians(40) / 2)))
    assert (photo.window, photo.fov_source) == ((-12, 4, 44, 60), source)
    assert photo.cut_out.mean() == pytest.approx(12 * 54 / 56**2, abs=0.01)
    assert photo.fov_degrees == pytest.approx(grown if source == "given" else 40)
    inside = Image.new("RGB", (32, 64), "red")
    inside.paste("blue", (10, 20, 22, 40))
    photo = read_square(inside, Framing(32, 40.0, whole_object=True), across, remove_background=True)
    assert (photo.window, photo.fov_degrees) == ((0, 16, 32, 48), pytest.approx(40))


def test_an_object_as_long_as_an_image_may_be_is_reduced_before_its_square_is_made(tmp_path):
    Image.new("RGBA", (100_000, 8), (0, 0, 255, 254)).save(tmp_path / "a.png")
    result = read_square(tmp_path / "a.png", Framing(16, object_share=1.0)).image
    assert result[0, 0].min() > 0.9  # white above the line
    deep = Image.fromarray(np.full((16, 16), 40_000, np.uint16))
    deep.save(tmp_path / "deep.png", transparency=40_000)
    assert read_square(tmp_path / "deep.png", Framing(16, object_share=0.5)).image.min() == 1


def test_without_rembg_or_its_network_it_is_said_what_to_do(rembg, tmp_path, monkeypatch, caplog):
    pytest.importorskip("cv2")
    photo(tmp_path / "a.png")
    monkeypatch.setattr(rembg, "new_session", Mock(side_effect=OSError("no route to host\nand more")))
    with caplog.at_level("INFO"):
        read_square(tmp_path / "a.png", Framing(16), remove_background=True)
    assert "rembg fails with its network u2net (no route to host)\n" in caplog.text
    assert "removed roughly, from colours (GrabCut)" in caplog.text
    for name in ("rembg", "cv2"):
        monkeypatch.setitem(sys.modules, name, None)
    advice = f"needs rembg or OpenCV: {install_command('background')}, or {install_command('grabcut')}"
    with pytest.raises(CompleteSplatError, match=re.escape(advice)):
        read_square(tmp_path / "a.png", Framing(16), remove_background=True)


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
