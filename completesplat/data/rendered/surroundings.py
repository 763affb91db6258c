"""Floor and walls around an object: where they are, and the colours of their matt surfaces."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from PIL import Image

from completesplat.data.rendered.mesh_reading import Textures, packed_textures
from completesplat.data.rendered.z_buffer import look_up

OPEN_GROUND = 30.0  # half size of a floor without walls, as in Blender
LATTICE = 4096  # values of a noise's lattice


@dataclass(frozen=True)
class Plane:
    """Rectangle with a matt surface: the floor, or a wall.

    Attributes:
        corner: place where both texture coordinates are 0; they are lengths along the sides.
        sides: vectors of the two sides.
    """

    corner: Float[np.ndarray, " 3"]
    sides: Float[np.ndarray, "2 3"]
    surface: dict[str, Any]
    picture: Textures | None

    @property
    def normal(self) -> Float[np.ndarray, " 3"]:
        """Unit vector across the plane."""
        normal: Float[np.ndarray, " 3"] = np.cross(self.sides[0], self.sides[1])
        return normal / np.linalg.norm(normal)

    def described(self) -> Float[np.ndarray, "4 3"]:
        """Return corner, sides and normal, as `draw_rectangles` takes them."""
        return np.stack([self.corner, *self.sides, self.normal])


def surroundings(job: dict[str, Any], ground: float) -> list[Plane]:
    """Return the floor below the object, and the walls of a room without a ceiling."""
    side = job["room"] if job["wall"] else OPEN_GROUND
    square = np.array([(-side, -side), (side, -side), (side, side), (-side, side)])
    planes = []
    if job["floor"]:
        sides = np.array([(2 * side, 0, 0), (0, 2 * side, 0)])
        planes.append(_plane(np.array([-side, -side, ground]), sides, job["floor"]))
    if job["wall"]:
        for place, following in zip(square, np.roll(square, -1, axis=0), strict=True):
            sides = np.array([(*(following - place), 0), (0, 0, 2 * side)])
            planes.append(_plane(np.array([*place, ground]), sides, job["wall"]))
    return planes


def _plane(corner: np.ndarray, sides: np.ndarray, surface: dict[str, Any]) -> Plane:
    picture = None
    if surface["pattern"] == "image":
        with Image.open(surface["file"]) as file:
            picture = packed_textures([np.asarray(file.convert("RGBA"))])
    return Plane(corner, sides, surface, picture)


def surface_mean(plane: Plane) -> Float[np.ndarray, " 3"]:
    """Return the mean linear colour of a surface."""
    if plane.picture is None:
        return np.array(plane.surface["colors"]).mean(0)
    start, width, height = plane.picture.levels[0, -1]
    values = plane.picture.texels[start : start + 4 * width * height].reshape(-1, 4)
    mean: Float[np.ndarray, " 3"] = values[:, :3].mean(0) / 65535
    return mean


def surface_colors(
    plane: Plane, uv: Float[np.ndarray, "sample 2"], size: Float[np.ndarray, " sample"]
) -> Float[np.ndarray, "sample 3"]:
    """Return the linear colours of a surface at lengths along its sides; `size` is that of a sample on it."""
    surface = plane.surface
    scaled = uv * surface["repeats"]
    extent = size * surface["repeats"]
    if plane.picture is not None:
        colors = np.empty((len(uv), 3))
        picture = plane.picture
        look_up(picture.texels, picture.levels, np.zeros(len(uv), np.int64), scaled, extent**2, colors)
        return colors
    share = (np.floor(scaled).sum(-1) % 2)[:, None] if surface["pattern"] == "checker" else _noise(scaled)[:, None]
    # Samples that are wider than the pattern show its mean.
    share = share + (0.5 - share) * (extent - 1).clip(0, 1)[:, None]
    first, second = np.array(surface["colors"])
    return (1 - share) * first + share * second


def _noise(places: Float[np.ndarray, "place 2"]) -> Float[np.ndarray, " place"]:
    """Return smooth noise from 0 to 1 whose features have size 1 (value noise of two octaves)."""
    lattice = np.random.default_rng(0).uniform(size=LATTICE)
    total = np.zeros(len(places))
    for octave, weight in ((1, 2 / 3), (2, 1 / 3)):
        scaled = places * octave
        cell = np.floor(scaled).astype(np.int64)
        inside = scaled - cell
        blend = inside * inside * (3 - 2 * inside)
        for across in (0, 1):
            for up in (0, 1):
                values = lattice[((cell[:, 0] + across) * 73 + (cell[:, 1] + up) * 179) % LATTICE]
                share = np.abs(1 - across - blend[:, 0]) * np.abs(1 - up - blend[:, 1])
                total += weight * values * share
    return total
