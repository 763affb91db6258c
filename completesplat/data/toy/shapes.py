"""Input of the ray tracer: parts of toy scenes (ellipsoids, cone frusta and boxes with patterns), and camera rays."""

import colorsys
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

ELLIPSOID = 0
FRUSTUM = 1
BOX = 2
# Patterns: the first number of a texture. The others are its frequency (radians per unit of length) and phase.
PLAIN = 0
STRIPES = 1
CHECKS = 2
RIPPLES = 3
SAMPLES = 3  # rays of a pixel in each direction

Array = NDArray[np.float64]
Look = tuple[Array, Array]
"""Two colours [2 3] and a texture [3]."""
Point = tuple[float, float, float]


class Shapes(NamedTuple):
    """Parts of an object, or the furniture of a room, as arrays.

    In its local frame, an ellipsoid is the unit ball, a frustum x^2 + z^2 <= (1 + taper y)^2, |y| <= 1, and a box the
    cube [-1, 1]^3. `to_local` [shape 3 4] maps world points to the local frames. `bounding_balls` [shape 4] are the
    centre and squared radius of a ball around each shape.
    """

    kinds: NDArray[np.int64]
    to_local: Array
    half_sizes: Array
    tapers: Array
    bounding_balls: Array
    colors: Array
    textures: Array


class Part(NamedTuple):
    """Ellipsoid, frustum or box: centre, half sizes along its axes, directions of the axes (columns), and texture."""

    kind: int
    center: Array
    half_sizes: Array
    axes: Array
    taper: float
    colors: Array
    texture: Array

    def to_local(self) -> Array:
        """Return the map [3 4] from the object's frame to the unit shape's frame."""
        linear = self.axes.T / self.half_sizes[:, None]
        return np.concatenate([linear, -linear @ self.center[:, None]], axis=1)

    def moved(self, rotation: Array, shift: Array, scale: float = 1.0) -> "Part":
        """Return the part after rotation, then shift, then scaling of the object."""
        center = scale * (rotation @ self.center + shift)
        return self._replace(center=center, half_sizes=scale * self.half_sizes, axes=rotation @ self.axes)

    def distances(self, points: Array) -> Array:
        """Return the distances of points [n 3] to the (bounding) box, 0 inside."""
        outside = np.abs((points - self.center) @ self.axes) - self.half_sizes
        return np.linalg.norm(outside.clip(0), axis=-1)


def make_part(kind: int, center: Point, half: Point, look: Look, axes: Array | None = None, taper: float = 0.0) -> Part:
    """Make a part with half sizes `half`, by default with its axes along x, y and z."""
    axes = np.eye(3) if axes is None else axes
    return Part(kind, np.array(center, dtype=np.float64), np.array(half, dtype=np.float64), axes, taper, *look)


def as_arrays(parts: Sequence[Part]) -> Shapes:
    """Return parts as the ray tracer's arrays."""
    squared_radii = [(part.half_sizes**2).sum() * (1 + abs(part.taper)) ** 2 for part in parts]
    return Shapes(
        kinds=np.array([part.kind for part in parts]),
        to_local=np.stack([part.to_local() for part in parts]),
        half_sizes=np.stack([part.half_sizes for part in parts]),
        tapers=np.array([part.taper for part in parts]),
        bounding_balls=np.column_stack([[part.center for part in parts], squared_radii]),
        colors=np.stack([part.colors for part in parts]),
        textures=np.stack([part.texture for part in parts]),
    )


def rotation_about(axis: str, radians: float) -> Array:
    """Return the rotation matrix about a coordinate axis. The one about y turns +z towards +x."""
    cos = np.cos(radians)
    sin = np.sin(radians)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = cos
    matrix[j, i] = sin
    matrix[i, j] = -sin
    return matrix


def color(hue: float, saturation: float, value: float) -> Array:
    """Return the sRGB colour of a hue (in turns, wrapped), saturation and value."""
    return np.array(colorsys.hsv_to_rgb(hue % 1.0, saturation, value))


def plain_look(shade: Array) -> Look:
    """Return the look of one colour without a pattern."""
    return np.stack([shade, shade]), np.array([PLAIN, 0.0, 0.0])


@lru_cache(maxsize=1)
def camera_rays(fx: float, fy: float, cx: float, cy: float, height: int, width: int, unit: bool = False) -> Array:
    """Return rays [pixel sample 3] in the camera's frame, of unit length or with depth 1, in rows from the top."""
    offsets = (np.arange(SAMPLES) + 0.5) / SAMPLES
    x = (np.arange(width)[:, None] + offsets - cx) / fx
    y = (np.arange(height)[:, None] + offsets - cy) / fy
    grid = np.broadcast_arrays(x[None, :, None, :], y[:, None, :, None], 1.0)
    rays = np.stack(grid, axis=-1).reshape(height * width, SAMPLES**2, 3)
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True) if unit else rays
