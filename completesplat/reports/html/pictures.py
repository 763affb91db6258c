"""Pictures inside the page, as many as there is room for."""

import io
from base64 import b64encode
from pathlib import Path

from PIL import Image

from completesplat.reports.html.markup import Html, element, scrollable

WIDEST = 1600
"""Pixels; wider pictures are made smaller."""
MOST_PIXELS = 50_000_000
AS_THEY_ARE = 300_000
"""Bytes up to which a picture of that width is not encoded again."""
QUALITY = 85


class Room:
    """Room for pictures in one page.

    Args:
        megabytes: how much it holds; data URIs take four characters for three bytes.
    """

    def __init__(self, megabytes: float) -> None:
        self.left = megabytes * 1e6

    def uri(self, data: bytes, kind: str) -> str | None:
        """The data URI of a picture, or None where it does not fit any more."""
        uri = f"data:image/{kind};base64,{b64encode(data).decode()}"
        if len(uri) > self.left:
            return None
        self.left -= len(uri)
        return uri


def picture(path: Path, caption: str, room: Room) -> Html:
    """A figure with its caption, which is also what is read out; or why it is not shown."""
    try:
        data, kind, width, height = _encoded(path)
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        return element("p", f"{caption}: cannot be shown ({' '.join(str(error).split())})", class_="left-out")
    uri = room.uri(data, kind)
    if uri is None:
        return element("p", f"{caption}: left out, the page is full", class_="left-out")
    image = element("img", src=uri, alt=caption, width=width, height=height, loading="lazy")
    return element("figure", scrollable(caption, image), element("figcaption", caption), class_="picture")


def _encoded(path: Path) -> tuple[bytes, str, int, int]:
    """The file as it is if it is a small PNG, else a JPEG of it: bytes, kind, width and height."""
    data = path.read_bytes()
    with Image.open(io.BytesIO(data)) as image:
        width, height = image.size
        if width * height > MOST_PIXELS:
            raise ValueError(f"{width} x {height} pixels are too many")
        image.load()
        if image.format == "PNG" and len(data) <= AS_THEY_ARE and width <= WIDEST:
            return data, "png", width, height
        small = image.convert("RGBA")
    white = Image.new("RGBA", small.size, "white")
    white.alpha_composite(small)
    white.thumbnail((WIDEST, WIDEST * 4))
    return as_jpeg(white.convert("RGB")), "jpeg", *white.size


def as_jpeg(image: Image.Image) -> bytes:
    """A JPEG file."""
    file = io.BytesIO()
    image.save(file, "JPEG", quality=QUALITY, optimize=True)
    return file.getvalue()
