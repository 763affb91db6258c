"""Draws one toy scene: an object, its surroundings, a hidden patch and an orbit of cameras.

Lengths are chosen so that the object's point cloud, centred on its mean, reaches 0.57 along some axis; cameras circle
at about 2.1, the dome stands at 3.5. The CO3D reader, which turns and centres the cloud anew, brings scenes to 1.00 to
1.14 times that size (40 scenes, median 1.04).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch

from completesplat.data.toy.ingredients import BANDS, CHECKS, Array, Geometry, Patch, Surroundings
from completesplat.data.toy.raytracing import trace
from completesplat.data.toy.shapes import FAMILIES, Part, color, geometry, rotation_about
from completesplat.geometry.cameras import invert_rigid, look_at

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
    """A scene and its cameras (OpenCV axes, [frame 4 4]); `unit` and `origin` place it in an arbitrary world."""

    family: str
    patch_color: str
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
    """A random scene seen by `frames` cameras, one full turn; the patch faces away from the first of them."""
    blueprint = FAMILIES[rng.integers(len(FAMILIES))](rng)
    yaw = rng.uniform(0, 2 * np.pi)
    cameras = _orbit(rng, frames, start=yaw + rng.uniform(-0.8, 0.8))
    away = cameras[0, :3, 3] * np.array([-1, 0, -1])
    name = str(rng.choice(list(PATCH_COLORS)))
    facing, heights = away / np.linalg.norm(away), np.array(blueprint.patch_heights)
    patch = Patch(blueprint.patched_part, facing, np.array(PATCH_COLORS[name]), heights)
    surroundings = _surroundings(rng)
    parts = tuple(part.moved(rotation_about("y", yaw), np.zeros(3), 1.0) for part in blueprint.parts)
    points, point_colors = _surface(rng, parts, surroundings, patch)
    center = points.mean(axis=0)
    scale = OBJECT_HALF_SIZE / np.abs(points - center).max()
    points = scale * (points - center)
    return ToyScene(
        family=blueprint.family,
        patch_color=name,
        geometry=geometry(tuple(part.moved(np.eye(3), -center, scale) for part in parts)),
        surroundings=surroundings._replace(ground=float(points[:, 1].min())),
        patch=patch,
        points=points,
        point_colors=point_colors,
        camera_to_world=cameras,
        fov_degrees=rng.uniform(36, 40),
        unit=rng.uniform(0.5, 2.0),
        origin=rng.normal(size=3),
    )


def render_frame(scene: ToyScene, frame: int, size: int) -> tuple[Array, Array, Array]:
    """Picture [size size 3], object coverage and depth [size size] of one frame.

    Pixels average SAMPLES^2 rays. Depth is the middle ray's, along the optical axis, in the scene's own lengths.
    """
    rays = _camera_rays(scene.fov_degrees, size)
    pose = scene.camera_to_world[frame]
    colors, coverage, distances = trace(scene.geometry, scene.surroundings, scene.patch, pose, rays)
    depth = distances * rays[:, SAMPLES**2 // 2, 2]
    return colors.reshape(size, size, 3), coverage.reshape(size, size), depth.reshape(size, size)


@lru_cache(maxsize=1)
def _camera_rays(fov_degrees: float, size: int) -> Array:
    """Unit rays in the camera's frame, [pixel sample 3], rows of pixels from the top."""
    centers = (np.arange(size * SAMPLES) + 0.5) / SAMPLES - size / 2
    v, u = (axis.reshape(size, SAMPLES, size, SAMPLES).swapaxes(1, 2) for axis in np.meshgrid(centers, centers)[::-1])
    rays = np.stack([u, v, np.full_like(u, 0.5 * size / np.tan(np.radians(fov_degrees) / 2))], axis=-1)
    return (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(size * size, SAMPLES**2, 3)


def _orbit(rng: np.random.Generator, frames: int, start: float) -> Array:
    """`camera_to_world` of evenly spaced, jittered cameras that look about at the object's centre."""
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
    """A dome of one palette, a ground in two related colours, a light from above; the ground's height comes later."""
    hue = rng.uniform()
    floor = hue + rng.uniform(0.3, 0.7)
    azimuth, height = rng.uniform(0, 2 * np.pi), rng.uniform(0.6, 1.0)
    level = np.sqrt(1 - (height * 0.9) ** 2)
    return Surroundings(
        ground=-np.inf,
        ground_colors=np.stack([color(floor, 0.3, 0.9), color(floor + rng.uniform(-0.06, 0.06), 0.45, 0.55)]),
        ground_texture=np.array([rng.choice([BANDS, CHECKS]), rng.uniform(3, 5), rng.uniform(0, np.pi)]),
        dome_radius=DOME_RADIUS,
        hue=hue,
        turn=rng.uniform(0, 2 * np.pi),
        light=np.array([level * np.sin(azimuth), height * 0.9, level * np.cos(azimuth)]),
        ambient=rng.uniform(0.5, 0.65),
    )


def _surface(
    rng: np.random.Generator, parts: tuple[Part, ...], surroundings: Surroundings, patch: Patch
) -> tuple[Array, Array]:
    """Points on the object that can be seen from above, with their colours: hits of random, nearly parallel rays."""
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
