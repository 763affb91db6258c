"""Random toy scenes: an object of one of two families, its surroundings, a hidden patch, and an orbit of cameras."""

import colorsys
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeVar

import numpy as np
import torch

from completesplat.data.toy.raytracing import (
    CHECKS,
    ELLIPSOID,
    FRUSTUM,
    PLAIN,
    RIPPLES,
    STRIPES,
    Array,
    Geometry,
    Patch,
    Surroundings,
    trace,
)
from completesplat.geometry.cameras import invert_rigid, look_at

P = TypeVar("P", bound="Part")
Look = tuple[Array, Array]
Point = tuple[float, float, float]

DARK = np.full(3, 0.07)


@dataclass(frozen=True)
class Part:
    """Ellipsoid or frustum: centre, half sizes along its own axes, directions of the axes (columns), and texture."""

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

    def reach(self) -> float:
        """Return an upper bound of the distance from the origin to any point of the part."""
        unit = 1.0 if self.kind == ELLIPSOID else float(np.hypot(1 + abs(self.taper), 1.0))
        return float(np.linalg.norm(self.center) + unit * self.half_sizes.max())

    def moved(self: P, rotation: Array, shift: Array, scale: float = 1.0) -> P:
        """Return the part after rotation, then shift, then scaling of the object."""
        center = scale * (rotation @ self.center + shift)
        return replace(self, center=center, half_sizes=scale * self.half_sizes, axes=rotation @ self.axes)


@dataclass(frozen=True)
class Blueprint:
    """Parts of an object, the part that carries the hidden patch, and the local heights that the patch may cover."""

    family: str
    parts: tuple[Part, ...]
    patched_part: int
    patch_heights: tuple[float, float]


def geometry(parts: tuple[Part, ...]) -> Geometry:
    """Convert parts to arrays for the ray tracer."""
    return Geometry(
        kinds=np.array([part.kind for part in parts]),
        to_local=np.stack([part.to_local() for part in parts]),
        tapers=np.array([part.taper for part in parts]),
        colors=np.stack([part.colors for part in parts]),
        textures=np.stack([part.texture for part in parts]),
        bounding_radius=max(part.reach() for part in parts),
    )


def rotation_about(axis: str, radians: float) -> Array:
    """Return the rotation matrix about a coordinate axis; about y it turns +z towards +x."""
    cos, sin = np.cos(radians), np.sin(radians)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = cos
    matrix[j, i], matrix[i, j] = sin, -sin
    return matrix


def color(hue: float, saturation: float, value: float) -> Array:
    """Return the sRGB colour of a hue (in turns, wrapped), saturation and value."""
    return np.array(colorsys.hsv_to_rgb(hue % 1.0, saturation, value))


class _Painter:
    """Random colours and patterns of an object: one base hue, and other hues for accents."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.hue = rng.uniform()
        self.accent = self.hue + rng.uniform(0.25, 0.75)

    def body(self) -> Look:
        """Draw colours and texture of a large part."""
        first = color(self.hue, self.rng.uniform(0.5, 0.85), self.rng.uniform(0.7, 0.95))
        second = color(self.hue + self.rng.uniform(-0.1, 0.1), self.rng.uniform(0.35, 0.7), self.rng.uniform(0.4, 0.65))
        pattern = self.rng.choice([PLAIN, STRIPES, CHECKS, RIPPLES])
        frequency, phase = self.rng.uniform(5.0, 9.0), self.rng.uniform(0, 2 * np.pi)
        return np.stack([first, second]), np.array([pattern, frequency, phase])

    def detail(self) -> Look:
        """Draw colours and texture of a small part; every call draws another shade of the accent."""
        shade = color(self.accent + self.rng.uniform(-0.08, 0.08), self.rng.uniform(0.5, 0.9), self.rng.uniform(0.6, 1))
        return plain(shade)


def plain(shade: Array) -> Look:
    """Return the look of one colour without a pattern."""
    return np.stack([shade, shade]), np.array([PLAIN, 0.0, 0.0])


def ball(center: Point, half_sizes: object, look: Look, axes: Array | None = None) -> Part:
    sizes = np.broadcast_to(np.asarray(half_sizes, dtype=np.float64), 3)
    return Part(ELLIPSOID, np.array(center, dtype=np.float64), sizes, np.eye(3) if axes is None else axes, 0.0, *look)


def _frustum(center: Point, radius: float, half_height: float, look: Look, taper: float = 0.0, axis: str = "y") -> Part:
    axes = {"y": np.eye(3), "x": rotation_about("z", -np.pi / 2), "z": rotation_about("x", np.pi / 2)}[axis]
    return Part(
        FRUSTUM, np.array(center, dtype=np.float64), np.array([radius, half_height, radius]), axes, taper, *look
    )


def bear(rng: np.random.Generator) -> Blueprint:
    """Draw a sitting bear: body, belly, head with a face, ears, arms, legs; the patch is on its back."""
    paint = _Painter(rng)
    fur = paint.body()
    light = plain(color(paint.hue + 0.04, 0.25, 0.95))
    wide, tall, deep = rng.uniform(0.3, 0.38), rng.uniform(0.36, 0.44), rng.uniform(0.28, 0.34)
    skull = rng.uniform(0.24, 0.3)
    top = tall + 0.7 * skull
    ear = rng.uniform(0.08, 0.13)
    parts = [
        ball((0, 0, 0), (wide, tall, deep), fur),
        ball((0, -0.04, 0.09), (0.72 * wide, 0.74 * tall, 0.82 * deep), light),
        ball((0, top, 0.04), skull, (fur[0], np.array([PLAIN, 0.0, 0.0]))),
        ball((0, top - 0.28 * skull, 0.04 + 0.85 * skull), (0.48 * skull, 0.36 * skull, 0.4 * skull), light),
        ball((0, top - 0.16 * skull, 0.04 + 1.22 * skull), 0.15 * skull, plain(DARK)),
    ]
    for side in (-1, 1):
        parts += [
            ball((side * 0.38 * skull, top + 0.25 * skull, 0.04 + 0.87 * skull), 0.14 * skull, plain(DARK)),
            ball((side * 0.75 * skull, top + 0.75 * skull, 0.02), (ear, ear, 0.6 * ear), paint.detail()),
            _arm(side, wide, tall, rng, paint),
            ball((side * 0.62 * wide, -0.85 * tall, 0.75 * deep), (0.13, 0.13, rng.uniform(0.2, 0.28)), paint.detail()),
        ]
    return Blueprint("bear", tuple(parts), patched_part=0, patch_heights=(-0.95, 0.6))


def _arm(side: int, wide: float, tall: float, rng: np.random.Generator, paint: _Painter) -> Part:
    """Draw an arm from the shoulder, raised and swung forward by random angles."""
    axes = rotation_about("z", side * rng.uniform(0.3, 2.2)) @ rotation_about("x", -rng.uniform(0.1, 0.9))
    length = rng.uniform(0.2, 0.27)
    shoulder = np.array([side * 0.88 * wide, 0.42 * tall, 0.05])
    center = shoulder - axes @ np.array([0, 0.8 * length, 0])
    return ball((center[0], center[1], center[2]), (0.1, length, 0.1), paint.detail(), axes)


def hydrant(rng: np.random.Generator) -> Blueprint:
    """Draw a fire hydrant: base, body, dome, a large outlet in front, two at the sides; the patch is on its back."""
    paint = _Painter(rng)
    radius, half = rng.uniform(0.22, 0.29), rng.uniform(0.4, 0.5)
    reach = rng.uniform(0.1, 0.16)
    coat, ring = paint.body(), paint.detail()
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
    return Blueprint("hydrant", tuple(parts), patched_part=0, patch_heights=(-0.95, 0.8))


FAMILIES = (hydrant, bear)


OBJECT_HALF_SIZE = 0.57
DOME_RADIUS = 3.5
SURFACE_DIRECTIONS, SURFACE_RAYS = 60, 130
PATCH_COLORS = {
    "red": (0.9, 0.08, 0.1),
    "green": (0.1, 0.7, 0.2),
    "blue": (0.1, 0.25, 0.9),
    "yellow": (0.98, 0.85, 0.1),
}
SAMPLES = 3
UP = torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64)


@dataclass(frozen=True)
class ToyScene:
    """Scene and its cameras (OpenCV axes, [frame 4 4]); `unit` and `origin` place it in an arbitrary world.

    `chances` are the probabilities of `PATCH_COLORS`, given everything except the patch.
    """

    family: str
    patch_color: str
    chances: Array
    geometry: Geometry
    surroundings: Surroundings
    patch: Patch
    points: Array
    point_colors: Array
    camera_to_world: Array
    fov_degrees: float
    unit: float
    origin: Array


def draw_scene(rng: np.random.Generator, frames: int) -> ToyScene:
    """Draw a random scene and `frames` cameras on one full turn; the patch faces away from the first camera."""
    blueprint = FAMILIES[rng.integers(len(FAMILIES))](rng)
    yaw = rng.uniform(0, 2 * np.pi)
    cameras = orbit(rng, frames, start=yaw + rng.uniform(-0.35, 0.35))
    away = -np.array([np.sin(yaw), 0, np.cos(yaw)])
    chances = np.full(len(PATCH_COLORS), 1 / len(PATCH_COLORS))
    name = str(rng.choice(list(PATCH_COLORS)))
    facing, heights = away / np.linalg.norm(away), np.array(blueprint.patch_heights)
    patch = Patch(blueprint.patched_part, facing, np.array(PATCH_COLORS[name]), heights, edge=0.4, rim=0.4)
    return placed(rng, blueprint, yaw, cameras, _surroundings(rng), patch, name, chances)


def placed(
    rng: np.random.Generator,
    blueprint: Blueprint,
    yaw: float,
    cameras: Array,
    surroundings: Surroundings,
    patch: Patch,
    patch_color: str,
    chances: Array,
) -> ToyScene:
    """Return the scene of an object that is turned by `yaw`, centred, and scaled to `OBJECT_HALF_SIZE`."""
    parts = tuple(part.moved(rotation_about("y", yaw), np.zeros(3)) for part in blueprint.parts)
    points, point_colors = _surface(rng, parts, surroundings, patch)
    center = points.mean(axis=0)
    scale = OBJECT_HALF_SIZE / np.abs(points - center).max()
    points = scale * (points - center)
    ground = -np.inf if surroundings.plain else float(points[:, 1].min())
    return ToyScene(
        family=blueprint.family,
        patch_color=patch_color,
        chances=chances,
        geometry=geometry(tuple(part.moved(np.eye(3), -center, scale) for part in parts)),
        surroundings=surroundings._replace(ground=ground),
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
    rays = _camera_rays(scene.fov_degrees, size)
    pose = scene.camera_to_world[frame]
    colors, coverage, distances = trace(scene.geometry, scene.surroundings, scene.patch, pose, rays)
    depth = distances * rays[:, SAMPLES**2 // 2, 2]
    return colors.reshape(size, size, 3), coverage.reshape(size, size), depth.reshape(size, size)


@lru_cache(maxsize=1)
def _camera_rays(fov_degrees: float, size: int) -> Array:
    """Return unit rays [pixel sample 3] in the camera's frame, in rows of pixels from the top."""
    centers = (np.arange(size * SAMPLES) + 0.5) / SAMPLES - size / 2
    v, u = (axis.reshape(size, SAMPLES, size, SAMPLES).swapaxes(1, 2) for axis in np.meshgrid(centers, centers)[::-1])
    rays = np.stack([u, v, np.full_like(u, 0.5 * size / np.tan(np.radians(fov_degrees) / 2))], axis=-1)
    units: Array = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return units.reshape(size * size, SAMPLES**2, 3)


def orbit(rng: np.random.Generator, frames: int, start: float) -> Array:
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


def _surroundings(rng: np.random.Generator) -> Surroundings:
    """Draw a dome of one palette, a ground of two related colours and a light from above; `placed` sets the height."""
    hue = rng.uniform()
    floor = hue + rng.uniform(0.3, 0.7)
    azimuth, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.6, 1.0)
    level = np.sqrt(1 - (height * 0.9) ** 2)
    return Surroundings(
        ground=-np.inf,
        ground_colors=np.stack([color(floor, 0.3, 0.9), color(floor + rng.uniform(-0.06, 0.06), 0.45, 0.55)]),
        ground_texture=np.array([rng.choice([STRIPES, CHECKS]), rng.uniform(3, 5), rng.uniform(0, np.pi)]),
        dome_radius=DOME_RADIUS,
        hue=hue,
        turn=rng.uniform(0, 2 * np.pi),
        plain=False,
        light=np.array([level * np.sin(azimuth), height * 0.9, level * np.cos(azimuth)]),
        ambient=rng.uniform(0.5, 0.65),
    )


def _surface(
    rng: np.random.Generator, parts: tuple[Part, ...], surroundings: Surroundings, patch: Patch
) -> tuple[Array, Array]:
    """Sample points on the object that are visible from above, and their colours, by random, nearly parallel rays."""
    shape = geometry(parts)
    points, colors = [], []
    for _ in range(SURFACE_DIRECTIONS):
        azimuth, height = rng.uniform(0, 2 * np.pi), rng.uniform(0, 1)
        level = np.sqrt(1 - height**2)
        outwards = torch.tensor([level * np.sin(azimuth), height, level * np.cos(azimuth)], dtype=torch.float64)
        pose = invert_rigid(look_at(20 * shape.bounding_radius * outwards, torch.zeros_like(outwards), UP)).numpy()
        angle, radius = rng.uniform(0, 2 * np.pi, SURFACE_RAYS), np.sqrt(rng.uniform(0, 1, SURFACE_RAYS))
        rays = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(SURFACE_RAYS, 20.0)], axis=-1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        seen, coverage, distances = trace(shape, surroundings, patch, pose, rays[:, None])
        points.append((pose[:3, 3] + distances[:, None] * rays @ pose[:3, :3].T)[coverage > 0])
        colors.append(seen[coverage > 0])
    return np.concatenate(points), np.concatenate(colors)
