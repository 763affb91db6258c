"""Images of textured meshes without Blender: z-buffer, sun with soft shadows, sky, ground and walls.

It draws the jobs of `draw_rendered_scene`, as `_scene_script.py` does in Blender, and writes the same files. It leaves
out highlights, metal, glass, and light from surface to surface other than from the ground.
"""

import math
import time
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int
from PIL import Image

from completesplat.data.rendered.assets import BrokenMesh
from completesplat.data.rendered.mesh_reading import TexturedMesh, read_mesh, to_srgb
from completesplat.data.rendered.surroundings import Plane, surface_colors, surface_mean, surroundings
from completesplat.data.rendered.z_buffer import NOTHING, draw_rectangles, draw_triangles, light_share, look_up

SHADOW_SIDE = 1024  # pixels of the object's depth from the sun
SHADOW_SAMPLES = 16
SHADOW_BIAS = 0.01
SKY_STEPS = 48  # directions of each angle over which the sky's light is added up
NORMAL_STEPS = 33
SKY_DEPTH = 1e10  # where no surface is
DISTANT = 1000.0  # of the sun, whose rays are then nearly parallel
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class Lighting:
    """Sun and sky, in linear light.

    Attributes:
        toward_sun: unit vector.
        sun: radiance of a white surface that faces the sun.
        sky: colours of the sky at the horizon and at the zenith.
        ambient: radiance of a white surface by the z of its normal, from -1 to 1.
        shadow: depth of the object from the sun.
    """

    toward_sun: Float[np.ndarray, " 3"]
    sun: Float[np.ndarray, " 3"]
    softness: float
    sky: Float[np.ndarray, "2 3"]
    ambient: Float[np.ndarray, "step 3"]
    shadow: Float[np.ndarray, "side side"]
    axes: Float[np.ndarray, "3 3"]


def draw_job(job: dict[str, Any], stopped: Event, minutes: float = math.inf) -> dict[str, Any]:
    """Draw all views of a job's mesh into the job's folder; return the object's place and scale.

    For each view the files are `NNNN.png`, the colours, and `NNNN.npy`, float32 [height width 3]: depth along the
    optical axis, 1 where the pixel's centre shows the object, and the object's coverage of the pixel. With paints for
    the back, `K_NNNN.png` has the colours with paint K, and `NNNN.png` those with paint 0.

    Args:
        stopped: an event after which no further view is drawn.
        minutes: time after which no further view is drawn.

    Raises:
        BrokenMesh: the mesh cannot be drawn, or not in this time.
    """
    end = time.monotonic() + 60 * minutes
    mesh = read_mesh(Path(job["mesh"]), Path(job["root"]), job["up"])
    planes = surroundings(job, float(mesh.corners[..., 2].min()))
    lighting = light_of(job["light"], mesh, planes)
    folder = Path(job["folder"])
    hidden = job["hidden"]
    paints = hidden["colors"] if hidden else [None]
    samples = max(1, round(math.sqrt(job["samples"])))
    back = painted_triangles(mesh, hidden) if hidden else np.zeros(len(mesh.corners), bool)
    for number, view in enumerate(job["views"]):
        if stopped.is_set() or time.monotonic() > end:
            raise BrokenMesh(f"took longer than max_minutes={minutes:g}")
        scene = _Scene(mesh, lighting, planes, back)
        depth, seen = scene.geometry(view)
        for index, paint in enumerate(paints):
            image, coverage = scene.image(view, samples, paint)
            prefix = f"{index}_" if index else ""
            encoded = np.round(255 * to_srgb(image)).astype(np.uint8)
            Image.fromarray(encoded).save(folder / f"{prefix}{number:04d}.png")
        np.save(folder / f"{number:04d}.npy", np.stack([depth, seen, coverage], axis=-1).astype(np.float32))
    return {"center": mesh.center.tolist(), "scale": mesh.scale, "left_out": mesh.left_out, "beyond": mesh.beyond}


def painted_triangles(mesh: TexturedMesh, hidden: dict[str, Any]) -> Bool[np.ndarray, " triangle"]:
    """Return the triangles that point away from the first camera (as `_scene_script.paint_back`)."""
    crosses = np.cross(mesh.corners[:, 1] - mesh.corners[:, 0], mesh.corners[:, 2] - mesh.corners[:, 0])
    normals = crosses / np.maximum(np.linalg.norm(crosses, axis=1, keepdims=True), 1e-300)
    away: Bool[np.ndarray, " triangle"] = normals @ np.array(hidden["toward"]) < -hidden["least"]
    return away


def light_of(light: dict[str, Any], mesh: TexturedMesh, planes: list[Plane]) -> Lighting:
    """Return the light of a job with what each surface receives of it."""
    elevation = light["elevation"]
    azimuth = light["azimuth"]
    level = math.cos(elevation)
    toward = np.array([level * math.sin(azimuth), -level * math.cos(azimuth), math.sin(elevation)])
    # An axis that is not along the sun's rays, and two across them.
    helper = np.eye(3)[np.abs(toward).argmin()]
    across = np.cross(toward, helper)
    across = across / np.linalg.norm(across)
    axes = np.stack([across, np.cross(toward, across), -toward])
    sun = np.array(light["color"]) * light["strength"] / math.pi
    sky = np.array(light["sky"])
    bounce = None
    if planes:
        above = ambient_light(sky, None)[-1]
        bounce = surface_mean(planes[0]) * (above + sun * math.sin(elevation))
    shadow = _depth_from(axes, mesh)
    return Lighting(toward, sun, math.tan(light["angle"] / 2), sky, ambient_light(sky, bounce), shadow, axes)


def ambient_light(sky: Float[np.ndarray, "2 3"], ground: Float[np.ndarray, " 3"] | None) -> Float[np.ndarray, "step 3"]:
    """Return the radiance of white surfaces under the sky alone, by the z of their normals.

    Args:
        sky: colours at the horizon, which it has below it, too, and at the zenith; between them, linear in z.
        ground: colour of all directions below the horizon instead.
    """
    heights = (np.arange(2 * SKY_STEPS) + 0.5) / SKY_STEPS - 1
    azimuths = 2 * np.pi * (np.arange(SKY_STEPS) + 0.5) / SKY_STEPS
    share = heights.clip(0, 1)[:, None]
    radiance = (1 - share) * sky[0] + share * sky[1]
    if ground is not None:
        radiance[heights < 0] = ground
    normals = np.linspace(-1, 1, NORMAL_STEPS)
    level = np.sqrt(1 - normals**2)[:, None, None] * np.sqrt(1 - heights**2)[:, None] * np.cos(azimuths)
    cosines = (normals[:, None, None] * heights[:, None] + level).clip(0, None).mean(-1)
    # The mean over the sphere of radiance times cosine is a quarter of what a white surface returns.
    return 4 * (cosines[..., None] * radiance).mean(1)


def _depth_from(axes: Float[np.ndarray, "3 3"], mesh: TexturedMesh) -> Float[np.ndarray, "side side"]:
    """Return the object's depth along parallel rays, over the square from -1 to 1."""
    points = mesh.corners @ axes.T
    points[..., :2] = (points[..., :2] + 1) * (SHADOW_SIDE / 2)
    points[..., 2] += DISTANT
    shape = (SHADOW_SIDE, SHADOW_SIDE)
    depth = np.full(shape, np.inf)
    # Weights are for a perspective, and only textures use them.
    buffers = np.empty(shape, np.int64), np.empty((*shape, 2)), depth
    textures = mesh.textures
    draw_triangles(points, mesh.uv, mesh.texture, textures.texels, textures.levels, False, *buffers)
    return depth - DISTANT


class _Scene:
    """One object in its surroundings, drawn from one camera at a time."""

    def __init__(
        self, mesh: TexturedMesh, lighting: Lighting, planes: list[Plane], back: Bool[np.ndarray, " triangle"]
    ) -> None:
        self.mesh = mesh
        self.lighting = lighting
        self.planes = planes
        self.back = back

    def geometry(self, view: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return depth and whether the object is seen, at the pixels' centres."""
        camera = _Camera(view, 1)
        triangles, _, depth = self._visible(camera)
        _, distance = camera.nearest(self.planes)
        depth = np.minimum(depth, distance)
        return np.where(np.isfinite(depth), depth, SKY_DEPTH), triangles != NOTHING

    def image(
        self, view: dict[str, Any], samples: int, paint: list[float] | None
    ) -> tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"]]:
        """Return linear colours and the object's coverage, each the mean of samples x samples a pixel."""
        camera = _Camera(view, samples)
        triangles, weights, depth = self._visible(camera)
        numbers, distance = camera.nearest(self.planes)
        seen = depth <= distance
        seen &= triangles != NOTHING
        numbers[seen] = NOTHING
        colors = np.empty((*camera.shape, 3))
        empty = (numbers == NOTHING) & ~seen
        colors[empty] = self._sky(camera.rays[empty])
        for index, plane in enumerate(self.planes):
            shown = numbers == index
            colors[shown] = self._lit_plane(camera, plane, camera.rays[shown], distance[shown])
        rays = camera.rays[seen]
        colors[seen] = self._lit_object(camera, triangles[seen], weights[seen], depth[seen], rays, paint)
        height, width = view["size"][::-1]
        blocks = colors.clip(0, 1).reshape(height, samples, width, samples, 3)
        return blocks.mean((1, 3)), seen.reshape(height, samples, width, samples).mean((1, 3))

    def _visible(self, camera: "_Camera") -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        mesh = self.mesh
        triangles = np.full(camera.shape, NOTHING, np.int64)
        weights = np.empty((*camera.shape, 2))
        depth = np.full(camera.shape, np.inf)
        buffers = (triangles, weights, depth)
        textures = mesh.textures
        points = camera.projected(mesh.corners)
        draw_triangles(points, mesh.uv, mesh.texture, textures.texels, textures.levels, mesh.cut, *buffers)
        return buffers

    def _sky(self, rays: Float[np.ndarray, "ray 3"]) -> Float[np.ndarray, "ray 3"]:
        heights = rays[:, 2] / np.linalg.norm(rays, axis=-1)
        share = heights.clip(0, 1)[..., None]
        horizon, zenith = self.lighting.sky
        return (1 - share) * horizon + share * zenith

    def _lit_plane(
        self, camera: "_Camera", plane: Plane, rays: Float[np.ndarray, "sample 3"], distance: np.ndarray
    ) -> Float[np.ndarray, "sample 3"]:
        places = camera.eye + distance[:, None] * rays
        lengths = np.linalg.norm(plane.sides, axis=1)
        uv = (places - plane.corner) @ (plane.sides / lengths[:, None]).T
        normal = plane.normal
        cosine = np.abs(rays @ normal) / np.linalg.norm(rays, axis=1)
        colors = surface_colors(plane, uv, distance / camera.focal / np.maximum(cosine, 0.05))
        toward = np.where((rays @ normal)[:, None] > 0, -normal, normal)
        return colors * self._received(places, toward)

    def _lit_object(
        self,
        camera: "_Camera",
        triangles: np.ndarray,
        weights: np.ndarray,
        depth: np.ndarray,
        rays: Float[np.ndarray, "sample 3"],
        paint: list[float] | None,
    ) -> Float[np.ndarray, "sample 3"]:
        mesh = self.mesh
        rest = 1 - weights.sum(-1, keepdims=True)
        shares = np.concatenate([rest, weights], axis=-1)[:, None]
        uv = (shares @ mesh.uv[triangles])[:, 0]
        colors = np.empty((len(triangles), 3))
        area = camera.texture_area(mesh.corners, mesh.uv, triangles)
        look_up(mesh.textures.texels, mesh.textures.levels, mesh.texture[triangles], uv, area, colors)
        colors *= (shares @ mesh.colors[triangles])[:, 0]
        if paint is not None:
            colors[self.back[triangles]] = paint
        normals = (shares @ mesh.normals[triangles])[:, 0]
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        normals = np.where((normals * rays).sum(1, keepdims=True) > 0, -normals, normals)
        return colors * self._received(camera.eye + depth[:, None] * rays, normals)

    def _received(
        self, places: Float[np.ndarray, "place 3"], normals: Float[np.ndarray, "place 3"]
    ) -> Float[np.ndarray, "place 3"]:
        """Return the radiance of white surfaces at places."""
        light = self.lighting
        steps = np.linspace(-1, 1, NORMAL_STEPS)
        ambient = np.stack([np.interp(normals[:, 2], steps, light.ambient[:, k]) for k in range(3)], axis=-1)
        cosines = (normals @ light.toward_sun).clip(0, None)
        shares = np.empty(len(places))
        angles = GOLDEN_ANGLE * np.arange(SHADOW_SAMPLES)
        radii = np.sqrt((np.arange(SHADOW_SAMPLES) + 0.5) / SHADOW_SAMPLES)
        offsets = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        in_sun = places @ light.axes.T
        light_share(in_sun, light.shadow, 1.0, light.softness, offsets, SHADOW_BIAS, shares)
        return ambient + (cosines * shares)[:, None] * light.sun


class _Camera:
    """Pinhole of a job's view, with samples x samples rays a pixel."""

    def __init__(self, view: dict[str, Any], samples: int) -> None:
        matrix = np.array(view["world_to_camera"])
        self.rotation = matrix[:3, :3]
        self.shift = matrix[:3, 3]
        self.eye = -self.rotation.T @ self.shift
        self.focal = view["focal"] * samples
        self.center = np.array(view["center"]) * samples
        width, height = (side * samples for side in view["size"])
        self.shape = height, width
        x = (np.arange(width) + 0.5 - self.center[0]) / self.focal
        y = (np.arange(height) + 0.5 - self.center[1]) / self.focal
        directions = np.stack(np.broadcast_arrays(x[None], y[:, None], 1.0), axis=-1)
        self.rays = directions @ self.rotation
        """World directions [height width 3] whose length along the optical axis is 1."""

    def projected(self, corners: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3"]:
        """Return x and y in samples, and depth."""
        points = corners @ self.rotation.T + self.shift
        depth = points[..., 2:]
        safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
        return np.concatenate([points[..., :2] / safe * self.focal + self.center, depth], axis=-1)

    def nearest(self, planes: list[Plane]) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
        """Return the number of the nearest plane at each sample, or `NOTHING`, and its depth, or infinity."""
        numbers = np.full(self.shape, NOTHING, np.int64)
        depth = np.full(self.shape, np.inf)
        rectangles = np.array([plane.described() for plane in planes]).reshape(-1, 4, 3)
        draw_rectangles(self.eye, self.rotation, self.focal, self.center, rectangles, numbers, depth)
        return numbers, depth

    def texture_area(self, corners: np.ndarray, uv: np.ndarray, triangles: np.ndarray) -> np.ndarray:
        """Return for each sample the area in texture coordinates that it covers on its triangle."""
        used, inverse = np.unique(triangles, return_inverse=True)
        points = self.projected(corners[used])[..., :2]
        on_image = np.abs(_crosses(points))
        on_texture = np.abs(_crosses(uv[used]))
        return (on_texture / np.maximum(on_image, 1e-12))[inverse.reshape(-1)]


def _crosses(points: Float[np.ndarray, "triangle 3 2"]) -> Float[np.ndarray, " triangle"]:
    first = points[:, 1] - points[:, 0]
    second = points[:, 2] - points[:, 0]
    product: Float[np.ndarray, " triangle"] = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return product
