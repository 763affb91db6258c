"""The pictures of a capture: whole, as their cameras saw them, transparency told apart from colour."""

from pathlib import Path
from typing import NamedTuple

from PIL import Image

from completesplat.data.checks import BadPicture, require_file
from completesplat.data.exif import ORIENTATION, read_exif
from completesplat.data.images import EIGHT_BIT_MODES, FORMATS, MOST_PIXELS, check_pixels, damage_refused, decode
from completesplat.errors import ImageError

PNG_BIT_DEPTH = 24  # byte of the file


class CapturedPicture(NamedTuple):
    """A decoded picture.

    Attributes:
        image: RGB; transparency is laid over white.
        alpha: its opacity (grey), if it has transparency data.
        lossy: it was a JPEG.
        plain: the file is a JPEG or PNG of just these 8-bit RGB pixels.
    """

    image: Image.Image
    alpha: Image.Image | None
    lossy: bool
    plain: bool


def read_picture(path: Path, image_size: tuple[int, int]) -> CapturedPicture:
    """Decode a picture of (height, width). Alpha is straight and mixed in sRGB, as in the pictures of NeRF (synthetic).

    Raises:
        MissingFile: no such file.
        BadPicture: damaged, too large, of another size, or to be turned by its EXIF orientation: the programs that
            estimate poses look at the pixels as they are stored, so that pose and upright picture do not agree.
    """
    require_file(path)
    try:
        with damage_refused(FORMATS, MOST_PIXELS), Image.open(path, formats=FORMATS) as picture:
            check_pixels(picture, MOST_PIXELS)
            orientations = {read_exif(picture).get(ORIENTATION)}  # A TIFF loses its own when it is decoded.
            if picture.format == "PNG":
                _check_sums(path)
            picture.load()
            orientations.add(read_exif(picture).get(ORIENTATION))
            if turned := orientations - {None, 0, 1}:
                raise ImageError(
                    f"is to be turned (EXIF orientation {turned.pop()}), its camera's pose is not: save the pixels "
                    "as the pose sees them, without that tag"
                )
            lossy, plain = picture.format in ("JPEG", "MPO"), _is_plain(path, picture)
            if picture.has_transparency_data and picture.mode in EIGHT_BIT_MODES:
                _check_size(picture.size, image_size)
                return CapturedPicture(*_over_white(picture.convert("RGBA")), lossy, plain=False)
    except ImageError as error:
        raise BadPicture(str(error), str(path)) from error.__cause__
    return CapturedPicture(decode(path, str(path), "RGB", image_size), None, lossy, plain)


def picture_size(path: Path) -> tuple[int, int]:
    """(height, width) of a picture file, by its header.

    Raises:
        MissingFile: no such file.
        BadPicture: no picture.
    """
    try:
        with damage_refused(FORMATS, MOST_PIXELS), Image.open(require_file(path), formats=FORMATS) as picture:
            return picture.height, picture.width
    except ImageError as error:
        raise BadPicture(str(error), str(path)) from error.__cause__


def _over_white(picture: Image.Image) -> tuple[Image.Image, Image.Image]:
    white = Image.new("RGBA", picture.size, "white")
    return Image.alpha_composite(white, picture).convert("RGB"), picture.getchannel("A")


def _check_sums(path: Path) -> None:
    with Image.open(path, formats=FORMATS) as again:
        again.verify()


def _check_size(size: tuple[int, int], image_size: tuple[int, int]) -> None:
    if size != image_size[::-1]:
        raise ImageError(f"has {size[1]} x {size[0]} pixels, its annotation says {image_size[0]} x {image_size[1]}")


def _is_plain(path: Path, picture: Image.Image) -> bool:
    if picture.mode != "RGB" or picture.format not in ("JPEG", "PNG") or picture.has_transparency_data:
        return False
    with path.open("rb") as file:
        return picture.format == "JPEG" or file.read(PNG_BIT_DEPTH + 1)[-1] == 8
