"""Ranges and choices of the values that users set, as annotations of arguments, and suffixes of files of Gaussians.

They hold no code. `completesplat.settings.schema` checks users' values against the annotations of what they set.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Literal


@dataclass(frozen=True)
class Range:
    """Rule for `Annotated`: a finite number between two bounds, both included."""

    least: float
    most: float = math.inf


@dataclass(frozen=True)
class Entries:
    """Rule for `Annotated`: a list with a minimum and a maximum number of entries."""

    least: int = 0
    most: float = math.inf


Positive = Annotated[int, Range(1)]
Natural = Annotated[int, Range(0)]
NonNegative = Annotated[float, Range(0)]
Share = Annotated[float, Range(0, 1)]
Seed = Annotated[int, Range(0, 2**63 - 1)]
Side = Annotated[int, Range(8, 4096)]  # of an image, in pixels
Detail = Annotated[int, Range(0, 2048)]  # largest side of the image that a scene's front is fitted to, in pixels

# Sizes of networks. Their bounds lie beyond what anyone trains, and protect from configs that strangers wrote.
Width = Annotated[int, Range(1, 8192)]
Widths = Annotated[Sequence[Width], Entries(1), Entries(most=8)]
Levels = Annotated[Sequence[Annotated[int, Range(0, 7)]], Entries(most=8)]
Few = Annotated[int, Range(1, 16)]

Format = Literal["ply", "compressed.ply", "splat", "spz", "glb", "usdz", "mesh", "sog", "html"]  # of a scene's files
SPLATS = (".ply", ".splat", ".spz", ".sog", ".ksplat")  # files of Gaussians that are read
# Part of a photo: all of it, the square in its middle, or [x, y, size] in shares of its width, height and shorter side.
Crop = Literal["whole", "center"] | Annotated[Sequence[float], Entries(3, 3)]
CameraPath = Literal["orbit", "swipe", "wobble"]  # of a video
