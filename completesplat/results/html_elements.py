"""The parts of the page: HTML elements, pictures, samples that turn."""

import io
from base64 import b64encode
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

EMPTY = {"img", "meta", "link", "br"}
"""Elements that have no end tag."""

WIDEST, MOST_PIXELS = 1600, 50_000_000
"""Pixels of the widest picture shown, wider ones are made smaller; and of the largest read."""
AS_THEY_ARE, QUALITY = 300_000, 85
"""Bytes up to which a picture of that width is not encoded again; and quality of JPEG."""
SIDE, LONGEST = 256, 60_000
"""Pixels of a frame's longer side; and of the widest strip of frames (JPEG ends at 65,535)."""


class Html(str):
    """Text that is HTML. Everything else is plain text, whatever characters it holds."""


def element(name: str, /, *children: str, **attributes: str | int | bool) -> Html:
    """`<name attribute="value">children</name>`; children are elements, or plain text.

    Attributes are `class_` for `class`, `aria_label` for `aria-label`; True for one without a value, False for none.
    """
    given = [(key.rstrip("_").replace("_", "-"), value) for key, value in attributes.items() if value is not False]
    opened = "".join(f" {key}" if value is True else f' {key}="{escape(str(value))}"' for key, value in given)
    if name in EMPTY:
        return Html(f"<{name}{opened}>")
    return Html(f"<{name}{opened}>{joined(*children)}</{name}>")


def joined(*children: str) -> Html:
    """Elements and plain text, one after the other."""
    return Html("".join(child if isinstance(child, Html) else escape(child) for child in children))


def scrollable(name: str, *children: str) -> Html:
    """A box that scrolls sideways by itself, also by keyboard; `name` says what it holds to those who do not see it."""
    return element("div", *children, class_="scroll", tabindex="0", role="region", aria_label=name)


def folded(summary: str, *children: str, open_: bool = False) -> Html:
    """A part that is shown when its summary is clicked."""
    return element("details", element("summary", summary), *children, open=open_)


def described(pairs: dict[str, str]) -> Html:
    """Names and values, as a list; what is empty is left out."""
    parts = [element("div", element("dt", name), element("dd", value)) for name, value in pairs.items() if value]
    return element("dl", *parts)


def left_out(text: str) -> Html:
    """A line on what is not shown."""
    return element("p", text, class_="left-out")


class ByteBudget:
    """The bytes that pictures may take in one page; data URIs take four characters for three bytes."""

    def __init__(self, megabytes: float) -> None:
        self.left = megabytes * 1e6

    def uri(self, data: bytes, kind: str) -> str | None:
        """The data URI of a picture, or None where it does not fit any more."""
        uri = f"data:image/{kind};base64,{b64encode(data).decode()}"
        if len(uri) > self.left:
            return None
        self.left -= len(uri)
        return uri


def picture(path: Path, caption: str, budget: ByteBudget) -> Html:
    """A figure with its caption, which is also what is read out; or why it is not shown."""
    try:
        data, kind, width, height = _encoded(path)
    except (OSError, ValueError, Image.DecompressionBombError) as error:
        return left_out(f"{caption}: cannot be shown ({' '.join(str(error).split())})")
    if (uri := budget.uri(data, kind)) is None:
        return left_out(f"{caption}: left out, the page is full")
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


def strip(video: Path, count: int) -> tuple[Image.Image, int]:
    """At most `count` frames from left to right, evenly spread over all of a video, and how many they are.

    Raises:
        OSError, RuntimeError, ValueError, IndexError: no readable video (imageio's; it depends on what is wrong).
    """
    import imageio.v2 as imageio

    frames: list[Image.Image] = []
    reader: Any
    with imageio.get_reader(video, format="FFMPEG") as reader:
        total = reader.count_frames()
        wanted = {index * total // count for index in range(count)}
        for index, frame in enumerate(reader):
            if index in wanted:
                image = Image.fromarray(np.asarray(frame))
                image.thumbnail((SIDE, SIDE))
                frames.append(image)
    if not frames:
        raise ValueError("it has no frames")
    shown = [np.asarray(image) for image in frames[: LONGEST // frames[0].width]]
    return Image.fromarray(np.concatenate(shown, axis=1)), len(shown)


def turntable(video: Path, image: str, sample: str, count: int, budget: ByteBudget) -> Html:
    """A figure of an orbit of one sample; without scripts the strip can be scrolled. Or why it is not shown."""
    try:
        joined, frames = strip(video, count)
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        return left_out(f"{video.name}: cannot be shown ({' '.join(str(error).split())[:200]})")
    uri, name = budget.uri(as_jpeg(joined), "jpeg"), f"{image}, {sample}"
    if uri is None:
        return left_out(f"{video.name}: left out, the page is full")
    drawn = element("img", src=uri, alt=f"{name}, seen from {frames} directions", style=f"width:{100 * frames}%")
    box = element(
        "div",
        drawn,
        class_="turntable",
        tabindex="0",
        role="slider",
        aria_label=f"{name}: turn it",
        **{"aria_valuemin": "0", "aria_valuemax": str(frames - 1), "aria_valuenow": "0"},
        aria_valuetext="0 degrees",
        data_frames=str(frames),
        style=f"aspect-ratio:{joined.width // frames}/{joined.height}",
    )
    angle = element("span", "0°", class_="angle", aria_hidden="true")
    return element("figure", box, element("figcaption", sample, " ", angle))
