"""Compiled shading: colours of textures, patterns and sky, soft shadows, and the means of a pixel's samples.

The NamedTuples hold what kernels read. "Received" light is the radiance of a white matt surface. The kernels read a
tuple's arrays once, because numba counts a reference at each time.
"""

from math import floor, log2, sqrt
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt16

from completesplat.data.rendered.z_buffer import bilinear, compiled, inlined

CHECKER, NOISE, IMAGE = range(3)
"""Patterns of planes."""
SHADOW_BIAS = 0.01  # distance within which a place does not shadow itself
STRIDE = 4  # each of so many neighbouring samples looks at other places of the sun
SHEEN = 0.03  # share of the light that matt surfaces reflect whatever their colour is: 0.02 to 0.06 in Blender
LEAST_COSINE = 0.05  # of the angle at which a plane is seen; it limits a sample's size on it


class View(NamedTuple):
    """Pinhole camera in samples; `rotation` is from the world to the camera."""

    eye: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]
    focal: float
    center: Float[np.ndarray, " 2"]


class Surfaces(NamedTuple):
    """The object's triangles: attributes of their corners, textures, and whether they are painted."""

    uv: Float[np.ndarray, "triangle 3 2"]
    normals: Float[np.ndarray, "triangle 3 3"]
    colors: Float[np.ndarray, "triangle 3 3"]
    texture: Int[np.ndarray, " triangle"]
    texels: UInt16[np.ndarray, " value"]
    levels: Int[np.ndarray, "texture level 3"]
    back: Bool[np.ndarray, " triangle"]


class Planes(NamedTuple):
    """Floor and walls: rectangles and their patterns.

    Attributes:
        first, second, normals: unit vectors along the sides and across.
        lengths: of the two sides.
        texture: number of a plane's texture, if it has one.
        repeats: copies of a pattern in a unit of length.
        lattice: random values of the noise.
    """

    corners: Float[np.ndarray, "plane 3"]
    first: Float[np.ndarray, "plane 3"]
    second: Float[np.ndarray, "plane 3"]
    normals: Float[np.ndarray, "plane 3"]
    lengths: Float[np.ndarray, "plane 2"]
    patterns: Int[np.ndarray, " plane"]
    colors: Float[np.ndarray, "plane 2 3"]
    repeats: Float[np.ndarray, " plane"]
    texture: Int[np.ndarray, " plane"]
    texels: UInt16[np.ndarray, " value"]
    levels: Int[np.ndarray, "texture level 3"]
    lattice: Float[np.ndarray, " value"]


class LightArrays(NamedTuple):
    """Sun and sky, in linear light.

    Attributes:
        sun: received light of a surface that faces the sun.
        softness: tangent of half the sun's angle.
        sky: colours of the sky at the horizon and at the zenith.
        ambient: received light but the sun's, by the z of a surface's normal, from -1 to 1.
        axes: unit vectors, two across the sun's rays and one along them.
        shadow: depth of the object from the sun, over the square from -1 to 1.
        nearest: least depth that a place in each block of the shadow's pixels compares itself with.
        offsets: places in the unit disc.
    """

    sun: Float[np.ndarray, " 3"]
    softness: float
    sky: Float[np.ndarray, "2 3"]
    ambient: Float[np.ndarray, "step 3"]
    axes: Float[np.ndarray, "3 3"]
    shadow: Float[np.ndarray, "side side"]
    nearest: Float[np.ndarray, "block block"]
    offsets: Float[np.ndarray, "offset 2"]


@inlined
def component(axes, k, x, y, z):
    return axes[k, 0] * x + axes[k, 1] * y + axes[k, 2] * z


@inlined
def filtered(texels, levels, number, u, v, area):
    """Return the linear colour of a texture; `area`, of a sample in texture coordinates, chooses the halved copy."""
    covered = area * levels[number, 0, 1] * levels[number, 0, 2]
    level = 0
    if covered > 1.0:
        level = min(int(0.5 * log2(covered) + 0.5), levels.shape[1] - 1)
    start = levels[number, level, 0]
    width = levels[number, level, 1]
    height = levels[number, level, 2]
    red = bilinear(texels, start, width, height, u, v, 0)
    green = bilinear(texels, start, width, height, u, v, 1)
    blue = bilinear(texels, start, width, height, u, v, 2)
    return red, green, blue


@inlined
def octave(lattice, x, y):
    """Return smooth noise from 0 to 1 whose features have size 1."""
    left = floor(x)
    low = floor(y)
    across = x - left
    up = y - low
    across = across * across * (3 - 2 * across)
    up = up * up * (3 - 2 * up)
    first = int(left) * 73 + int(low) * 179
    size = len(lattice)
    lower = (1 - across) * lattice[first % size] + across * lattice[(first + 73) % size]
    upper = (1 - across) * lattice[(first + 179) % size] + across * lattice[(first + 252) % size]
    return (1 - up) * lower + up * upper


@inlined
def pattern_color(  # noqa: PLR0913
    k, patterns, colors, repeats, texture, texels, levels, lattice, along_first, along_second, size
):
    """Return the linear colour of a plane at lengths along its sides; `size` is that of a sample on it."""
    u = along_first * repeats[k]
    v = along_second * repeats[k]
    extent = size * repeats[k]
    if patterns[k] == IMAGE:
        return filtered(texels, levels, texture[k], u, v, extent * extent)
    if patterns[k] == CHECKER:
        share = (floor(u) + floor(v)) % 2.0
    else:
        share = (2 * octave(lattice, u, v) + octave(lattice, 2 * u, 2 * v)) / 3
    # Samples that are wider than the pattern show its mean.
    share += (0.5 - share) * min(max(extent - 1.0, 0.0), 1.0)
    red = (1 - share) * colors[k, 0, 0] + share * colors[k, 1, 0]
    green = (1 - share) * colors[k, 0, 1] + share * colors[k, 1, 1]
    blue = (1 - share) * colors[k, 0, 2] + share * colors[k, 1, 2]
    return red, green, blue


@inlined
def sky_color(sky, ray_x, ray_y, ray_z):
    share = max(ray_z, 0.0) / sqrt(ray_x * ray_x + ray_y * ray_y + ray_z * ray_z)
    red = (1 - share) * sky[0, 0] + share * sky[1, 0]
    green = (1 - share) * sky[0, 1] + share * sky[1, 1]
    blue = (1 - share) * sky[0, 2] + share * sky[1, 2]
    return red, green, blue


@inlined
def sun_share(  # noqa: PLR0913
    axes, shadow, nearest, offsets, softness, x, y, z, first, step
):
    """Return which share of the sun reaches a place (percentage-closer soft shadows, Fernando 2005).

    Args:
        first, step: the offsets that are looked at.
    """
    side = len(shadow)
    scale = 0.5 * side
    column = (component(axes, 0, x, y, z) + 1.0) * scale
    row = (component(axes, 1, x, y, z) + 1.0) * scale
    here = component(axes, 2, x, y, z) - SHADOW_BIAS
    blocks = len(nearest)
    block_row = min(max(int(row * blocks / side), 0), blocks - 1)
    block_column = min(max(int(column * blocks / side), 0), blocks - 1)
    if here <= nearest[block_row, block_column]:
        return 1.0
    reach = softness * side + 1.5
    if min(row, column) < -reach or max(row, column) > side + reach:
        return 1.0
    blockers = 0
    gap = 0.0
    for k in range(first, len(offsets), step):
        i = floor(row + reach * offsets[k, 1])
        j = floor(column + reach * offsets[k, 0])
        if 0 <= i < side and 0 <= j < side and shadow[i, j] < here:
            blockers += 1
            gap += here - shadow[i, j]
    if blockers == 0:
        return 1.0
    reach = softness * gap / blockers * scale + 1.5
    dark = 0
    count = 0
    for k in range(first, len(offsets), step):
        i = floor(row + reach * offsets[k, 1])
        j = floor(column + reach * offsets[k, 0])
        count += 1
        if 0 <= i < side and 0 <= j < side and shadow[i, j] < here:
            dark += 1
    return 1.0 - dark / count


@inlined
def ambient_light(ambient, height):
    """Return the light but the sun's that a surface receives whose unit normal has this z."""
    position = 0.5 * (height + 1.0) * (len(ambient) - 1)
    low = min(max(int(position), 0), len(ambient) - 2)
    upper = position - low
    red = (1 - upper) * ambient[low, 0] + upper * ambient[low + 1, 0]
    green = (1 - upper) * ambient[low, 1] + upper * ambient[low + 1, 1]
    blue = (1 - upper) * ambient[low, 2] + upper * ambient[low + 1, 2]
    return red, green, blue


@compiled
def draw_planes(view, planes, numbers, depth):
    """Find the nearest plane at each sample.

    Args:
        numbers: [height width], full of `NOTHING`; overwritten by the number of the nearest plane.
        depth: [height width], infinite; overwritten where a plane is nearer.
    """
    height, width = depth.shape
    rotation = view.rotation
    for k in range(len(planes.corners)):
        from_x = view.eye[0] - planes.corners[k, 0]
        from_y = view.eye[1] - planes.corners[k, 1]
        from_z = view.eye[2] - planes.corners[k, 2]
        offset = -component(planes.normals, k, from_x, from_y, from_z)
        for row in range(height):
            ray_y = (row + 0.5 - view.center[1]) / view.focal
            for column in range(width):
                ray_x = (column + 0.5 - view.center[0]) / view.focal
                x = ray_x * rotation[0, 0] + ray_y * rotation[1, 0] + rotation[2, 0]
                y = ray_x * rotation[0, 1] + ray_y * rotation[1, 1] + rotation[2, 1]
                z = ray_x * rotation[0, 2] + ray_y * rotation[1, 2] + rotation[2, 2]
                facing = component(planes.normals, k, x, y, z)
                if facing == 0.0:
                    continue
                distance = offset / facing
                if distance <= 0.0 or distance >= depth[row, column]:
                    continue
                place_x = from_x + distance * x
                place_y = from_y + distance * y
                place_z = from_z + distance * z
                across = component(planes.first, k, place_x, place_y, place_z)
                up = component(planes.second, k, place_x, place_y, place_z)
                if 0.0 <= across <= planes.lengths[k, 0] and 0.0 <= up <= planes.lengths[k, 1]:
                    depth[row, column] = distance
                    numbers[row, column] = k


@compiled
def shade(  # noqa: PLR0913
    view, samples, surfaces, planes, light, paint, points, triangles, weights, depth, numbers, distance, image, coverage
):
    """Shade all samples, and write the means over each pixel's samples x samples.

    Args:
        paint: linear colour of the triangles that are painted.
        points, triangles, weights, depth: see `draw_triangles`.
        numbers, distance: see `draw_planes`.
        image: [height width 3], written, linear.
        coverage: [height width], written: the object's share of each pixel.
    """
    height, width = coverage.shape
    eye = view.eye
    rotation = view.rotation
    focal = view.focal
    center = view.center
    uv = surfaces.uv
    normals = surfaces.normals
    colors = surfaces.colors
    texture = surfaces.texture
    texels = surfaces.texels
    levels = surfaces.levels
    back = surfaces.back
    corners = planes.corners
    firsts = planes.first
    seconds = planes.second
    plane_normals = planes.normals
    patterns = planes.patterns
    plane_colors = planes.colors
    repeats = planes.repeats
    plane_texture = planes.texture
    plane_texels = planes.texels
    plane_levels = planes.levels
    lattice = planes.lattice
    sun = light.sun
    softness = light.softness
    sky = light.sky
    ambient = light.ambient
    axes = light.axes
    shadow = light.shadow
    nearest = light.nearest
    offsets = light.offsets
    step = STRIDE if samples > 1 else 1
    for pixel in range(height * width):
        red_sum = 0.0
        green_sum = 0.0
        blue_sum = 0.0
        covered = 0
        for sample in range(samples * samples):
            row = pixel // width * samples + sample // samples
            column = pixel % width * samples + sample % samples
            first = (row + 2 * column) % step
            ray_x = (column + 0.5 - center[0]) / focal
            ray_y = (row + 0.5 - center[1]) / focal
            x = ray_x * rotation[0, 0] + ray_y * rotation[1, 0] + rotation[2, 0]
            y = ray_x * rotation[0, 1] + ray_y * rotation[1, 1] + rotation[2, 1]
            z = ray_x * rotation[0, 2] + ray_y * rotation[1, 2] + rotation[2, 2]
            t = triangles[row, column]
            k = numbers[row, column]
            here = distance[row, column]
            if t >= 0 and depth[row, column] <= here:
                covered += 1
                here = depth[row, column]
                b = weights[row, column, 0]
                c = weights[row, column, 1]
                a = 1.0 - b - c
                if back[t]:
                    red, green, blue = paint[0], paint[1], paint[2]
                else:
                    bx = points[t, 1, 0] - points[t, 0, 0]
                    by = points[t, 1, 1] - points[t, 0, 1]
                    cx = points[t, 2, 0] - points[t, 0, 0]
                    cy = points[t, 2, 1] - points[t, 0, 1]
                    on_image = abs(bx * cy - by * cx)
                    bu = uv[t, 1, 0] - uv[t, 0, 0]
                    bv = uv[t, 1, 1] - uv[t, 0, 1]
                    cu = uv[t, 2, 0] - uv[t, 0, 0]
                    cv = uv[t, 2, 1] - uv[t, 0, 1]
                    area = abs(bu * cv - bv * cu) / max(on_image, 1e-12)
                    u = uv[t, 0, 0] + b * bu + c * cu
                    v = uv[t, 0, 1] + b * bv + c * cv
                    number = texture[t]
                    red, green, blue = filtered(texels, levels, number, u, v, area)
                    red *= a * colors[t, 0, 0] + b * colors[t, 1, 0] + c * colors[t, 2, 0]
                    green *= a * colors[t, 0, 1] + b * colors[t, 1, 1] + c * colors[t, 2, 1]
                    blue *= a * colors[t, 0, 2] + b * colors[t, 1, 2] + c * colors[t, 2, 2]
                normal_x = a * normals[t, 0, 0] + b * normals[t, 1, 0] + c * normals[t, 2, 0]
                normal_y = a * normals[t, 0, 1] + b * normals[t, 1, 1] + c * normals[t, 2, 1]
                normal_z = a * normals[t, 0, 2] + b * normals[t, 1, 2] + c * normals[t, 2, 2]
                length = max(sqrt(normal_x * normal_x + normal_y * normal_y + normal_z * normal_z), 1e-12)
                if normal_x * x + normal_y * y + normal_z * z > 0.0:
                    length = -length
                normal_x /= length
                normal_y /= length
                normal_z /= length
            elif k >= 0:
                from_x = eye[0] + here * x - corners[k, 0]
                from_y = eye[1] + here * y - corners[k, 1]
                from_z = eye[2] + here * z - corners[k, 2]
                facing = component(plane_normals, k, x, y, z)
                size = here / focal / max(abs(facing) / sqrt(x * x + y * y + z * z), LEAST_COSINE)
                along_first = component(firsts, k, from_x, from_y, from_z)
                along_second = component(seconds, k, from_x, from_y, from_z)
                pattern = (patterns, plane_colors, repeats, plane_texture, plane_texels, plane_levels, lattice)
                red, green, blue = pattern_color(k, *pattern, along_first, along_second, size)
                side = -1.0 if facing > 0.0 else 1.0
                normal_x = side * plane_normals[k, 0]
                normal_y = side * plane_normals[k, 1]
                normal_z = side * plane_normals[k, 2]
            else:
                red, green, blue = sky_color(sky, x, y, z)
                red_sum += min(red, 1.0)
                green_sum += min(green, 1.0)
                blue_sum += min(blue, 1.0)
                continue
            place_x = eye[0] + here * x
            place_y = eye[1] + here * y
            place_z = eye[2] + here * z
            lit_red, lit_green, lit_blue = ambient_light(ambient, normal_z)
            cosine = -component(axes, 2, normal_x, normal_y, normal_z)
            if cosine > 0.0:
                cosine *= sun_share(axes, shadow, nearest, offsets, softness, place_x, place_y, place_z, first, step)
                lit_red += cosine * sun[0]
                lit_green += cosine * sun[1]
                lit_blue += cosine * sun[2]
            red_sum += min((SHEEN + (1 - SHEEN) * red) * lit_red, 1.0)
            green_sum += min((SHEEN + (1 - SHEEN) * green) * lit_green, 1.0)
            blue_sum += min((SHEEN + (1 - SHEEN) * blue) * lit_blue, 1.0)
        count = samples * samples
        image[pixel // width, pixel % width, 0] = red_sum / count
        image[pixel // width, pixel % width, 1] = green_sum / count
        image[pixel // width, pixel % width, 2] = blue_sum / count
        coverage[pixel // width, pixel % width] = covered / count
