"""Samples that turn: frames of an orbit video side by side in one picture, of which the page shows one at a time."""

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from completesplat.reports.html.markup import Html, element
from completesplat.reports.html.pictures import Room, as_jpeg

SIDE = 256
"""Pixels of a frame's longer side, at most."""
LONGEST = 60_000
"""Pixels; JPEG ends at 65,535."""


def strip(video: Path, count: int) -> tuple[Image.Image, int]:
    """Frames of a video from left to right, evenly spread over all of it, and how many they are.

    Args:
        video: the file.
        count: how many at most; a shorter video gives all that it has.

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
    width, height = frames[0].size
    frames = frames[: LONGEST // width]
    joined = Image.new("RGB", (width * len(frames), height))
    for index, image in enumerate(frames):
        joined.paste(image, (index * width, 0))
    return joined, len(frames)


def turntable(video: Path, image: str, sample: str, count: int, room: Room) -> Html:
    """A figure of one sample; without scripts the strip can be scrolled. Or why it is not shown.

    Args:
        video: an orbit, one full turn.
        image: the photograph's name.
        sample: the sample's.
        count: of the frames.
        room: that is left in the page.
    """
    try:
        joined, frames = strip(video, count)
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        said = " ".join(str(error).split())[:200]
        return element("p", f"{video.name}: cannot be shown ({said})", class_="left-out")
    uri, name = room.uri(as_jpeg(joined), "jpeg"), f"{image}, {sample}"
    if uri is None:
        return element("p", f"{video.name}: left out, the page is full", class_="left-out")
    drawn = element("img", src=uri, alt=f"{name}, seen from {frames} directions", style=f"width:{100 * frames}%")
    box = element(
        "div",
        drawn,
        class_="turntable",
        tabindex="0",
        role="slider",
        aria_label=f"{name}: turn it",
        aria_valuemin="0",
        aria_valuemax=str(frames - 1),
        aria_valuenow="0",
        aria_valuetext="0 degrees",
        data_frames=str(frames),
        style=f"aspect-ratio:{joined.width // frames}/{joined.height}",
    )
    angle = element("span", "0°", class_="angle", aria_hidden="true")
    return element("figure", box, element("figcaption", sample, " ", angle))
