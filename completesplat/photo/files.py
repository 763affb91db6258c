"""Strict reader of untrusted image files: the result is complete, upright and has 8 bits, or the file is refused."""

import io
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

import numpy as np
import pi_heif
from PIL import Image, ImageCms, ImageFile, UnidentifiedImageError

from completesplat.errors import BadImage, ImageError, MissingFile
from completesplat.photo.exif import ORIENTATION, TRANSPOSITIONS, Tags, read_exif
from completesplat.wording import by_numbers

FORMATS = ("JPEG", "PNG", "WEBP", "TIFF", "BMP")
MOST_PIXELS = 64_000_000  # cameras of 61 million pixels are common
MOST_BYTES = 2**28
EIGHT_BIT_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr")
SIXTEEN_BIT_MODES = ("I;16", "I;16B", "I;16L")
TIFF_BITS = 258
TIFF_PHOTOMETRIC = 262
TRANSPARENT = "has transparent pixels; lay it over a background first"


def decode_image(
    source: Path | bytes,
    file: str,
    mode: Literal["RGB", "L"],
    image_size: tuple[int, int] | None = None,
    turn: bool = True,
    converts_profile: bool = False,
) -> Image.Image:
    """Decode one image of a data set to 8 bits, and turn it upright by its EXIF orientation, unless `turn` is false.

    Grey of 16 bits is scaled to 8. Transparent pixels are refused, because metrics depend on the background, which only
    the data set's maker can choose. Colour is refused for `mode` "L" (a mask), because its brightness is no
    probability. Of an
    MPO (a JPEG followed by previews) the first image is used; other files with several frames are refused. PNG's
    checksums are checked; flipped bits in a JPEG remain unnoticed.

    Args:
        source: the file, or its content.
        file: name for error messages.
        image_size: (height, width) that the upright image must have, if known.
        converts_profile: convert colours from an embedded profile to sRGB. By default it is ignored, as by the loaders
            behind all published numbers on CO3D, RealEstate10K and ShapeNet.

    Raises:
        MissingFile: the file does not exist.
        BadImage: it is too large, damaged, not a JPEG, PNG, WebP, TIFF or BMP, differs from the annotated size, or
            has pixels whose meaning in this mode is unclear.
    """
    with decoded(source, file, FORMATS) as (stored, exif):
        image = turn_upright(stored, exif.get(ORIENTATION)) if turn else stored
        if image_size is not None and image.size != image_size[::-1]:
            expected = f"its annotation says {image_size[0]} x {image_size[1]}"
            raise ImageError(f"has {image.height} x {image.width} pixels when upright, {expected}")
        if converts_profile and mode == "RGB" and image.mode in EIGHT_BIT_MODES:
            image = in_srgb(image)
        return _eight_bits(image, getattr(stored, "tag_v2", {}), mode)


@contextmanager
def decoded(source: Path | bytes, file: str, formats: tuple[str, ...]) -> Iterator[tuple[Image.Image, Tags]]:
    """Decode an image completely, as it is stored, and yield it with its EXIF tags.

    Raises:
        MissingFile: the file does not exist.
        BadImage: an ImageError was raised by decoding, or within the context.
    """
    with refused_as_bad(file):
        if ImageFile.LOAD_TRUNCATED_IMAGES:
            raise ImageError("Pillow is set to accept truncated files (ImageFile.LOAD_TRUNCATED_IMAGES); unset that")
        size = len(source) if isinstance(source, bytes) else _require(source).stat().st_size
        if size == 0:
            raise ImageError("the file is empty")
        if size > MOST_BYTES:
            raise ImageError(f"more than {MOST_BYTES:,} bytes")
        content = source if isinstance(source, bytes) else source.read_bytes()
        with open_image(content, formats) as image:
            frames = getattr(image, "n_frames", 1)
            if frames > 1 and image.format != "MPO":
                raise ImageError(f"has {frames} frames; one image is expected")
            image.load()
            check_sums(image, io.BytesIO(content))
            yield image, read_exif(image)


def stored_size(source: Path | bytes, file: str, formats: tuple[str, ...] = FORMATS) -> tuple[int, int]:
    """Return (height, width) of an image file or its content, from its header.

    Raises:
        MissingFile, BadImage: as in `decode_image`.
    """
    content = source if isinstance(source, bytes) else _require(source)
    with refused_as_bad(file), open_image(content, formats) as image:
        return image.height, image.width


def photo_formats(formats: tuple[str, ...] = FORMATS) -> tuple[str, ...]:
    """Return the formats of photos, with that of HEIC, whose reader is registered with Pillow."""
    pi_heif.register_heif_opener()
    return *formats, "HEIF"


def image_files(folder: Path, formats: Sequence[str] = FORMATS) -> list[Path]:
    """Return the files in a folder whose suffix is that of an image, `r_2` before `r_10`, without hidden ones."""
    suffixes = {suffix for suffix, kind in Image.registered_extensions().items() if kind in formats}
    images = (path for path in folder.glob("[!.]*") if path.suffix.lower() in suffixes and path.is_file())
    return sorted(images, key=by_numbers)


@contextmanager
def refused_as_bad(file: str) -> Iterator[None]:
    """Convert an ImageError raised within the context to a BadImage that names the file."""
    try:
        yield
    except ImageError as error:
        raise BadImage(str(error), file) from error.__cause__


@contextmanager
def open_image(source: str | Path | bytes, formats: tuple[str, ...]) -> Iterator[Image.Image]:
    """Open an image and read its header, but not its pixels.

    Pillow's exceptions within the context are converted, because decoding the pixels there may raise others.

    Raises:
        ImageError: the image is damaged, has another format, or has more than 64 million pixels.
    """
    # Pillow only warns about images between 89 and 179 million pixels; the limit here is lower and an error.
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(io.BytesIO(source) if isinstance(source, bytes) else source, formats=formats) as image:
                width, height = image.size
                if width * height > MOST_PIXELS:
                    raise ImageError(f"{width} x {height} are more than {MOST_PIXELS:,} pixels; make it smaller first")
                yield image
        except ImageError:
            raise
        except UnidentifiedImageError:
            raise ImageError(f"not an image in one of the formats {', '.join(formats)}") from None
        except Image.DecompressionBombError:
            raise ImageError(f"more than {MOST_PIXELS:,} pixels; make it smaller first") from None
        # On damaged files, Pillow's decoders raise almost any exception: OSError, SyntaxError, struct.error, ...
        except Exception as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ImageError(f"cannot be decoded: {reason}") from error


def check_sums(image: Image.Image, source: str | Path | io.BytesIO) -> None:
    """Check all checksums of a PNG file, because decoding ignores those of the pixels."""
    if image.format == "PNG":
        with Image.open(source, formats=("PNG",)) as again:
            again.verify()


def over_grey(image: Image.Image, value: float) -> Image.Image:
    """Composite an image over a grey value from 0 to 1 and return it in RGB."""
    grey = Image.new("RGBA", image.size, (round(255 * value),) * 3)
    return Image.alpha_composite(grey, image.convert("RGBA")).convert("RGB")


def in_srgb(image: Image.Image) -> Image.Image:
    """Return an image of 8 bits in RGB, or RGBA if it is transparent, converted from its embedded colour profile."""
    profile = image.info.get("icc_profile")
    transparent = image.has_transparency_data
    plain = image.convert("RGBA" if transparent else "RGB")
    converted = plain.convert("RGB")
    if profile:
        native = image if image.mode in ("L", "RGB", "CMYK") and not transparent else converted
        # Like image viewers, ignore a damaged profile, or one whose colour model differs from the pixels'.
        with suppress(ImageCms.PyCMSError, OSError):
            embedded = ImageCms.ImageCmsProfile(io.BytesIO(profile))
            result = ImageCms.profileToProfile(native, embedded, ImageCms.createProfile("sRGB"), outputMode="RGB")
            converted = native if result is None else result
    if transparent:
        converted.putalpha(plain.getchannel("A"))
    converted.info.pop("icc_profile", None)
    return converted


def turn_upright(image: Image.Image, orientation: object) -> Image.Image:
    """Turn and mirror an image by its EXIF orientation, unless that is undefined."""
    transposition = TRANSPOSITIONS.get(orientation) if isinstance(orientation, int) else None
    return image if transposition is None else image.transpose(transposition)


def deep_grey(image: Image.Image, tiff_tags: Mapping[int, object]) -> np.ndarray:
    """Convert grey values of more than 8 bits to float32 in [0, 1]. Pillow's own conversion would clip them at 255.

    The TIFF tags come from the opened file, because images derived from it have none; they are empty for other formats.

    Raises:
        ImageError: values lie outside the range from black to white.
    """
    bits = tiff_tags.get(TIFF_BITS, (16,))
    values = np.asarray(image).astype(np.float64)
    if image.mode != "F":
        # Pillow does not scale 12-bit TIFF values; all other images of these modes use 16 bits.
        values = values / (4095 if bits == (12,) else 65535)
    # The comparison is false for NaN too.
    if not ((values >= 0) & (values <= 1)).all():
        raise ImageError(f"grey values of mode {image.mode} outside the range from black to white, or not finite")
    if tiff_tags.get(TIFF_PHOTOMETRIC) == 0:
        values = 1 - values  # "white is zero", which Pillow inverts for 8 bits only
    if isinstance(image.info.get("transparency"), int):
        values[np.asarray(image) == image.info["transparency"]] = 1
    return values.astype(np.float32)


def _require(path: Path) -> Path:
    # `Path.is_file` raises if a name is too long or a folder may not be entered.
    if not os.path.isfile(path):
        raise MissingFile("no such file", str(path))
    return path


def _eight_bits(image: Image.Image, tiff_tags: Mapping[int, object], mode: Literal["RGB", "L"]) -> Image.Image:
    if image.mode in SIXTEEN_BIT_MODES:
        if (np.asarray(image) == image.info.get("transparency")).any():
            raise ImageError(TRANSPARENT)
        image = Image.fromarray(np.rint(255 * deep_grey(image, tiff_tags)).astype(np.uint8))
    if image.mode not in EIGHT_BIT_MODES:
        raise ImageError(f"colour mode {image.mode} is not supported")
    if image.has_transparency_data:
        image = image.convert("RGBA")
        if image.getchannel("A").getextrema() != (255, 255):
            raise ImageError(TRANSPARENT)
    if mode == "L" and image.mode == "L" and image.getextrema()[1] == 1:
        raise ImageError("a mask has values from 0 to 255, not 0 and 1")
    if mode == "L" and image.mode not in ("1", "L"):
        return _grey_channel(image)
    return image.convert(mode)


def _grey_channel(image: Image.Image) -> Image.Image:
    """Return one of the three equal channels of a grey image, or raise ImageError if it has colours."""
    red, green, blue = image.convert("RGB").split()
    if red.tobytes() != green.tobytes() or red.tobytes() != blue.tobytes():
        raise ImageError("has colours; a mask is grey")
    return red
