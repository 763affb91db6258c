"""Predictions: the samples of each photograph side by side, and the contact sheet."""

from typing import Any

from completesplat.reports.html.finding import SCENE, Folder, origin, read_object
from completesplat.reports.html.markup import Html, described, element, folded
from completesplat.reports.html.pictures import Room, picture
from completesplat.reports.html.turntables import turntable

NAMED = {
    "image": "photograph",
    "mask": "mask",
    "box": "box",
    "fov_degrees": "degrees of view",
    "seed": "seed",
    "skip_weight": "skip weight",
    "guidance_weight": "guidance",
    "sampler": "sampler",
    "steps": "steps",
}
"""Settings of a prediction, and what they are called here."""


def prediction(found: Folder, frames: int, most_samples: int, room: Room) -> Html:
    """A section of one photograph: how its samples were made, each of them turning, and the sheet.

    Args:
        found: the folder.
        frames: of each turn.
        most_samples: that are shown; how many others there are is said.
        room: that is left in the page.
    """
    settings = read_object(found.path / SCENE).get("settings")
    settings = settings if isinstance(settings, dict) else {}
    image = str(settings.get("image") or found.name)
    videos = sorted(found.path.glob("orbit_*.mp4"))
    shown = videos[:most_samples]
    turning = [turntable(video, image, video.stem.replace("orbit_", "sample "), frames, room) for video in shown]
    parts = [
        element("h3", found.name),
        described({"settings": said(settings), **origin(found.path)}),
    ]
    if turning:
        parts.append(element("div", *turning, class_="samples"))
    if len(videos) > len(shown):
        parts.append(element("p", f"{len(videos) - len(shown)} more samples left out", class_="left-out"))
    if (found.path / "sheet.png").is_file():
        sheet = picture(found.path / "sheet.png", f"{image}: input, and views around each sample", room)
        parts.append(folded("Contact sheet", sheet, open_=not turning))
    return element("section", *parts, aria_label=f"Prediction {found.name}")


def said(settings: dict[str, Any]) -> str:
    """The settings that matter, in one line."""
    return ", ".join(f"{name} {_short(settings[key])}" for key, name in NAMED.items() if settings.get(key) is not None)


def _short(value: Any) -> str:
    return format(value, ".4g") if isinstance(value, float) else str(value)
