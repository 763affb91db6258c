"""Compiled kernels: nearest triangles and rectangles, lookups in textures, soft shadows.

Arguments that several kernels share:
    texels: linear RGBA of all textures, 16 bits each, one copy of a texture after the other (`mesh_reading.Textures`).
    levels: [texture level 3] first value, width and height of each copy of a texture, whose sides are half those of the
        copy before.
    texture: number of a triangle's or sample's texture.
    uv: texture coordinates; v goes up, and both repeat after 1.
"""

from functools import partial
from math import ceil, floor, log2

from completesplat.rasterizers.kernels.compilation import helper, kernel

NEAR = 1e-4  # depth up to which a triangle is left out
NOTHING = -1  # number of the triangle where no triangle is
OPAQUE = 0.5  # least alpha of what is drawn
LARGEST = 65535.0  # value of a texel

# Without the kernels' "fastmath", so that all machines draw the same images.
compiled = partial(kernel, fastmath=False)
inlined = partial(helper, fastmath=False)


@inlined
def texel(texels, start, width, column, row, channel):
    return texels[start + (row * width + column) * 4 + channel]


@inlined
def bilinear(texels, start, width, height, u, v, channel):
    """Return a channel, 0 to 1, at texture coordinates that repeat; v goes up."""
    x = (u - floor(u)) * width - 0.5
    y = (1.0 - (v - floor(v))) * height - 0.5
    left = floor(x)
    top = floor(y)
    across = x - left
    down = y - top
    left = int(left)
    top = int(top)
    right = (left + 1) % width
    below = (top + 1) % height
    left = left % width
    top = top % height
    upper = (1 - across) * texel(texels, start, width, left, top, channel)
    upper += across * texel(texels, start, width, right, top, channel)
    lower = (1 - across) * texel(texels, start, width, left, below, channel)
    lower += across * texel(texels, start, width, right, below, channel)
    return ((1 - down) * upper + down * lower) / LARGEST


@compiled
def draw_triangles(points, uv, texture, texels, levels, cut, triangles, weights, depth):  # noqa: PLR0913
    """Find the nearest triangle at each pixel's centre.

    Args:
        points: [triangle 3 3] x and y in pixels, and depth, of the corners.
        cut: whether a texture's transparent parts are left out.
        triangles: [height width], full of `NOTHING`; overwritten by the number of the nearest triangle.
        weights: [height width 2]; overwritten by perspectively correct weights of the second and third corner.
        depth: [height width], infinite; overwritten where a triangle is nearer.
    """
    height, width = depth.shape
    for t in range(len(points)):
        depth_a = points[t, 0, 2]
        depth_b = points[t, 1, 2]
        depth_c = points[t, 2, 2]
        if min(depth_a, depth_b, depth_c) <= NEAR:
            continue
        ax = points[t, 0, 0]
        ay = points[t, 0, 1]
        bx = points[t, 1, 0] - ax
        by = points[t, 1, 1] - ay
        cx = points[t, 2, 0] - ax
        cy = points[t, 2, 1] - ay
        area = bx * cy - by * cx
        if area == 0.0:
            continue
        first_row = max(0, ceil(ay + min(0.0, by, cy) - 0.5))
        last_row = min(height - 1, floor(ay + max(0.0, by, cy) - 0.5))
        first_column = max(0, ceil(ax + min(0.0, bx, cx) - 0.5))
        last_column = min(width - 1, floor(ax + max(0.0, bx, cx) - 0.5))
        for row in range(first_row, last_row + 1):
            y = row + 0.5 - ay
            for column in range(first_column, last_column + 1):
                x = column + 0.5 - ax
                second = (x * cy - y * cx) / area
                third = (bx * y - by * x) / area
                if second < 0.0 or third < 0.0 or second + third > 1.0:
                    continue
                here = 1.0 / ((1.0 - second - third) / depth_a + second / depth_b + third / depth_c)
                if here >= depth[row, column]:
                    continue
                second *= here / depth_b
                third *= here / depth_c
                if cut:
                    first = 1.0 - second - third
                    u = first * uv[t, 0, 0] + second * uv[t, 1, 0] + third * uv[t, 2, 0]
                    v = first * uv[t, 0, 1] + second * uv[t, 1, 1] + third * uv[t, 2, 1]
                    start, across, down = levels[texture[t], 0]
                    if bilinear(texels, start, across, down, u, v, 3) < OPAQUE:
                        continue
                depth[row, column] = here
                triangles[row, column] = t
                weights[row, column, 0] = second
                weights[row, column, 1] = third


@compiled
def look_up(texels, levels, texture, uv, area, colors):
    """Look linear colours up in textures.

    Args:
        texture: [sample] number of the texture.
        uv: [sample 2].
        area: [sample] of a sample in texture coordinates, which chooses the halved copy.
        colors: [sample 3], written.
    """
    for k in range(len(texture)):
        start, width, height = levels[texture[k], 0]
        covered = area[k] * width * height
        if covered > 1.0:
            level = min(int(0.5 * log2(covered) + 0.5), levels.shape[1] - 1)
            start, width, height = levels[texture[k], level]
        for channel in range(3):
            colors[k, channel] = bilinear(texels, start, width, height, uv[k, 0], uv[k, 1], channel)


@compiled
def light_share(places, depth, half, softness, offsets, bias, shares):
    """Find which share of the sun reaches places (percentage-closer soft shadows, Fernando 2005).

    Args:
        places: [place 3] in the sun's frame: x and y across, and depth along its rays.
        depth: [side side] of the object from the sun, over the square from -`half` to `half`.
        softness: tangent of half the sun's angle.
        offsets: [sample 2] in the unit disc.
        bias: distance within which a place does not shadow itself.
        shares: [place], written, 0 to 1.
    """
    side = len(depth)
    scale = side / (2 * half)
    for k in range(len(places)):
        x = (places[k, 0] + half) * scale
        y = (places[k, 1] + half) * scale
        here = places[k, 2] - bias
        blockers = 0
        gap = 0.0
        reach = softness * 2 * half * scale + 1.5
        for offset in offsets:
            row = floor(y + reach * offset[1])
            column = floor(x + reach * offset[0])
            if 0 <= row < side and 0 <= column < side and depth[row, column] < here:
                blockers += 1
                gap += here - depth[row, column]
        if blockers == 0:
            shares[k] = 1.0
            continue
        reach = softness * gap / blockers * scale + 1.5
        dark = 0
        for offset in offsets:
            row = floor(y + reach * offset[1])
            column = floor(x + reach * offset[0])
            if 0 <= row < side and 0 <= column < side and depth[row, column] < here:
                dark += 1
        shares[k] = 1.0 - dark / len(offsets)


@inlined
def along(vector, x, y, z):
    return vector[0] * x + vector[1] * y + vector[2] * z


@compiled
def draw_rectangles(eye, rotation, focal, center, rectangles, numbers, depth):
    """Find the nearest rectangle at each pixel's centre.

    Args:
        eye, rotation, focal, center: a pinhole camera; `rotation` is from the world to the camera.
        rectangles: [rectangle 4 3] a corner, the vectors of the two sides, which are perpendicular, and the normal.
        numbers: [height width], full of `NOTHING`; overwritten by the number of the nearest rectangle.
        depth: [height width], infinite; overwritten where a rectangle is nearer.
    """
    height, width = depth.shape
    for k in range(len(rectangles)):
        corner, first, second, normal = rectangles[k]
        from_x = eye[0] - corner[0]
        from_y = eye[1] - corner[1]
        from_z = eye[2] - corner[2]
        offset = -along(normal, from_x, from_y, from_z)
        first_square = along(first, first[0], first[1], first[2])
        second_square = along(second, second[0], second[1], second[2])
        for row in range(height):
            y = (row + 0.5 - center[1]) / focal
            for column in range(width):
                x = (column + 0.5 - center[0]) / focal
                ray_x = x * rotation[0, 0] + y * rotation[1, 0] + rotation[2, 0]
                ray_y = x * rotation[0, 1] + y * rotation[1, 1] + rotation[2, 1]
                ray_z = x * rotation[0, 2] + y * rotation[1, 2] + rotation[2, 2]
                facing = along(normal, ray_x, ray_y, ray_z)
                if facing == 0.0:
                    continue
                distance = offset / facing
                if distance <= 0.0 or distance >= depth[row, column]:
                    continue
                place_x = from_x + distance * ray_x
                place_y = from_y + distance * ray_y
                place_z = from_z + distance * ray_z
                across = along(first, place_x, place_y, place_z) / first_square
                up = along(second, place_x, place_y, place_z) / second_square
                if 0.0 <= across <= 1.0 and 0.0 <= up <= 1.0:
                    depth[row, column] = distance
                    numbers[row, column] = k
