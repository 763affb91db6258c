"""Analytic ray tracer for toy rooms: the inside of a box, rectangles on its faces, boxes and ellipsoids."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from completesplat.data.toy.raytracing import (
    CHECKS,
    ELLIPSOID,
    RIPPLES,
    SELF_INTERSECTION,
    STRIPES,
    Array,
    hit_ball,
    inlined,
    kernel,
    mixed,
    moved,
    soft_sign,
    turned,
    world_normal,
)

FLOOR, CEILING = 2, 3
WALLS = (0, 1, 4, 5)
SHADOW = 0.45


class Room(NamedTuple):
    """Surfaces of a room and its light, as arrays.

    `size` is along x, y and z. `colors` [face 2 3] and `textures` [face 3] are of the room's faces. `decals` [decal 6]
    are rectangles on faces: face, range of the first coordinate, range of the second, width of the rim. The coordinates
    are (z, y) on walls across x, (x, y) on walls across z. `decal_colors` [decal 3 3] are the rim and two inner
    colours. In its local frame, a solid is the cube [-1, 1]^3 or the unit ball; `to_local` [solid 3 4] maps room points
    there. `bounding_balls` [solid 4] are the centre and squared radius of a ball around each solid.
    """

    size: Array
    colors: Array
    textures: Array
    decals: Array
    decal_colors: Array
    decal_textures: Array
    solid_kinds: NDArray[np.int64]
    to_local: Array
    bounding_balls: Array
    solid_half_sizes: Array
    solid_colors: Array
    solid_textures: Array
    light: Array
    ambient: float


@inlined
def _hit_cube(ox, oy, oz, dx, dy, dz):
    """Return the nearest hit (distance, axis of the face) of the cube [-1, 1]^3 from outside."""
    enter, leave, axis = -np.inf, np.inf, 0
    for i in range(3):
        o, d = (ox, dx) if i == 0 else ((oy, dy) if i == 1 else (oz, dz))
        if abs(d) < 1e-12:
            if abs(o) > 1:
                return np.inf, 0
        else:
            middle, half = -o / d, abs(1 / d)
            if middle - half > enter:
                enter, axis = middle - half, i
            leave = min(leave, middle + half)
    return (enter, axis) if SELF_INTERSECTION < enter <= leave else (np.inf, 0)


@inlined
def _hit_solid(room, ox, oy, oz, dx, dy, dz):
    """Return the nearest solid along a ray: distance, solid (or -1), axis of the face of a box."""
    nearest, solid, face = np.inf, -1, 0
    balls = room.bounding_balls
    square = dx * dx + dy * dy + dz * dz
    for i in range(len(room.solid_kinds)):
        cx, cy, cz = balls[i, 0] - ox, balls[i, 1] - oy, balls[i, 2] - oz
        along = cx * dx + cy * dy + cz * dz
        if (cx * cx + cy * cy + cz * cz - balls[i, 3]) * square > along * along:
            continue
        px, py, pz = moved(room.to_local[i], ox, oy, oz)
        qx, qy, qz = turned(room.to_local[i], dx, dy, dz)
        axis = 0
        if room.solid_kinds[i] == ELLIPSOID:
            t = hit_ball(px, py, pz, qx, qy, qz)[0]
        else:
            t, axis = _hit_cube(px, py, pz, qx, qy, qz)
        if t < nearest:
            nearest, solid, face = t, i, axis
    return nearest, solid, face


@inlined
def _hit_room(room, ox, oy, oz, dx, dy, dz):
    """Return distance and face where a ray from inside leaves the room."""
    nearest, face = np.inf, 0
    for i in range(3):
        o, d = (ox, dx) if i == 0 else ((oy, dy) if i == 1 else (oz, dz))
        if abs(d) > 1e-12:
            low = 0.0 if i == 1 else -0.5 * room.size[i]
            t = ((low + room.size[i] if d > 0 else low) - o) / d
            if t < nearest:
                nearest, face = t, 2 * i + (1 if d > 0 else 0)
    return nearest, face


@inlined
def _textured(colors, first, texture, u, v):
    """Mix the colours `first` and `first` + 1 by a texture's pattern."""
    kind, frequency, phase = texture[0], texture[1], texture[2]
    w = 0.0
    if kind == STRIPES:
        w = 0.5 + 0.5 * soft_sign(5 * math.sin(frequency * u + phase))
    elif kind == CHECKS:
        w = 0.5 + 0.5 * soft_sign(8 * math.sin(frequency * u + phase) * math.sin(frequency * v + phase))
    elif kind == RIPPLES:
        w = 0.5 + 0.25 * (math.sin(frequency * (u + 0.4 * v) + phase) + math.sin(frequency * (v - 0.3 * u) + 2 * phase))
    return mixed(colors[first], colors[first + 1], w)


@inlined
def _face_color(room, face, x, y, z):
    """Return the colour of a point on a face of the room; later decals cover earlier ones."""
    u, v = (z, y) if face < 2 else ((x, z) if face < 4 else (x, y))
    for i in range(len(room.decals) - 1, -1, -1):
        decal = room.decals[i]
        if face == decal[0] and decal[1] < u < decal[2] and decal[3] < v < decal[4]:
            if min(u - decal[1], decal[2] - u, v - decal[3], decal[4] - v) < decal[5]:
                rim = room.decal_colors[i, 0]
                return rim[0], rim[1], rim[2]
            return _textured(room.decal_colors[i], 1, room.decal_textures[i], u, v)
    return _textured(room.colors[face], 0, room.textures[face], u, v)


@inlined
def _solid_look(room, solid, face, x, y, z):
    """Return colour and normal of a point on a solid."""
    m, half = room.to_local[solid], room.solid_half_sizes[solid]
    lx, ly, lz = moved(m, x, y, z)
    u, v = lx * half[0], ly * half[1]
    if room.solid_kinds[solid] != ELLIPSOID:
        if face == 0:
            u, lx, ly, lz = lz * half[2], math.copysign(1.0, lx), 0.0, 0.0
        elif face == 1:
            v, lx, ly, lz = lz * half[2], 0.0, math.copysign(1.0, ly), 0.0
        else:
            lx, ly, lz = 0.0, 0.0, math.copysign(1.0, lz)
    nx, ny, nz = world_normal(m, lx, ly, lz)
    red, green, blue = _textured(room.solid_colors[solid], 0, room.solid_textures[solid], u, v)
    return red, green, blue, nx, ny, nz


@inlined
def _shade(room, ox, oy, oz, dx, dy, dz):
    """Return colour and distance (in lengths of the direction) along a ray from inside the room."""
    t, solid, axis = _hit_solid(room, ox, oy, oz, dx, dy, dz)
    wall, face = _hit_room(room, ox, oy, oz, dx, dy, dz)
    if solid < 0:
        t = wall
    x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
    if solid >= 0:
        red, green, blue, nx, ny, nz = _solid_look(room, solid, axis, x, y, z)
    else:
        red, green, blue = _face_color(room, face, x, y, z)
        inwards = 1.0 if face % 2 == 0 else -1.0
        nx, ny, nz = (inwards, 0.0, 0.0) if face < 2 else ((0.0, inwards, 0.0) if face < 4 else (0.0, 0.0, inwards))
    lx, ly, lz = room.light[0] - x, room.light[1] - y, room.light[2] - z
    direct = max(0.0, (nx * lx + ny * ly + nz * lz) / math.sqrt(lx * lx + ly * ly + lz * lz))
    if direct > 0:
        shift = 1e-4
        shadow = _hit_solid(room, x + shift * nx, y + shift * ny, z + shift * nz, lx, ly, lz)
        direct *= SHADOW if shadow[0] < 1 else 1.0
    # Light from above gives the unlit sides some shading.
    level = room.ambient * (0.85 + 0.15 * ny) + (1 - room.ambient) * direct
    return red * level, green * level, blue * level, t


@kernel
def trace_room(room, pose, intrinsics, height, width, samples):
    """Render colours [height width 3] and depth [height width] for the pose `camera_to_world`.

    `intrinsics` are fx, fy, cx, cy in pixels. Colours are means over `samples` x `samples` rays for each pixel, where
    `samples` is odd. The depth is the middle ray's, along the optical axis.
    """
    colors, depth = np.zeros((height, width, 3)), np.zeros((height, width))
    ox, oy, oz = pose[0, 3], pose[1, 3], pose[2, 3]
    for row in range(height):
        for column in range(width):
            for sample in range(samples * samples):
                x = (column + (sample % samples + 0.5) / samples - intrinsics[2]) / intrinsics[0]
                y = (row + (sample // samples + 0.5) / samples - intrinsics[3]) / intrinsics[1]
                dx, dy, dz = turned(pose, x, y, 1.0)
                # The direction's component along the optical axis is 1, so its length in t is the depth.
                red, green, blue, t = _shade(room, ox, oy, oz, dx, dy, dz)
                colors[row, column, 0] += red / samples**2
                colors[row, column, 1] += green / samples**2
                colors[row, column, 2] += blue / samples**2
                if sample == samples * samples // 2:
                    depth[row, column] = t
    return colors, depth
