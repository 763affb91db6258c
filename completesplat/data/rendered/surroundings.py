"""Floor and walls around an object: where they are, and what they show."""

from typing import Any

import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image

from completesplat.data.rendered.mesh_reading import packed_textures
from completesplat.data.rendered.shading import CHECKER, IMAGE, NOISE, Planes

OPEN_GROUND = 30.0  # half size of a floor without walls, as in Blender
LATTICE = 4096  # values of a noise's lattice
PATTERNS = {"checker": CHECKER, "noise": NOISE, "image": IMAGE}
WHITE = np.full((1, 1, 4), 255, np.uint8)


def surroundings(job: dict[str, Any], ground: float) -> Planes:
    """Return the floor below the object, if there is one, and then the walls of a room without a ceiling."""
    side = job["room"] if job["wall"] else OPEN_GROUND
    square = np.array([(-side, -side), (side, -side), (side, side), (-side, side)])
    corners: list[tuple[float, ...]] = []
    sides: list[list[tuple[float, ...]]] = []
    surfaces: list[dict[str, Any]] = []
    if job["floor"]:
        corners.append((-side, -side, ground))
        sides.append([(2 * side, 0, 0), (0, 2 * side, 0)])
        surfaces.append(job["floor"])
    if job["wall"]:
        for place, following in zip(square, np.roll(square, -1, axis=0), strict=True):
            corners.append((*place, ground))
            sides.append([(*(following - place), 0), (0, 0, 2 * side)])
            surfaces.append(job["wall"])
    files = sorted({surface["file"] for surface in surfaces})
    textures = packed_textures([_pixels(file) if file else WHITE for file in files] or [WHITE])
    vectors = np.array(sides, np.float64).reshape(-1, 2, 3)
    lengths = np.linalg.norm(vectors, axis=-1)
    units = vectors / lengths[..., None]
    return Planes(
        corners=np.array(corners, np.float64).reshape(-1, 3),
        first=np.ascontiguousarray(units[:, 0]),
        second=np.ascontiguousarray(units[:, 1]),
        normals=np.cross(units[:, 0], units[:, 1]),
        lengths=lengths,
        patterns=np.array([PATTERNS[surface["pattern"]] for surface in surfaces], np.int64),
        colors=np.array([surface["colors"] or np.zeros((2, 3)) for surface in surfaces]).reshape(-1, 2, 3),
        repeats=np.array([surface["repeats"] for surface in surfaces], np.float64),
        texture=np.array([files.index(surface["file"]) for surface in surfaces], np.int64),
        texels=textures.texels,
        levels=textures.levels,
        lattice=np.random.default_rng(0).uniform(size=LATTICE),
    )


def _pixels(file: str) -> UInt8[np.ndarray, "height width 4"]:
    with Image.open(file) as image:
        return np.asarray(image.convert("RGBA"))


def mean_color(planes: Planes, number: int) -> Float[np.ndarray, " 3"]:
    """Return the mean linear colour of a plane."""
    if planes.patterns[number] != IMAGE:
        return planes.colors[number].mean(0)
    start, width, height = planes.levels[planes.texture[number], -1]
    values = planes.texels[start : start + 4 * width * height].reshape(-1, 4)
    mean: Float[np.ndarray, " 3"] = values[:, :3].mean(0) / 65535
    return mean
