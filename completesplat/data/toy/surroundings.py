"""Surroundings of toy scenes: light, the dome around an object, the patch on its back, and rooms."""

from typing import NamedTuple

import numpy as np

from completesplat.data.toy.shapes import Array

# Indices of faces. A room has two across each of x, y and z, the lower one first. A dome has a ground.
FLOOR = 2
CEILING = 3
WALLS = (0, 1, 4, 5)
GROUND = 6
DOME = 7

WHITE = (1.0, 1.0, 1.0)


class Light(NamedTuple):
    """Ambient light, and direct light from the direction `place`, or from the point `place` if `is_point`.

    `sky` is the share of the ambient light from above, and `shadow` is the share of direct light that shadows keep.
    `color` has factors of red, green and blue for both; the dome is not lit.
    """

    place: Array
    is_point: bool
    ambient: float
    sky: float
    shadow: float
    color: Array = np.array(WHITE)


class Dome(NamedTuple):
    """Ground plane at height `ground` with two colours and a pattern, under a dome with a palette.

    The dome's hue is `hue` + 0.17 sin(azimuth - `turn`), with panels of the same phase. This law is the same in all
    scenes, so that the dome behind a camera can partly be inferred from the one in front. A `plain` dome is grey.
    """

    ground: float
    ground_colors: Array
    ground_texture: Array
    radius: float
    hue: float
    turn: float
    plain: bool


class Patch(NamedTuple):
    """Disc on an object's first part: its normals have a cosine above `edge` with the direction `facing`.

    `heights` is the local range of y that it may cover.
    """

    facing: Array
    color: Array
    heights: Array
    edge: float


class Room(NamedTuple):
    """Inside of a box of `size`, with `colors` [face 2 3] and `textures` [face 3].

    The floor is at y = 0, and its middle at x = z = 0. `decals` [decal 6] are rectangles on faces: face, range of u,
    range of v, width of the rim. The coordinates (u, v) are (z, y) on walls across x, (x, z) on floor and ceiling, and
    (x, y) on walls across z. `decal_colors` [decal 3 3] are the rim and two inner colours.
    """

    size: Array
    colors: Array
    textures: Array
    decals: Array
    decal_colors: Array
    decal_textures: Array
