"""What a toy scene is made of, as plain arrays for the ray tracer.

World axes: +y up, right-handed, the object's centre at the origin.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

ELLIPSOID, FRUSTUM = 0, 1
SOLID, BANDS, CHECKS, WAVES = 0, 1, 2, 3

Array = NDArray[np.float64]


class Geometry(NamedTuple):
    """What a ray can hit.

    An ellipsoid is the unit ball and a frustum is x^2 + z^2 <= (1 + taper y)^2, |y| <= 1, each in its local frame;
    `to_local` [part 3 4] maps world points there. `textures` [part 3]: pattern, frequency, phase.
    """

    kinds: NDArray[np.int64]
    to_local: Array
    tapers: Array
    colors: Array
    textures: Array
    bounding_radius: float


class Surroundings(NamedTuple):
    """Ground plane at height `ground` (two colours, pattern), dome (palette) and light.

    The dome's hue is `hue` + 0.17 sin(azimuth - `turn`), with panels of the same phase: a law shared by all scenes,
    so that what lies behind a camera can partly be told from what lies in front of it.
    """

    ground: float
    ground_colors: Array
    ground_texture: Array
    dome_radius: float
    hue: float
    turn: float
    light: Array
    ambient: float


class Patch(NamedTuple):
    """A disc with a white rim on the side of `part` that faces the horizontal direction `facing`.

    `heights`: the local range of y that it may cover.
    """

    part: int
    facing: Array
    color: Array
    heights: Array
