"""Image files that must not reach a batch: each is refused with a `DataError` of one line that names the file."""

import struct
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from bad_images import BAD_DEPTHS, BAD_IMAGES, RGB, cut, saved
from PIL import ImageFile

from completesplat.data.pictures.files import decode, read_depth
from completesplat.data.validation import BadPicture, MissingFile
from completesplat.errors import DataError


def refuse(read: Callable[[], object], name: str, part: str, kind: type[DataError] = BadPicture) -> None:
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        with pytest.raises(DataError) as caught:
            read()
    assert not warned
    assert type(caught.value) is kind
    assert (caught.value.file, caught.value.sequence, caught.value.frame) == (name, None, None)
    assert part in caught.value.reason
    assert str(caught.value) == f"{name}: {caught.value.reason}"
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", BAD_IMAGES)
def test_a_bad_image_is_refused_by_name(name, tmp_path):
    """Seen to fail without their guards: `png_of_another_checksum` (`verify`), `animated_*` (`n_frames`), `one_trans*`
    (alpha), `coloured_mask` (equal channels), `integer_tiff` (modes), `bomb_of_51_megapixels` (`check_pixels`), `gif`
    (formats), `other_size` and `annotated_before_rotation_*` (the size check), and `empty`.
    """
    make, mode, part = BAD_IMAGES[name]
    path = tmp_path / f"{name}.jpg"
    path.write_bytes(make())
    refuse(lambda: decode(path, str(path), mode, (24, 32)), str(path), part)
    refuse(lambda: decode(make(), "frame 7 of x", mode, (24, 32)), "frame 7 of x", part)


def test_places_without_a_file_are_refused(tmp_path):
    (tmp_path / "ring.png").symlink_to("ring.png")
    for place in (tmp_path / "none.png", tmp_path, tmp_path / "ring.png", tmp_path / ("n" * 300)):
        refuse(lambda place=place: decode(place, str(place), "RGB"), str(place), "no such file", MissingFile)


def test_a_file_of_too_many_bytes_is_refused_before_it_is_read(tmp_path, monkeypatch):
    with (tmp_path / "sparse.png").open("wb") as file:
        file.truncate(10**12)
    refuse(lambda: decode(tmp_path / "sparse.png", "sparse", "RGB"), "sparse", "bytes")
    refuse(lambda: decode(saved(RGB, "PNG"), "bytes", "RGB", most_bytes=100), "bytes", "100 bytes")


@pytest.mark.parametrize("error", [MemoryError(), RecursionError("deep"), KeyError("x"), struct.error("short")])
def test_whatever_a_decoder_raises_is_a_data_error(monkeypatch, error):
    def fail(self):
        raise error

    monkeypatch.setattr(ImageFile.ImageFile, "load", fail)
    refuse(lambda: decode(saved(RGB, "BMP"), "name", "RGB"), "name", "cannot be decoded")


@pytest.mark.parametrize("name", ["bomb_of_51_megapixels", "bomb_of_144_megapixels", "bmp_of_a_huge_header"])
def test_bombs_are_refused_before_they_are_decoded(name, monkeypatch):
    monkeypatch.setattr(ImageFile.ImageFile, "load", lambda self: pytest.fail("decoded"))
    refuse(lambda: decode(BAD_IMAGES[name][0](), name, "RGB"), name, "pixels")


def test_a_process_that_lets_truncated_files_pass_is_refused(monkeypatch):
    monkeypatch.setattr(ImageFile, "LOAD_TRUNCATED_IMAGES", True)
    refuse(lambda: decode(cut(saved(RGB, "PNG")), "name", "RGB"), "name", "LOAD_TRUNCATED_IMAGES")


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF", "BMP"])
def test_random_damage_gives_a_picture_or_a_data_error(kind):
    rng, good = np.random.default_rng(0), saved(RGB, kind)
    for _ in range(60):
        content = bytearray(good)
        for position in rng.integers(0, len(content), 4):
            content[position] = rng.integers(256)
        with suppress(DataError):
            assert decode(bytes(content), kind, "RGB", (24, 32)).size == (32, 24)


def test_no_flipped_bit_changes_the_pixels_of_a_png():
    """Checksums cover every chunk; flips in the last one, which is empty, may pass."""
    good = saved(RGB[:8, :8], "PNG", compress_level=0)
    for bit in range(0, 8 * len(good), 3):
        content = bytearray(good)
        content[bit // 8] ^= 1 << bit % 8
        try:
            image = decode(bytes(content), "flipped", "RGB", (8, 8))
        except DataError:
            continue
        assert np.array_equal(np.asarray(image), RGB[:8, :8])


@pytest.mark.parametrize("name", BAD_DEPTHS)
def test_a_bad_depth_map_is_refused_by_name(name, tmp_path: Path):
    make, scale, part = BAD_DEPTHS[name]
    path = tmp_path / f"{name}.png"
    path.write_bytes(make())
    refuse(lambda: read_depth(path, scale), str(path), part)
