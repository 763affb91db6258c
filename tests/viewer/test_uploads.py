import io

import numpy as np
import pytest
from PIL import Image
from support import tiny_generator

from completesplat.errors import ImageError
from completesplat.viewer import completion
from completesplat.viewer.completion import read_upload


@pytest.fixture(scope="module")
def model():
    return tiny_generator()


def png(width: int, height: int, mode: str = "RGB") -> bytes:
    buffer = io.BytesIO()
    Image.new(mode, (width, height), 200 if mode in ("1", "L") else (200, 100, 50)).save(buffer, "PNG")
    return buffer.getvalue()


def test_a_picture_is_read_at_the_models_size(model):
    photograph = read_upload(model, "a.png", png(50, 40))
    assert photograph.image.shape == (3, 32, 32)
    assert photograph.image[:, 5, 5].numpy() == pytest.approx(np.array([200, 100, 50]) / 255, abs=1e-6)


@pytest.mark.parametrize("content", [b"", b"%PDF-1.7", b"<svg></svg>", png(50, 40)[:60]])
def test_what_is_no_whole_picture_is_refused_by_its_name(model, content):
    with pytest.raises(ImageError, match=r"^notes\.txt: "):
        read_upload(model, "notes.txt", content)


def test_too_many_pixels_are_refused(model):
    """8000 x 8000 black pixels are a file of some kilobytes."""
    with pytest.raises(ImageError, match=r"64,000,000|8000 x 8000"):
        read_upload(model, "bomb.png", png(8000, 8000, "1"))


def test_too_many_bytes_are_refused_before_they_are_read(model, monkeypatch):
    monkeypatch.setattr(completion, "MOST_BYTES", 2**20)
    with pytest.raises(ImageError, match=r"^big\.png: 2 MiB; at most 1 MiB"):
        read_upload(model, "big.png", png(50, 40) + bytes(2**21))


def test_a_name_is_no_path_and_no_markup(model):
    with pytest.raises(ImageError) as caught:
        read_upload(model, "../../\n\x1betc/passwd", b"nothing")
    assert str(caught.value).startswith("../../??etc/passwd: not an image")
