"""Random toy objects and minis: parts, surroundings, a hidden patch, and an orbit of cameras.

A mini is an ellipsoid with a nose on plain grey, the smallest scene with known alternatives for its back. The patch
lies opposite the nose, so an image of the nose shows where the patch is, but not which of four colours it has. On
marked minis the nose is light or dark, which determines the probability of each colour. They expose a model that
learns only the overall frequency of the colours.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch

from completesplat.data.placement import OBJECT_HALF_SIZE
from completesplat.data.toy.raytracing import trace
from completesplat.data.toy.shapes import (
    CHECKS,
    ELLIPSOID,
    FRUSTUM,
    PLAIN,
    RIPPLES,
    SAMPLES,
    STRIPES,
    Array,
    Look,
    Part,
    Point,
    Shapes,
    as_arrays,
    camera_rays,
    color,
    make_part,
    plain_look,
    rotation_about,
)
from completesplat.data.toy.surroundings import Dome, Light, Patch
from completesplat.geometry.cameras import invert_rigid, look_at

DARK = np.full(3, 0.07)
DOME_RADIUS = 3.5
UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)
PATCH_COLORS = {
    "red": (0.9, 0.08, 0.1),
    "green": (0.1, 0.7, 0.2),
    "blue": (0.1, 0.25, 0.9),
    "yellow": (0.98, 0.85, 0.1),
}
EVEN = np.full(len(PATCH_COLORS), 0.25)
CHANCES = {"light": np.array([0.4, 0.3, 0.2, 0.1]), "dark": np.array([0.1, 0.2, 0.3, 0.4])}
"""Probabilities of the colours in `PATCH_COLORS`, by the nose of a marked mini."""
NOSES = {"light": 0.97, "dark": 0.05}
"""Grey values of the noses."""
FROM_THE_FRONT = 0.35
"""Largest azimuth (radians) between the first camera and the front, so that this camera never sees the patch."""
SURFACE_DIRECTIONS = 60
"""Directions from which points on an object's surface are sampled."""
SURFACE_RAYS = 130
"""Rays from each of these directions."""
SURFACE_DISTANCE = 20.0
"""Where these rays start, in bounds of the object's radius. From so far away they are nearly parallel."""


class Blueprint(NamedTuple):
    """Parts of an object, the first of which carries the hidden patch within a range of local heights."""

    family: str
    parts: tuple[Part, ...]
    patch_heights: tuple[float, float]


class _Painter:
    """Random colours and patterns of an object: one base hue, and accents of a different hue."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.hue = rng.uniform()
        self.accent = self.hue + rng.uniform(0.25, 0.75)

    def body(self) -> Look:
        """Draw colours and texture of a large part."""
        first = color(self.hue, self.rng.uniform(0.5, 0.85), self.rng.uniform(0.7, 0.95))
        second = color(self.hue + self.rng.uniform(-0.1, 0.1), self.rng.uniform(0.35, 0.7), self.rng.uniform(0.4, 0.65))
        pattern = self.rng.choice([PLAIN, STRIPES, CHECKS, RIPPLES])
        frequency = self.rng.uniform(5.0, 9.0)
        phase = self.rng.uniform(0, 2 * np.pi)
        return np.stack([first, second]), np.array([pattern, frequency, phase])

    def detail(self) -> Look:
        """Draw colours and texture of a small part. Every call draws another shade of the accent."""
        shade = color(self.accent + self.rng.uniform(-0.08, 0.08), self.rng.uniform(0.5, 0.9), self.rng.uniform(0.6, 1))
        return plain_look(shade)


def ball(center: Point, half_sizes: Point | float, look: Look, axes: Array | None = None) -> Part:
    """Make an ellipsoid, or a ball of one radius."""
    sizes = half_sizes if isinstance(half_sizes, tuple) else (half_sizes,) * 3
    return make_part(ELLIPSOID, center, sizes, look, axes)


def _frustum(center: Point, radius: float, half_height: float, look: Look, taper: float = 0.0, axis: str = "y") -> Part:
    rotations = {"y": np.eye(3), "x": rotation_about("z", -np.pi / 2), "z": rotation_about("x", np.pi / 2)}
    return make_part(FRUSTUM, center, (radius, half_height, radius), look, rotations[axis], taper)


def bear(rng: np.random.Generator) -> Blueprint:
    """Draw a sitting bear: body, belly, head with a face, ears, arms, legs. The patch is on its back."""
    paint = _Painter(rng)
    fur = paint.body()
    light = plain_look(color(paint.hue + 0.04, 0.25, 0.95))
    wide = rng.uniform(0.3, 0.38)
    tall = rng.uniform(0.36, 0.44)
    deep = rng.uniform(0.28, 0.34)
    skull = rng.uniform(0.24, 0.3)
    top = tall + 0.7 * skull
    ear = rng.uniform(0.08, 0.13)
    parts = [
        ball((0, 0, 0), (wide, tall, deep), fur),
        ball((0, -0.04, 0.09), (0.72 * wide, 0.74 * tall, 0.82 * deep), light),
        ball((0, top, 0.04), skull, (fur[0], np.array([PLAIN, 0.0, 0.0]))),
        ball((0, top - 0.28 * skull, 0.04 + 0.85 * skull), (0.48 * skull, 0.36 * skull, 0.4 * skull), light),
        ball((0, top - 0.16 * skull, 0.04 + 1.22 * skull), 0.15 * skull, plain_look(DARK)),
    ]
    for side in (-1, 1):
        parts += [
            ball((side * 0.38 * skull, top + 0.25 * skull, 0.04 + 0.87 * skull), 0.14 * skull, plain_look(DARK)),
            ball((side * 0.75 * skull, top + 0.75 * skull, 0.02), (ear, ear, 0.6 * ear), paint.detail()),
            _arm(side, wide, tall, rng, paint),
            ball((side * 0.62 * wide, -0.85 * tall, 0.75 * deep), (0.13, 0.13, rng.uniform(0.2, 0.28)), paint.detail()),
        ]
    return Blueprint("bear", tuple(parts), patch_heights=(-0.95, 0.6))


def _arm(side: int, wide: float, tall: float, rng: np.random.Generator, paint: _Painter) -> Part:
    """Draw an arm from the shoulder, raised and swung forward by random angles."""
    axes = rotation_about("z", side * rng.uniform(0.3, 2.2)) @ rotation_about("x", -rng.uniform(0.1, 0.9))
    length = rng.uniform(0.2, 0.27)
    shoulder = np.array([side * 0.88 * wide, 0.42 * tall, 0.05])
    center = shoulder - axes @ np.array([0, 0.8 * length, 0])
    return ball((center[0], center[1], center[2]), (0.1, length, 0.1), paint.detail(), axes)


def hydrant(rng: np.random.Generator) -> Blueprint:
    """Draw a fire hydrant: base, body, dome, a large outlet in front, two at the sides. The patch is on its back."""
    paint = _Painter(rng)
    radius = rng.uniform(0.22, 0.29)
    half = rng.uniform(0.4, 0.5)
    reach = rng.uniform(0.1, 0.16)
    coat = paint.body()
    ring = paint.detail()
    outlets = half * rng.uniform(0.3, 0.5)
    parts = [
        _frustum((0, 0, 0), radius, half, coat, taper=rng.uniform(-0.15, 0.0)),
        _frustum((0, -half, 0), 1.4 * radius, 0.05, ring),
        _frustum((0, half, 0), 1.2 * radius, 0.045, ring),
        ball((0, half + 0.02, 0), (1.02 * radius, rng.uniform(0.8, 1.1) * radius, 1.02 * radius), paint.body()),
        _frustum((0, half + 0.95 * radius, 0), 0.3 * radius, 0.3 * radius, paint.detail(), taper=-0.15),
        _frustum((0, 0.6 * outlets, radius + 0.4 * reach), 0.6 * radius, reach, coat, axis="z"),
        _frustum((0, 0.6 * outlets, radius + 1.5 * reach), 0.66 * radius, 0.35 * reach, paint.detail(), axis="z"),
    ]
    for side in (-1, 1):
        parts += [
            _frustum((side * (radius + 0.4 * reach), outlets, 0), 0.38 * radius, reach, coat, axis="x"),
            _frustum((side * (radius + 1.5 * reach), outlets, 0), 0.45 * radius, 0.4 * reach, paint.detail(), axis="x"),
        ]
    return Blueprint("hydrant", tuple(parts), patch_heights=(-0.95, 0.8))


FAMILIES = (hydrant, bear)


class ToyScene(NamedTuple):
    """Scene and its cameras (OpenCV axes, [frame 4 4]). `unit` and `origin` place it in an arbitrary world.

    `chances` are the probabilities of `PATCH_COLORS`, given everything except the patch.
    """

    family: str
    patch_color: str
    chances: Array
    shapes: Shapes
    dome: Dome
    light: Light
    patch: Patch
    points: Array
    point_colors: Array
    camera_to_world: Array
    fov_degrees: float
    unit: float
    origin: Array


def draw_object_scene(rng: np.random.Generator, frames: int) -> ToyScene:
    """Draw a random scene and `frames` cameras on one full turn. The patch faces away from the first camera."""
    blueprint = FAMILIES[rng.integers(len(FAMILIES))](rng)
    return _placed(rng, frames, blueprint, _surroundings, tilt=0.0, edge=0.4)


def draw_mini(rng: np.random.Generator, frames: int, marked: bool = False) -> ToyScene:
    """Draw a random mini and `frames` cameras on a full turn that starts in front of the nose."""
    mark = str(rng.choice(list(CHANCES))) if marked else "light"
    half_sizes = rng.uniform(0.36, 0.55, size=3)
    body = plain_look(color(rng.uniform(), rng.uniform(0.1, 0.5), rng.uniform(0.4, 0.9)))
    nose = ball((0, 0, half_sizes[2]), 0.13, plain_look(np.full(3, NOSES[mark])))
    blueprint = Blueprint("mini", (ball((0, 0, 0), tuple(half_sizes), body), nose), patch_heights=(-1, 1))
    # The patch covers normals within 60 degrees of the direction opposite to the nose, tilted down by 0.2 radians.
    return _placed(rng, frames, blueprint, _grey, tilt=0.2, edge=0.5, chances=CHANCES[mark] if marked else EVEN)


def _placed(
    rng: np.random.Generator,
    frames: int,
    blueprint: Blueprint,
    draw_surroundings: Callable[[np.random.Generator], tuple[Dome, Light]],
    tilt: float,
    edge: float,
    chances: Array | None = None,
) -> ToyScene:
    """Return the scene of an object that is turned at random, centred, and scaled to `OBJECT_HALF_SIZE`.

    The first of the cameras is in front of it. The patch faces backwards and down by `tilt` radians, and covers normals
    whose cosine with that direction is above `edge`. `chances` are those of its colour; None: `EVEN`.
    """
    yaw = rng.uniform(0, 2 * np.pi)
    cameras = draw_orbit(rng, frames, start=yaw + rng.uniform(-FROM_THE_FRONT, FROM_THE_FRONT))
    # `rng.choice` uses other random numbers for p=None than for p=EVEN, so each kind of scene keeps to one of the two.
    name = str(rng.choice(list(PATCH_COLORS), p=chances))
    level = np.cos(tilt)
    down = np.sin(tilt)
    facing = -np.array([level * np.sin(yaw), down, level * np.cos(yaw)])
    patch = Patch(facing, np.array(PATCH_COLORS[name]), np.array(blueprint.patch_heights), edge)
    dome, light = draw_surroundings(rng)
    parts = tuple(part.moved(rotation_about("y", yaw), np.zeros(3)) for part in blueprint.parts)
    points, point_colors = _surface(rng, parts, dome, light, patch)
    center = points.mean(axis=0)
    scale = OBJECT_HALF_SIZE / np.abs(points - center).max()
    points = scale * (points - center)
    return ToyScene(
        family=blueprint.family,
        patch_color=name,
        chances=EVEN if chances is None else chances,
        shapes=as_arrays([part.moved(np.eye(3), -center, scale) for part in parts]),
        dome=dome if dome.plain else dome._replace(ground=float(points[:, 1].min())),
        light=light,
        patch=patch,
        points=points,
        point_colors=point_colors,
        camera_to_world=cameras,
        fov_degrees=rng.uniform(36, 40),
        unit=rng.uniform(0.5, 2.0),
        origin=rng.normal(size=3),
    )


def render_frame(scene: ToyScene, frame: int, size: int) -> tuple[Array, Array, Array]:
    """Render the image [size size 3], object coverage and depth [size size] of one frame.

    Pixels average SAMPLES^2 rays. Depth is the middle ray's, along the optical axis, in the scene's own units.
    """
    focal = 0.5 * size / np.tan(np.radians(scene.fov_degrees) / 2)
    rays = camera_rays(focal, focal, size / 2, size / 2, size, size, unit=True)
    pose = scene.camera_to_world[frame]
    colors, coverage, distances = trace(scene.shapes, scene.light, (scene.dome, scene.patch), pose, rays)
    depth = distances * rays[:, SAMPLES**2 // 2, 2]
    return colors.reshape(size, size, 3), coverage.reshape(size, size), depth.reshape(size, size)


def draw_orbit(rng: np.random.Generator, frames: int, start: float) -> Array:
    """Draw `camera_to_world` of evenly spaced, jittered cameras that look near the object's centre."""
    azimuth = start + 2 * np.pi * (np.arange(frames) + rng.uniform(-0.25, 0.25, frames)) / frames
    azimuth[0] = start
    elevation = np.radians(np.clip(rng.uniform(14, 31) + rng.normal(0, 2, frames), 10, 35))
    radius = np.clip(rng.uniform(1.95, 2.25) + rng.normal(0, 0.03, frames), 1.9, 2.3)
    level = np.cos(elevation)
    eyes = radius * np.stack([level * np.sin(azimuth), np.sin(elevation), level * np.cos(azimuth)])
    targets = rng.normal(0, 0.03, (frames, 3))
    world_to_camera = look_at(torch.from_numpy(eyes.T.copy()), torch.from_numpy(targets), UP)
    return invert_rigid(world_to_camera).numpy()


def _surroundings(rng: np.random.Generator) -> tuple[Dome, Light]:
    """Draw a dome of one palette, a ground of two related colours and a light from above. `_placed` sets the height."""
    hue = rng.uniform()
    floor = hue + rng.uniform(0.3, 0.7)
    azimuth = rng.uniform(0, 2 * np.pi)
    height = 0.9 * rng.uniform(0.6, 1.0)
    dome = Dome(
        ground=-np.inf,
        ground_colors=np.stack([color(floor, 0.3, 0.9), color(floor + rng.uniform(-0.06, 0.06), 0.45, 0.55)]),
        ground_texture=np.array([rng.choice([STRIPES, CHECKS]), rng.uniform(3, 5), rng.uniform(0, np.pi)]),
        radius=DOME_RADIUS,
        hue=hue,
        turn=rng.uniform(0, 2 * np.pi),
        plain=False,
    )
    return dome, _sunlight(azimuth, height, rng.uniform(0.5, 0.65))


def _grey(rng: np.random.Generator) -> tuple[Dome, Light]:
    """Draw a plain dome without ground and a light from above."""
    azimuth = rng.uniform(0, 2 * np.pi)
    height = rng.uniform(0.6, 0.9)
    dome = Dome(-np.inf, np.zeros((2, 3)), np.zeros(3), DOME_RADIUS, hue=0.0, turn=0.0, plain=True)
    return dome, _sunlight(azimuth, height, rng.uniform(0.6, 0.7))


def _sunlight(azimuth: float, height: float, ambient: float) -> Light:
    """Return light from the direction with this azimuth, `height` being the sine of its elevation."""
    level = np.sqrt(1 - height**2)
    direction = np.array([level * np.sin(azimuth), height, level * np.cos(azimuth)])
    return Light(direction, is_point=False, ambient=ambient, sky=0.25, shadow=0.35)


def _surface(
    rng: np.random.Generator, parts: tuple[Part, ...], dome: Dome, light: Light, patch: Patch
) -> tuple[Array, Array]:
    """Sample points on the object that are visible from above, and their colours, by random, nearly parallel rays."""
    shapes = as_arrays(parts)
    reach = max(map(_farthest_point, parts))
    points = []
    colors = []
    for _ in range(SURFACE_DIRECTIONS):
        azimuth = rng.uniform(0, 2 * np.pi)
        height = rng.uniform(0, 1)
        level = np.sqrt(1 - height**2)
        outwards = torch.tensor([level * np.sin(azimuth), height, level * np.cos(azimuth)], dtype=torch.float64)
        pose = invert_rigid(look_at(SURFACE_DISTANCE * reach * outwards, torch.zeros_like(outwards), UP)).numpy()
        angle = rng.uniform(0, 2 * np.pi, SURFACE_RAYS)
        radius = np.sqrt(rng.uniform(0, 1, SURFACE_RAYS))
        ahead = np.full(SURFACE_RAYS, SURFACE_DISTANCE)
        rays = np.stack([radius * np.cos(angle), radius * np.sin(angle), ahead], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        traced, coverage, distances = trace(shapes, light, (dome, patch), pose, rays[:, None])
        points.append((pose[:3, 3] + distances[:, None] * rays @ pose[:3, :3].T)[coverage > 0])
        colors.append(traced[coverage > 0])
    return np.concatenate(points), np.concatenate(colors)


def _farthest_point(part: Part) -> float:
    """Return an upper bound of the distance from the origin to any point of a part."""
    corner = 1.0 if part.kind == ELLIPSOID else float(np.hypot(1 + abs(part.taper), 1.0))
    return float(np.linalg.norm(part.center) + corner * part.half_sizes.max())
