"""Random cameras, light, floor and wall of a rendered scene, described for `_scene_script.py`."""

import hashlib
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypedDict

import numpy as np
import torch
from jaxtyping import Float

from completesplat.data.captures.transforms_json import read_cameras
from completesplat.data.validation import require_file
from completesplat.errors import CompleteSplatError, MissingFile
from completesplat.geometry.cameras import Cameras, look_at, pinhole
from completesplat.quantities import Entries, Natural, Positive, Range, Side

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
# Distance at which the ball around the object touches the image's border, times this.
NEAREST = 0.9
FARTHEST = 1.2
ROOM = 1.3
SMALLEST_ROOM = 3.0  # half size of a room: relative to the farthest camera, and at least
TEXTURES = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp")
ENVIRONMENTS = (".hdr", ".exr")
WHITE_FLOOR = (0.5, 1.1)
# Of `fixed_cameras`, in degrees.
FIXED_FOV = 40.0
FIRST_AZIMUTH = 30.0
FIRST_ELEVATION = 20.0
HIGHEST = 60.0
GOLDEN = (math.sqrt(5) - 1) / 2
ASIDE = 45.0
"""Largest angle in degrees between the first camera's azimuth and the object's front."""


class Paint(NamedTuple):
    """Paint of the back: the light that it reflects, linear RGB, and its probability."""

    color: tuple[float, float, float]
    chance: float


PAINTS = {
    "red": Paint((0.5, 0.03, 0.03), 0.4),
    "green": Paint((0.04, 0.3, 0.06), 0.3),
    "blue": Paint((0.03, 0.08, 0.5), 0.2),
    "yellow": Paint((0.8, 0.5, 0.02), 0.1),
}

Angles = Float[np.ndarray, " view"]


class RenderSettings(TypedDict):
    """Settings of all scenes, for `read_mesh`, `draw_cameras`, `draw_light` and `draw_surface`."""

    up: Literal["y", "z"] | None
    views: Annotated[int, Range(2, 1000)]
    size: Side
    samples: Positive
    cameras: str
    front: float | None
    fov: Annotated[Sequence[Annotated[float, Range(5, 120)]], Entries(2, 2)]
    light: str
    floor: str
    wall: str
    hidden: Literal["none", "back", "modes"]
    seed: Natural


def draw_rendered_scene(name: str, settings: RenderSettings) -> tuple[dict[str, Any], list[Cameras]]:
    """Draw surroundings and cameras by the seed and an object's name, and return them for `_scene_script.py`."""
    digest = hashlib.sha256(name.encode()).digest()
    rng = np.random.default_rng([settings["seed"], int.from_bytes(digest[:8])])
    views = settings["views"]
    size = settings["size"]
    front = settings["front"]
    cameras = draw_cameras(rng, settings["cameras"], views, settings["fov"], size, front)
    job = {
        "seed": int(rng.integers(2**31)),
        "up": settings["up"],
        "samples": settings["samples"],
        "views": [view_of(camera) for camera in cameras],
        "room": room_size(cameras),
        "light": draw_light(rng, settings["light"]),
        "floor": draw_surface(rng, settings["floor"]),
        "wall": draw_surface(rng, settings["wall"]),
        "hidden": draw_back(rng, cameras[0], settings["hidden"]),
    }
    return job, cameras


def view_of(camera: Cameras) -> dict[str, Any]:
    return {
        "world_to_camera": camera.world_to_camera.tolist(),
        "focal": camera.intrinsics[0, 0].item(),
        "center": camera.intrinsics[:2, 2].tolist(),
        "size": camera.image_size[::-1],
    }


def draw_cameras(
    rng: np.random.Generator, kind: str, views: int, fov: Sequence[float], size: int, front: float | None = None
) -> list[Cameras]:
    """Draw the cameras of an object whose farthest vertex has distance 1 from the origin, with z up.

    Args:
        kind: `turn`: around the object at varying heights, as people film for CO3D; `hemisphere`: from random
            directions above the ground; `fixed`: `fixed_cameras`, to which `fov` does not apply; or the path of a
            `transforms.json`, whose cameras are taken.
        front: azimuth of the object's front (degrees, from x to y), at most `ASIDE` from the first camera; None: any.
        fov: smallest and largest field of view in degrees, drawn once for an object.

    Raises:
        CompleteSplatError: the kind is unknown, the file's cameras cannot be read, or `front` is given with cameras
            that are not random.
    """
    if kind not in ("turn", "hemisphere"):
        if kind != "fixed" and Path(kind).suffix != ".json":
            raise CompleteSplatError(f"cameras={kind}: choose turn, hemisphere, fixed or the path of a transforms.json")
        if front is not None:
            raise CompleteSplatError(f"front={front}: has no effect on cameras={kind}; leave it out")
        return fixed_cameras(views, size) if kind == "fixed" else read_cameras(Path(kind), size)
    azimuth, elevation = turn_angles(rng, views) if kind == "turn" else hemisphere(rng, views)
    if front is not None:
        azimuth = azimuth - azimuth[0] + math.radians(front + rng.uniform(-ASIDE, ASIDE))
    degrees = rng.uniform(min(fov), max(fov))
    distance = rng.uniform(NEAREST, FARTHEST) / math.sin(math.radians(degrees) / 2) * rng.normal(1, 0.03, views)
    level = np.cos(elevation)
    eyes = distance * np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)])
    targets = torch.from_numpy(rng.normal(0, 0.05, (views, 3)))
    matrices = look_at(torch.from_numpy(eyes.T.copy()), targets, UP)
    return [Cameras(matrix, pinhole(degrees, size).double(), (size, size)) for matrix in matrices]


def fixed_cameras(views: int, size: int) -> list[Cameras]:
    """Return the cameras that are the same for every object, those of the protocols on meshes.

    They look at the origin from a distance at which the ball around the object touches the image's border. The first
    is 20 degrees above the horizon, at an azimuth of 30 degrees from x. The others follow all around; their elevations
    are spread from 0 to 60 degrees by the golden ratio.
    """
    number = torch.arange(views, dtype=torch.float64)
    azimuth = math.radians(FIRST_AZIMUTH) + 2 * math.pi * number / views
    elevation = math.radians(HIGHEST) * ((number * GOLDEN) % 1)
    elevation[0] = math.radians(FIRST_ELEVATION)
    level = elevation.cos()
    directions = torch.stack([level * azimuth.cos(), level * azimuth.sin(), elevation.sin()], dim=-1)
    eyes = directions / math.sin(math.radians(FIXED_FOV) / 2)
    matrices = look_at(eyes, torch.zeros_like(eyes), UP)
    return [Cameras(matrix, pinhole(FIXED_FOV, size).double(), (size, size)) for matrix in matrices]


def turn_angles(rng: np.random.Generator, views: int) -> tuple[Angles, Angles]:
    """Return azimuths that go once around, and elevations that rise and fall, in radians."""
    start, phase = rng.uniform(0, 2 * np.pi, 2)
    azimuth = start + 2 * np.pi * (np.arange(views) + rng.uniform(-0.25, 0.25, views)) / views
    degrees = rng.uniform(8, 35) + rng.uniform(0, 10) * np.sin(azimuth + phase) + rng.normal(0, 1.5, views)
    return azimuth, np.radians(degrees.clip(2, 70))


def hemisphere(rng: np.random.Generator, views: int) -> tuple[Angles, Angles]:
    """Return directions that are uniform on the upper hemisphere, without its pole and its rim, in radians."""
    return rng.uniform(0, 2 * np.pi, views), np.arcsin(rng.uniform(0.03, 0.97, views))


def room_size(cameras: Sequence[Cameras]) -> float:
    """Return the half size of a room with all cameras in it."""
    reach = max(camera.centers[:2].abs().max().item() for camera in cameras)
    return max(ROOM * reach, SMALLEST_ROOM)


def draw_light(rng: np.random.Generator, light: str) -> dict[str, Any]:
    """Draw a sun and a sky (`random`), or the turn of an environment map's file."""
    if light != "random":
        return {"file": os.path.abspath(light), "turn": rng.uniform(0, 2 * np.pi)}
    warm = rng.uniform()
    elevation = math.radians(rng.uniform(30, 80))
    # Radiance of a white floor, as if the camera had chosen its exposure, and the sun's part of it.
    white = rng.uniform(*WHITE_FLOOR)
    part = rng.uniform(0.2, 0.8)
    horizon = np.array([0.9, 0.95, 1.0])
    zenith = np.array([0.3, 0.5, 1.0]) + rng.uniform(0, 0.6)
    return {
        "sky": [((1 - part) * white * color.clip(0, 1)).tolist() for color in (horizon, zenith)],
        "strength": math.pi * part * white / math.sin(elevation),
        "color": [1.0, 1 - 0.15 * warm, 1 - 0.4 * warm],
        "angle": math.radians(rng.uniform(0.5, 10)),  # a larger sun has softer shadows
        "elevation": elevation,
        "azimuth": rng.uniform(0, 2 * np.pi),
    }


def draw_surface(rng: np.random.Generator, surface: str) -> dict[str, Any] | None:
    """Draw a floor or wall: `none`, `plain` grey, a `random` pattern of two colours, or an image of a folder."""
    if surface == "none":
        return None
    if surface == "plain":
        return {"pattern": "checker", "colors": [[0.5] * 3] * 2, "repeats": 1.0, "file": ""}
    repeats = float(np.exp(rng.uniform(np.log(0.3), np.log(3))))
    if surface == "random":
        base = rng.uniform(0.1, 0.9) * (1 - rng.uniform(0, 0.5) * rng.uniform(size=3))
        colors = [base.tolist(), (base * rng.uniform(0.5, 1, 3)).tolist()]
        return {"pattern": str(rng.choice(["checker", "noise"])), "colors": colors, "repeats": repeats, "file": ""}
    file = str(rng.choice(textures_of(Path(surface))))
    return {"pattern": "image", "colors": [], "repeats": repeats, "file": file}


def draw_back(rng: np.random.Generator, first: Cameras, hidden: str) -> dict[str, Any] | None:
    """Draw the paint of what points away from the first camera, which does not see it (see `_scene_script.paint_back`).

    Returns:
        The direction toward the camera, the least part of it that a painted face's normal points away, and the names
        and colours of paints: the drawn one, then all others if `hidden` is `modes`. None if `hidden` is `none`.
    """
    if hidden == "none":
        return None
    drawn = str(rng.choice(list(PAINTS), p=[paint.chance for paint in PAINTS.values()]))
    names = [drawn]
    if hidden == "modes":
        names.extend(name for name in PAINTS if name != drawn)
    distance = first.centers.norm().item()
    toward = (first.centers / distance).tolist()
    colors = [PAINTS[name].color for name in names]
    return {"toward": toward, "least": 1 / distance, "modes": names, "colors": colors}


def textures_of(folder: Path) -> list[str]:
    """Return the paths of the images in a folder, at least one."""
    paths = [path for path in folder.glob("[!.]*") if path.suffix.lower() in TEXTURES and path.is_file()]
    if not paths:
        raise MissingFile(f"no textures there ({', '.join(TEXTURES)})", str(folder))
    return sorted(str(path.absolute()) for path in paths)


def check_surroundings(settings: RenderSettings) -> None:
    """Refuse a light's file or a folder of textures that does not exist."""
    light = settings["light"]
    if light != "random":
        if Path(light).suffix.lower() not in ENVIRONMENTS:
            raise CompleteSplatError(f"light={light}: neither random nor a file ({', '.join(ENVIRONMENTS)})")
        require_file(Path(light))
    for surface in {settings["floor"], settings["wall"]} - {"none", "plain", "random"}:
        textures_of(Path(surface))
