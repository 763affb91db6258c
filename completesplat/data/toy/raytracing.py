"""Analytic ray tracer: ellipsoids, cone frusta and boxes on the ground of a coloured dome, or in a room.

All of it is one file, because numba compiles a kernel again only when the kernel's own file changes.

A texture [3] is the number of a pattern, its frequency and its phase (on the ground: its angle). A decal [6] is a face,
the lowest and highest u, the lowest and highest v, and the width of the rim; its colours [3 3] are the rim's and two of
the inside. A patch covers the local heights [2] between the lowest and the highest, where the normal has a cosine above
`edge` with the direction `facing`. A ray is the points (ox, oy, oz) + t (dx, dy, dz): in a shape's local frame in
`_hit_ball`, `_hit_frustum` and `_hit_cube`, in the scene's frame elsewhere.
"""

import math
from functools import partial

import numpy as np

from completesplat.data.toy.shapes import BOX, CHECKS, ELLIPSOID, FRUSTUM, RIPPLES, STRIPES, Array, Shapes
from completesplat.data.toy.surroundings import DOME, GROUND, Dome, Light, Patch, Room
from completesplat.rasterizers.kernels.compilation import helper, kernel

SELF_INTERSECTION = 1e-6  # nearer hits are the surface that the ray starts from

# Without the kernels' "fastmath", so that all machines draw the same images.
compiled = partial(kernel, fastmath=False)
# Passing a tuple of arrays to a function that is not inlined costs as much as intersecting a sphere.
inlined = partial(helper, fastmath=False)


@inlined
def map_direction(m, x, y, z):
    """Multiply a direction by the linear part of a map."""
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z,
    )


@inlined
def map_point(m, x, y, z):
    """Apply a map [3 4] to a point."""
    x, y, z = map_direction(m, x, y, z)
    return x + m[0, 3], y + m[1, 3], z + m[2, 3]


@inlined
def soft_sign(x):
    """Return a smooth sign from -1 to 1, with slope 1 at 0."""
    return x / math.sqrt(1 + x * x)


@inlined
def blend(a, b, w):
    """Interpolate between two colours."""
    return a[0] + w * (b[0] - a[0]), a[1] + w * (b[1] - a[1]), a[2] + w * (b[2] - a[2])


@inlined
def _hit_ball(ox, oy, oz, dx, dy, dz):
    """Return the nearest hit (distance, normal) of the unit ball from outside."""
    a = dx * dx + dy * dy + dz * dz
    b = ox * dx + oy * dy + oz * dz
    square = b * b - a * (ox * ox + oy * oy + oz * oz - 1)
    t = (-b - math.sqrt(square)) / a if square > 0 else -1.0
    if t <= SELF_INTERSECTION:
        return np.inf, 0.0, 0.0, 0.0
    return t, ox + t * dx, oy + t * dy, oz + t * dz


@inlined
def _hit_frustum(ox, oy, oz, dx, dy, dz, taper):
    """Return the nearest hit (distance, normal) of x^2 + z^2 = (1 + taper y)^2 with caps at y = -1 and 1."""
    nearest = np.inf
    nx = 0.0
    ny = 0.0
    nz = 0.0
    a = dx * dx + dz * dz - taper * taper * dy * dy
    b = ox * dx + oz * dz - taper * dy * (1 + taper * oy)
    c = ox * ox + oz * oz - (1 + taper * oy) ** 2
    square = b * b - a * c
    if square > 0 and abs(a) > 1e-12:
        for sign in (-1.0, 1.0):
            t = (-b + sign * math.sqrt(square)) / a
            y = oy + t * dy
            if SELF_INTERSECTION < t < nearest and abs(y) <= 1:
                nearest = t
                nx = ox + t * dx
                ny = -taper * (1 + taper * y)
                nz = oz + t * dz
    if abs(dy) > 1e-12:
        for cap in (-1.0, 1.0):
            t = (cap - oy) / dy
            x = ox + t * dx
            z = oz + t * dz
            if SELF_INTERSECTION < t < nearest and x * x + z * z <= (1 + taper * cap) ** 2:
                nearest = t
                nx = 0.0
                ny = cap
                nz = 0.0
    return nearest, nx, ny, nz


@inlined
def _hit_cube(ox, oy, oz, dx, dy, dz):
    """Return the nearest hit (distance, normal) of the cube [-1, 1]^3 from outside."""
    enter = -np.inf
    leave = np.inf
    nx = 0.0
    ny = 0.0
    nz = 0.0
    for i in range(3):
        o, d = (ox, dx) if i == 0 else ((oy, dy) if i == 1 else (oz, dz))
        if abs(d) < 1e-12:
            if abs(o) > 1:
                return np.inf, 0.0, 0.0, 0.0
        else:
            middle = -o / d
            half = abs(1 / d)
            side = -math.copysign(1.0, d)
            if middle - half > enter:
                enter = middle - half
                nx = side if i == 0 else 0.0
                ny = side if i == 1 else 0.0
                nz = side if i == 2 else 0.0
            leave = min(leave, middle + half)
    return (enter, nx, ny, nz) if SELF_INTERSECTION < enter <= leave else (np.inf, 0.0, 0.0, 0.0)


@inlined
def _hit_shapes(shapes, ox, oy, oz, dx, dy, dz):
    """Return the nearest shape along a ray: distance (in units of the direction), shape (or -1), local normal."""
    nearest = np.inf
    shape = -1
    nx = 0.0
    ny = 0.0
    nz = 0.0
    balls = shapes.bounding_balls
    square = dx * dx + dy * dy + dz * dz
    for i in range(len(shapes.kinds)):
        cx = balls[i, 0] - ox
        cy = balls[i, 1] - oy
        cz = balls[i, 2] - oz
        along = cx * dx + cy * dy + cz * dz
        if (cx * cx + cy * cy + cz * cz - balls[i, 3]) * square > along * along:
            continue
        px, py, pz = map_point(shapes.to_local[i], ox, oy, oz)
        qx, qy, qz = map_direction(shapes.to_local[i], dx, dy, dz)
        if shapes.kinds[i] == ELLIPSOID:
            t, lx, ly, lz = _hit_ball(px, py, pz, qx, qy, qz)
        elif shapes.kinds[i] == FRUSTUM:
            t, lx, ly, lz = _hit_frustum(px, py, pz, qx, qy, qz, shapes.tapers[i])
        else:
            t, lx, ly, lz = _hit_cube(px, py, pz, qx, qy, qz)
        if t < nearest:
            nearest = t
            shape = i
            nx = lx
            ny = ly
            nz = lz
    return nearest, shape, nx, ny, nz


@inlined
def _hit_dome(dome, ox, oy, oz, dx, dy, dz):
    """Return distance, face and normal where a ray of unit direction meets the dome or the ground."""
    b = ox * dx + oy * dy + oz * dz
    t = -b + math.sqrt(max(0.0, b * b - (ox * ox + oy * oy + oz * oz) + dome.radius**2))
    if dy < 0 and (dome.ground - oy) / dy < t:
        return (dome.ground - oy) / dy, GROUND, 0.0, 1.0, 0.0
    return t, DOME, 0.0, 0.0, 0.0


@inlined
def _hit_room(room, ox, oy, oz, dx, dy, dz):
    """Return distance, face and normal where a ray from inside leaves the room."""
    nearest = np.inf
    face = 0
    for i in range(3):
        o, d = (ox, dx) if i == 0 else ((oy, dy) if i == 1 else (oz, dz))
        if abs(d) > 1e-12:
            low = 0.0 if i == 1 else -0.5 * room.size[i]
            t = ((low + room.size[i] if d > 0 else low) - o) / d
            if t < nearest:
                nearest = t
                face = 2 * i + (1 if d > 0 else 0)
    inwards = 1.0 if face % 2 == 0 else -1.0
    axis = face // 2
    return nearest, face, inwards * (axis == 0), inwards * (axis == 1), inwards * (axis == 2)


@inlined
def _solid_pattern(texture, x, y, z):
    """Return the weight of the second colour, 0 to 1, at a local point of an object's part."""
    kind = texture[0]
    frequency = texture[1]
    phase = texture[2]
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
def _flat_pattern(texture, u, v):
    """Return the weight of the second colour, 0 to 1, at a point of a plane."""
    kind = texture[0]
    frequency = texture[1]
    phase = texture[2]
    if kind == STRIPES:
        return 0.5 + 0.5 * soft_sign(5 * math.sin(frequency * u + phase))
    if kind == CHECKS:
        return 0.5 + 0.5 * soft_sign(8 * math.sin(frequency * u + phase) * math.sin(frequency * v + phase))
    if kind == RIPPLES:
        first = math.sin(frequency * (u + 0.4 * v) + phase)
        return 0.5 + 0.25 * (first + math.sin(frequency * (v - 0.3 * u) + 2 * phase))
    return 0.0


@inlined
def _part_color(shapes, patch, part, lx, ly, lz, nx, ny, nz):
    """Return the colour of a local point, with this world normal, on a part of an object."""
    if part == 0 and patch.heights[0] < ly < patch.heights[1]:
        facing = nx * patch.facing[0] + ny * patch.facing[1] + nz * patch.facing[2]
        if facing > patch.edge:
            return patch.color[0], patch.color[1], patch.color[2]
    return blend(shapes.colors[part, 0], shapes.colors[part, 1], _solid_pattern(shapes.textures[part], lx, ly, lz))


@inlined
def _furniture_color(shapes, solid, lx, ly, lz, hx, hy, hz):
    """Return the colour of a local point, with this local normal, on a box or an ellipsoid in a room."""
    half = shapes.half_sizes[solid]
    u = lx * half[0]
    v = ly * half[1]
    if shapes.kinds[solid] == BOX and hx != 0:
        u = lz * half[2]
    elif shapes.kinds[solid] == BOX and hy != 0:
        v = lz * half[2]
    return blend(shapes.colors[solid, 0], shapes.colors[solid, 1], _flat_pattern(shapes.textures[solid], u, v))


@inlined
def _face_color(room, face, x, y, z):
    """Return the colour of a point on a face of the room. Later decals cover earlier ones."""
    u, v = (z, y) if face < 2 else ((x, z) if face < 4 else (x, y))
    for i in range(len(room.decals) - 1, -1, -1):
        decal = room.decals[i]
        colors = room.decal_colors[i]
        if face == decal[0] and decal[1] < u < decal[2] and decal[3] < v < decal[4]:
            if min(u - decal[1], decal[2] - u, v - decal[3], decal[4] - v) < decal[5]:
                return colors[0, 0], colors[0, 1], colors[0, 2]
            return blend(colors[1], colors[2], _flat_pattern(room.decal_textures[i], u, v))
    return blend(room.colors[face, 0], room.colors[face, 1], _flat_pattern(room.textures[face], u, v))


@inlined
def _dome_color(dome, face, x, y, z):
    """Return the colour of a point on the ground or on the dome."""
    if face == GROUND:
        kind = dome.ground_texture[0]
        frequency = dome.ground_texture[1]
        angle = dome.ground_texture[2]
        cos = math.cos(angle)
        sin = math.sin(angle)
        wave = math.sin(frequency * (cos * x + sin * z))
        if kind == CHECKS:
            wave *= math.sin(frequency * (cos * z - sin * x))
        return blend(dome.ground_colors[0], dome.ground_colors[1], 0.5 + 0.5 * soft_sign(6 * wave))
    if dome.plain:
        return 0.5, 0.5, 0.5
    cos_turn = math.cos(dome.turn)
    sin_turn = math.sin(dome.turn)
    level = math.sqrt(x * x + z * z) + 1e-12
    sin = (x * cos_turn - z * sin_turn) / level
    cos = (z * cos_turn + x * sin_turn) / level
    sin_fourfold = 4 * sin * cos * (1 - 2 * sin * sin)
    hue = 2 * math.pi * (dome.hue + 0.17 * sin)
    rise = max(0.0, min(1.0, (y - dome.ground) / dome.radius))
    value = 0.68 + 0.1 * soft_sign(4 * sin_fourfold) * (1 - rise) + 0.15 * rise
    cos_hue = 0.2 * (1 - 0.5 * rise) * math.cos(hue)
    sin_hue = 0.2 * (1 - 0.5 * rise) * math.sin(hue)
    # Red, green and blue are a third of a turn apart.
    half_root_3 = 0.8660254037844386
    return value + cos_hue, value - 0.5 * cos_hue + half_root_3 * sin_hue, value - 0.5 * cos_hue - half_root_3 * sin_hue


@inlined
def _brightness(shapes, light, x, y, z, nx, ny, nz):
    """Return the light on a point with this unit normal."""
    lx = light.place[0]
    ly = light.place[1]
    lz = light.place[2]
    length = 1.0
    reach = np.inf
    if light.is_point:
        lx = lx - x
        ly = ly - y
        lz = lz - z
        length = math.sqrt(lx * lx + ly * ly + lz * lz)
        reach = 1.0
    direct = max(0.0, (nx * lx + ny * ly + nz * lz) / length)
    if direct > 0:
        shift = 1e-4
        shadow = _hit_shapes(shapes, x + shift * nx, y + shift * ny, z + shift * nz, lx, ly, lz)
        direct *= light.shadow if shadow[0] < reach else 1.0
    # Light from the sky above gives the unlit side some shading.
    return light.ambient * (1 - light.sky + light.sky * ny) + (1 - light.ambient) * direct


@inlined
def _shade(shapes, light, dome, patch, room, ox, oy, oz, dx, dy, dz):
    """Return colour, distance and shape (-1: none) along a ray."""
    t, shape, hx, hy, hz = _hit_shapes(shapes, ox, oy, oz, dx, dy, dz)
    # Either the dome or the room is None. Numba compiles no code for the one that is None.
    far = np.inf
    face = 0
    nx = 0.0
    ny = 0.0
    nz = 0.0
    if dome is not None:
        far, face, nx, ny, nz = _hit_dome(dome, ox, oy, oz, dx, dy, dz)
    if room is not None:
        far, face, nx, ny, nz = _hit_room(room, ox, oy, oz, dx, dy, dz)
    if far < t:
        t = far
        shape = -1
    x = ox + t * dx
    y = oy + t * dy
    z = oz + t * dz
    red = 0.0
    green = 0.0
    blue = 0.0
    if shape >= 0:
        m = shapes.to_local[shape]
        lx, ly, lz = map_point(m, x, y, z)
        # Normals transform by the transpose of the map into the local frame.
        nx, ny, nz = map_direction(m[:, :3].T, hx, hy, hz)
        norm = math.sqrt(nx * nx + ny * ny + nz * nz)
        nx = nx / norm
        ny = ny / norm
        nz = nz / norm
        if dome is not None:
            red, green, blue = _part_color(shapes, patch, shape, lx, ly, lz, nx, ny, nz)
        if room is not None:
            red, green, blue = _furniture_color(shapes, shape, lx, ly, lz, hx, hy, hz)
    else:
        if dome is not None:
            red, green, blue = _dome_color(dome, face, x, y, z)
        if room is not None:
            red, green, blue = _face_color(room, face, x, y, z)
    if shape < 0 and face == DOME:
        return red, green, blue, t, shape
    level = _brightness(shapes, light, x, y, z, nx, ny, nz)
    return red * level * light.color[0], green * level * light.color[1], blue * level * light.color[2], t, shape


@compiled
def _trace(shapes, light, dome, patch, room, pose, rays):
    """Render the pixels of `trace`, with either a dome and a patch or a room. The rest is None."""
    pixels, samples, _ = rays.shape
    colors = np.zeros((pixels, 3))
    coverage = np.zeros(pixels)
    distances = np.zeros(pixels)
    ox = pose[0, 3]
    oy = pose[1, 3]
    oz = pose[2, 3]
    for pixel in range(pixels):
        for sample in range(samples):
            dx, dy, dz = map_direction(pose, rays[pixel, sample, 0], rays[pixel, sample, 1], rays[pixel, sample, 2])
            red, green, blue, t, shape = _shade(shapes, light, dome, patch, room, ox, oy, oz, dx, dy, dz)
            colors[pixel, 0] += red / samples
            colors[pixel, 1] += green / samples
            colors[pixel, 2] += blue / samples
            coverage[pixel] += (shape >= 0) / samples
            if sample == samples // 2:
                distances[pixel] = t
    return colors, coverage, distances


def trace(
    shapes: Shapes, light: Light, surroundings: tuple[Dome, Patch] | Room, pose: Array, rays: Array
) -> tuple[Array, Array, Array]:
    """Render colours [pixel 3], coverage by shapes [pixel] and distances [pixel] for the pose `camera_to_world`.

    The `rays` [pixel sample 3] are in the camera's frame and, in a dome, have unit length. Colours and coverage are
    means over a pixel's rays. The distance is measured along the middle ray, in units of its length.
    """
    if isinstance(surroundings, Room):
        return _trace(shapes, light, None, None, surroundings, pose, rays)
    dome, patch = surroundings
    return _trace(shapes, light, dome, patch, None, pose, rays)
