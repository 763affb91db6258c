"""Images of textured meshes without Blender: z-buffer, sun with soft shadows, sky, ground and walls.

It draws the jobs of `draw_rendered_scene`, as `_scene_script.py` does in Blender, and writes the same files. It leaves
out highlights, metal, glass, and light from surface to surface other than from floor and walls.
"""

import math
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image

from completesplat.data.rendered.assets import BrokenMesh
from completesplat.data.rendered.mesh_reading import TexturedMesh, read_mesh, to_srgb
from completesplat.data.rendered.shading import LightArrays, Planes, Surfaces, View, draw_planes, shade
from completesplat.data.rendered.surroundings import mean_color, surroundings
from completesplat.data.rendered.z_buffer import NOTHING, draw_triangles

SHADOW_SIDE = 1024  # pixels of the object's depth from the sun
SHADOW_SAMPLES = 16
BLOCK = 32  # pixels of a block's side, of which the least depth is known
SKY_STEPS = 48  # directions of each angle over which the sky's light is added up
NORMAL_STEPS = 33
SKY_DEPTH = 1e10  # where no surface is
BOUNCES = 4  # of light between floor and walls, as in Blender
WALL_TOP = 0.87  # z of the direction to the upper edge of a room's walls, from its middle
DISTANT = 1000.0  # of the sun, whose rays are then nearly parallel
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


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
    light = light_of(job["light"], mesh, planes)
    folder = Path(job["folder"])
    hidden = job["hidden"]
    paints = hidden["colors"] if hidden else [None]
    samples = max(1, round(math.sqrt(job["samples"])))
    back = painted_triangles(mesh, hidden) if hidden else np.zeros(len(mesh.corners), bool)
    scene = _Scene(mesh, light, planes, back)
    for number, view in enumerate(job["views"]):
        if stopped.is_set() or time.monotonic() > end:
            raise BrokenMesh(f"took longer than max_minutes={minutes:g}")
        depth, seen = scene.geometry(view)
        for index, (image, coverage) in enumerate(scene.images(view, samples, paints)):  # noqa: B007
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


def light_of(light: dict[str, Any], mesh: TexturedMesh, planes: Planes) -> LightArrays:
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
    softness = math.tan(light["angle"] / 2)
    shadow = _depth_from(axes, mesh)
    return LightArrays(
        sun=sun,
        softness=softness,
        sky=sky,
        ambient=_ambient_light(sky, sun, toward, planes),
        axes=axes,
        shadow=shadow,
        nearest=_nearest(shadow, math.ceil((softness * SHADOW_SIDE + 2) / BLOCK) + 1),
        offsets=_offsets(),
    )


def _nearest(shadow: Float[np.ndarray, "side side"], reach: int) -> Float[np.ndarray, "block block"]:
    """Return the least depth of each block of pixels and those that are up to `reach` blocks away."""
    blocks = len(shadow) // BLOCK
    least = shadow.reshape(blocks, BLOCK, blocks, BLOCK).min((1, 3))
    for _ in range(2):
        padded = np.pad(least, ((reach, reach), (0, 0)), constant_values=np.inf)
        least = sliding_window_view(padded, 2 * reach + 1, axis=0).min(-1).T
    return np.ascontiguousarray(least)


def _offsets() -> Float[np.ndarray, "offset 2"]:
    """Return places that fill the unit disc evenly (Vogel's spiral)."""
    angles = GOLDEN_ANGLE * np.arange(SHADOW_SAMPLES)
    radii = np.sqrt((np.arange(SHADOW_SAMPLES) + 0.5) / SHADOW_SAMPLES)
    return radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)


def _ambient_light(
    sky: Float[np.ndarray, "2 3"], sun: Float[np.ndarray, " 3"], toward: Float[np.ndarray, " 3"], planes: Planes
) -> Float[np.ndarray, "step 3"]:
    """Return the received light from sky, floor and walls, which light each other, by the z of normals."""
    is_floor = planes.normals[:, 2] > 0.5
    colors = np.array([mean_color(planes, number) for number in range(len(is_floor))]).reshape(-1, 3)
    floor_sun = sun * toward[2]
    # Walls throw no shadow, and the sun lights their inner sides, which their normals point away from.
    wall_sun = sun * (-planes.normals[~is_floor] @ toward).clip(0, None).mean() if not is_floor.all() else None
    ground = None
    walls = None
    for _ in range(BOUNCES):
        table = ambient_light(sky, ground, walls)
        if is_floor.any():
            ground = colors[is_floor][0] * (table[-1] + floor_sun)
        if wall_sun is not None:
            walls = colors[~is_floor][0] * (table[NORMAL_STEPS // 2] + wall_sun)
    return ambient_light(sky, ground, walls)


def ambient_light(
    sky: Float[np.ndarray, "2 3"],
    ground: Float[np.ndarray, " 3"] | None,
    walls: Float[np.ndarray, " 3"] | None = None,
) -> Float[np.ndarray, "step 3"]:
    """Return the received light but the sun's, by the z of normals.

    Args:
        sky: colours at the horizon, which it has below it, too, and at the zenith; between them, linear in z.
        ground: colour of all directions below the horizon instead.
        walls: colour of all directions from the horizon to the walls' upper edge instead.
    """
    heights = (np.arange(2 * SKY_STEPS) + 0.5) / SKY_STEPS - 1
    azimuths = 2 * np.pi * (np.arange(SKY_STEPS) + 0.5) / SKY_STEPS
    share = heights.clip(0, 1)[:, None]
    radiance = (1 - share) * sky[0] + share * sky[1]
    if ground is not None:
        radiance[heights < 0] = ground
    if walls is not None:
        radiance[(heights > 0) & (heights < WALL_TOP)] = walls
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
        self, mesh: TexturedMesh, light: LightArrays, planes: Planes, back: Bool[np.ndarray, " triangle"]
    ) -> None:
        textures = mesh.textures
        self.mesh = mesh
        self.light = light
        self.planes = planes
        self.surfaces = Surfaces(
            mesh.uv, mesh.normals, mesh.colors, mesh.texture, textures.texels, textures.levels, back
        )
        self.unpainted = self.surfaces._replace(back=np.zeros_like(back))

    def geometry(self, view: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
        """Return depth and whether the object is seen, at the pixels' centres."""
        triangles, _, depth, _, distance, _ = self._visible(view, 1)
        nearest = np.minimum(depth, distance)
        return np.where(np.isfinite(nearest), nearest, SKY_DEPTH), triangles != NOTHING

    def images(
        self, view: dict[str, Any], samples: int, paints: Sequence[Sequence[float] | None]
    ) -> Iterator[tuple[Float[np.ndarray, "height width 3"], Float[np.ndarray, "height width"]]]:
        """Yield linear colours and the object's coverage with each paint, means of samples x samples a pixel."""
        width, height = view["size"]
        triangles, weights, depth, numbers, distance, points = self._visible(view, samples)
        for paint in paints:
            image = np.empty((height, width, 3))
            coverage = np.empty((height, width))
            surfaces = self.unpainted if paint is None else self.surfaces
            color = np.array(paint or (0.0, 0.0, 0.0))
            scene = (view_in_samples(view, samples), samples, surfaces, self.planes, self.light, color)
            shade(*scene, points, triangles, weights, depth, numbers, distance, image, coverage)
            yield image, coverage

    def _visible(self, view: dict[str, Any], samples: int) -> tuple[np.ndarray, ...]:
        """Return the buffers of `draw_triangles`, those of `draw_planes`, and the projected corners."""
        camera = view_in_samples(view, samples)
        width, height = view["size"]
        shape = (height * samples, width * samples)
        triangles = np.full(shape, NOTHING, np.int64)
        weights = np.empty((*shape, 2))
        depth = np.full(shape, np.inf)
        mesh = self.mesh
        textures = mesh.textures
        points = projected(camera, np.array(view["world_to_camera"]), mesh.corners)
        buffers = (triangles, weights, depth)
        draw_triangles(points, mesh.uv, mesh.texture, textures.texels, textures.levels, mesh.cut, *buffers)
        numbers = np.full(shape, NOTHING, np.int64)
        distance = np.full(shape, np.inf)
        draw_planes(camera, self.planes, numbers, distance)
        return triangles, weights, depth, numbers, distance, points


def view_in_samples(view: dict[str, Any], samples: int) -> View:
    """Return a job's view with samples x samples a pixel."""
    matrix = np.array(view["world_to_camera"])
    rotation = np.ascontiguousarray(matrix[:3, :3])
    eye = -rotation.T @ matrix[:3, 3]
    return View(eye, rotation, float(view["focal"] * samples), np.array(view["center"], np.float64) * samples)


def projected(
    camera: View, matrix: Float[np.ndarray, "4 4"], corners: Float[np.ndarray, "*n 3"]
) -> Float[np.ndarray, "*n 3"]:
    """Return x and y in samples, and depth."""
    points = corners @ camera.rotation.T + matrix[:3, 3]
    depth = points[..., 2:]
    safe = np.where(np.abs(depth) < 1e-9, 1e-9, depth)
    return np.concatenate([points[..., :2] / safe * camera.focal + camera.center, depth], axis=-1)
