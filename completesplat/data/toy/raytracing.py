"""Analytic ray tracer for ellipsoids and cone frusta on a patterned ground inside a coloured dome."""

import inspect
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

ELLIPSOID, FRUSTUM, BOX = 0, 1, 2
# Patterns: the first number of a texture. The others are its frequency (radians per unit of length) and phase.
PLAIN, STRIPES, CHECKS, RIPPLES = 0, 1, 2, 3

Array = NDArray[np.float64]


class Geometry(NamedTuple):
    """Parts of an object as arrays.

    In its local frame, an ellipsoid is the unit ball and a frustum is x^2 + z^2 <= (1 + taper y)^2, |y| <= 1.
    `to_local` [part 3 4] maps world points to the local frames. `textures` [part 3]: pattern, frequency, phase.
    """

    kinds: NDArray[np.int64]
    to_local: Array
    tapers: Array
    colors: Array
    textures: Array
    bounding_radius: float


class Surroundings(NamedTuple):
    """Ground plane at height `ground` (two colours, pattern), dome (palette) and light.

    The dome's hue is `hue` + 0.17 sin(azimuth - `turn`), with panels of the same phase. This law is the same in all
    scenes, so that the dome behind a camera can partly be inferred from the one in front. A `plain` dome is grey.
    """

    ground: float
    ground_colors: Array
    ground_texture: Array
    dome_radius: float
    hue: float
    turn: float
    plain: bool
    light: Array
    ambient: float


class Patch(NamedTuple):
    """Disc on `part` where the cosine between the normal and the direction `facing` exceeds `edge`.

    `heights` is the local range of y that it may cover. It is white near the ends of this range, and where the cosine
    is below `rim`; if `rim` equals `edge`, it has no white rim.
    """

    part: int
    facing: Array
    color: Array
    heights: Array
    edge: float
    rim: float


GROUND, DOME = -1, -2
SELF_INTERSECTION = 1e-6

OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}


def kernel(function: Callable[..., Any]) -> Any:
    """Compile a function at its first call and cache it on disk, without a run-time type checker's wrapper."""
    return njit(cache=True, **OPTIONS)(inspect.unwrap(function))


def inlined(function: Callable[..., Any]) -> Any:
    """Inline a function into kernels, because passing a tuple of arrays costs as much as hitting a sphere."""
    return njit(forceinline=True, **OPTIONS)(inspect.unwrap(function))


@inlined
def turned(m, x, y, z):
    """Apply the linear part of a map [3 4] to a direction."""
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z,
    )


@inlined
def moved(m, x, y, z):
    """Apply a map [3 4] to a point."""
    x, y, z = turned(m, x, y, z)
    return x + m[0, 3], y + m[1, 3], z + m[2, 3]


@inlined
def world_normal(m, x, y, z):
    """Return the unit world normal for a normal in the local frame, into which `m` maps."""
    # Normals transform by the transpose of the map into the local frame.
    x, y, z = turned(m[:, :3].T, x, y, z)
    norm = math.sqrt(x * x + y * y + z * z)
    return x / norm, y / norm, z / norm


@inlined
def soft_sign(x):
    """Return a smooth sign from -1 to 1, with slope 1 at 0."""
    return x / math.sqrt(1 + x * x)


@inlined
def mixed(a, b, w):
    """Interpolate between two colours."""
    return a[0] + w * (b[0] - a[0]), a[1] + w * (b[1] - a[1]), a[2] + w * (b[2] - a[2])


@inlined
def _hit_frustum(ox, oy, oz, dx, dy, dz, taper):
    """Return the nearest hit (distance, local normal) of x^2 + z^2 = (1 + taper y)^2 with caps at y = -1 and 1."""
    nearest, nx, ny, nz = np.inf, 0.0, 0.0, 0.0
    a = dx * dx + dz * dz - taper * taper * dy * dy
    b = ox * dx + oz * dz - taper * dy * (1 + taper * oy)
    c = ox * ox + oz * oz - (1 + taper * oy) ** 2
    square = b * b - a * c
    if square > 0 and abs(a) > 1e-12:
        for sign in (-1.0, 1.0):
            t = (-b + sign * math.sqrt(square)) / a
            y = oy + t * dy
            if SELF_INTERSECTION < t < nearest and abs(y) <= 1:
                nearest, nx, ny, nz = t, ox + t * dx, -taper * (1 + taper * y), oz + t * dz
    if abs(dy) > 1e-12:
        for cap in (-1.0, 1.0):
            t = (cap - oy) / dy
            x, z = ox + t * dx, oz + t * dz
            if SELF_INTERSECTION < t < nearest and x * x + z * z <= (1 + taper * cap) ** 2:
                nearest, nx, ny, nz = t, 0.0, cap, 0.0
    return nearest, nx, ny, nz


@inlined
def hit_ball(ox, oy, oz, dx, dy, dz):
    """Return the nearest hit (distance, normal) of the unit ball from outside."""
    a = dx * dx + dy * dy + dz * dz
    b = ox * dx + oy * dy + oz * dz
    square = b * b - a * (ox * ox + oy * oy + oz * oz - 1)
    t = (-b - math.sqrt(square)) / a if square > 0 else -1.0
    if t <= SELF_INTERSECTION:
        return np.inf, 0.0, 0.0, 0.0
    return t, ox + t * dx, oy + t * dy, oz + t * dz


@inlined
def hit_object(geometry, ox, oy, oz, dx, dy, dz):
    """Return the nearest part along a ray of unit direction: distance, part (or -1), world normal."""
    nearest, part, nx, ny, nz = np.inf, -1, 0.0, 0.0, 0.0
    along = ox * dx + oy * dy + oz * dz
    if ox * ox + oy * oy + oz * oz - along * along > geometry.bounding_radius**2:
        return nearest, part, nx, ny, nz
    m = geometry.to_local
    for i in range(len(geometry.kinds)):
        px, py, pz = moved(m[i], ox, oy, oz)
        qx, qy, qz = turned(m[i], dx, dy, dz)
        if geometry.kinds[i] == ELLIPSOID:
            t, lx, ly, lz = hit_ball(px, py, pz, qx, qy, qz)
        else:
            t, lx, ly, lz = _hit_frustum(px, py, pz, qx, qy, qz, geometry.tapers[i])
        if t < nearest:
            nearest, part, nx, ny, nz = t, i, lx, ly, lz
    if part >= 0:
        nx, ny, nz = world_normal(m[part], nx, ny, nz)
    return nearest, part, nx, ny, nz


@inlined
def _pattern(kind, frequency, phase, x, y, z):
    """Return the weight of the second colour, 0 to 1, at a local point."""
    if kind == STRIPES:
        return 0.5 + 0.5 * soft_sign(5 * math.sin(frequency * y + phase))
    if kind == CHECKS:
        around = math.sin(round(frequency / 2) * math.atan2(x, z) + phase)
        return 0.5 + 0.5 * soft_sign(8 * around * math.sin(frequency * y + phase))
    if kind == RIPPLES:
        first = math.sin(frequency * (x + 0.6 * z) + phase)
        return 0.5 + 0.25 * (first + math.sin(1.3 * frequency * (y - 0.5 * x + 0.3 * z) + 2 * phase))
    return 0.0


@inlined
def _object_color(geometry, patch, part, x, y, z, nx, ny, nz):
    lx, ly, lz = moved(geometry.to_local[part], x, y, z)
    if part == patch.part and patch.heights[0] < ly < patch.heights[1]:
        facing = nx * patch.facing[0] + ny * patch.facing[1] + nz * patch.facing[2]
        if facing > patch.edge:
            middle = 0.5 * (patch.heights[0] + patch.heights[1])
            high = abs(ly - middle) > 0.4 * (patch.heights[1] - patch.heights[0])
            rim = patch.rim > patch.edge and (facing < patch.rim or high)
            return (0.95, 0.95, 0.95) if rim else (patch.color[0], patch.color[1], patch.color[2])
    w = _pattern(geometry.textures[part, 0], geometry.textures[part, 1], geometry.textures[part, 2], lx, ly, lz)
    return mixed(geometry.colors[part, 0], geometry.colors[part, 1], w)


@inlined
def _ground_color(around, x, z):
    kind, frequency, angle = around.ground_texture[0], around.ground_texture[1], around.ground_texture[2]
    cos, sin = math.cos(angle), math.sin(angle)
    wave = math.sin(frequency * (cos * x + sin * z))
    if kind == CHECKS:
        wave *= math.sin(frequency * (cos * z - sin * x))
    w = 0.5 + 0.5 * soft_sign(6 * wave)
    return mixed(around.ground_colors[0], around.ground_colors[1], w)


@inlined
def _dome_color(around, x, y, z):
    if around.plain:
        return 0.5, 0.5, 0.5
    cos_turn, sin_turn = math.cos(around.turn), math.sin(around.turn)
    level = math.sqrt(x * x + z * z) + 1e-12
    sin, cos = (x * cos_turn - z * sin_turn) / level, (z * cos_turn + x * sin_turn) / level
    sin_fourfold = 4 * sin * cos * (1 - 2 * sin * sin)
    hue = 2 * math.pi * (around.hue + 0.17 * sin)
    rise = max(0.0, min(1.0, (y - around.ground) / around.dome_radius))
    value = 0.68 + 0.1 * soft_sign(4 * sin_fourfold) * (1 - rise) + 0.15 * rise
    cos_hue, sin_hue = 0.2 * (1 - 0.5 * rise) * math.cos(hue), 0.2 * (1 - 0.5 * rise) * math.sin(hue)
    # Red, green and blue are a third of a turn apart.
    half_root_3 = 0.8660254037844386
    return value + cos_hue, value - 0.5 * cos_hue + half_root_3 * sin_hue, value - 0.5 * cos_hue - half_root_3 * sin_hue


@inlined
def _shade(geometry, around, patch, ox, oy, oz, dx, dy, dz):
    """Return colour, distance and the surface (a part, GROUND or DOME) along a ray of unit direction in the dome."""
    t, seen, nx, ny, nz = hit_object(geometry, ox, oy, oz, dx, dy, dz)
    b = ox * dx + oy * dy + oz * dz
    dome = -b + math.sqrt(max(0.0, b * b - (ox * ox + oy * oy + oz * oz) + around.dome_radius**2))
    if seen < 0:
        t, seen = dome, DOME
    if dy < 0 and (around.ground - oy) / dy < t:
        t, seen, nx, ny, nz = (around.ground - oy) / dy, GROUND, 0.0, 1.0, 0.0
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    if seen == DOME:
        red, green, blue = _dome_color(around, x, y, z)
        return red, green, blue, t, seen
    if seen == GROUND:
        red, green, blue = _ground_color(around, x, z)
    else:
        red, green, blue = _object_color(geometry, patch, seen, x, y, z, nx, ny, nz)
    lx, ly, lz = around.light[0], around.light[1], around.light[2]
    direct = max(0.0, nx * lx + ny * ly + nz * lz)
    if direct > 0:
        shift = 1e-4
        shadow = hit_object(geometry, x + shift * nx, y + shift * ny, z + shift * nz, lx, ly, lz)
        direct *= 0.35 if shadow[1] >= 0 else 1.0
    # Light from the sky above gives the unlit side some shading.
    level = around.ambient * (0.75 + 0.25 * ny) + (1 - around.ambient) * direct
    return red * level, green * level, blue * level, t, seen


@kernel
def trace(geometry, around, patch, pose, rays):
    """Render colours [pixel 3], object coverage [pixel] and distances [pixel] for the pose `camera_to_world`.

    Colours and coverage are means over each pixel's `rays` [pixel sample 3], which have unit length and are in the
    camera's frame. The distance is the middle ray's.
    """
    pixels, samples, _ = rays.shape
    colors, coverage, distances = np.zeros((pixels, 3)), np.zeros(pixels), np.zeros(pixels)
    ox, oy, oz = pose[0, 3], pose[1, 3], pose[2, 3]
    for pixel in range(pixels):
        for sample in range(samples):
            dx, dy, dz = turned(pose, rays[pixel, sample, 0], rays[pixel, sample, 1], rays[pixel, sample, 2])
            red, green, blue, distance, seen = _shade(geometry, around, patch, ox, oy, oz, dx, dy, dz)
            colors[pixel, 0] += red / samples
            colors[pixel, 1] += green / samples
            colors[pixel, 2] += blue / samples
            coverage[pixel] += (seen >= 0) / samples
            if sample == samples // 2:
                distances[pixel] = distance
    return colors, coverage, distances
