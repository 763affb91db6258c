"""What a toy room is made of, as plain arrays for the ray tracer.

Room axes: +y up, right-handed, the origin in the middle of the floor. Faces of the room are numbered 2 axis + side:
0 and 1 are the walls at -x and +x, 2 the floor, 3 the ceiling, 4 and 5 the walls at -z and +z.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from completesplat.data.toy.ingredients import Array

BOX, BALL = 0, 1
# What the first number of a texture says; the others are its frequency (radians per unit of length) and phase.
PLAIN, STRIPES, TILES, RIPPLES = 0, 1, 2, 3
FLOOR, CEILING = 2, 3
WALLS = (0, 1, 4, 5)


class Room(NamedTuple):
    """Everything that a ray in the room can hit, and the light.

    `size`: along x, y and z. `colors` [face 2 3] and `textures` [face 3]: looks of the room's faces. `decals` [decal 6]
    are rectangles on faces: face, range of the first coordinate, range of the second, width of the rim; the coordinates
    are (z, y) on walls across x, (x, y) on walls across z. `decal_colors` [decal 3 3]: rim and two inner colours.
    Solids are the cube [-1, 1]^3 or the unit ball in their local frames; `to_local` [solid 3 4] maps room points there.
    `bounding_balls` [solid 4]: centre and squared radius of a ball that holds each.
    """

    size: Array
    colors: Array
    textures: Array
    decals: Array
    decal_colors: Array
    decal_textures: Array
    solid_kinds: NDArray[np.int64]
    to_local: Array
    bounding_balls: Array
    solid_half_sizes: Array
    solid_colors: Array
    solid_textures: Array
    light: Array
    ambient: float
