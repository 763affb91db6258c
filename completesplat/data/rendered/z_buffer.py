"""Compiled kernels: nearest triangles, and values of textures.

Arguments that several kernels share:
    texels: linear RGBA of all textures, 16 bits each, one copy of a texture after the other (`mesh_reading.Textures`).
    levels: [texture level 3] first value, width and height of each copy of a texture, whose sides are half those of the
        copy before.
    texture: number of a triangle's texture.
    uv: texture coordinates; v goes up, and both repeat after 1.
"""

from functools import partial
from math import ceil, floor

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
    right = left + 1 if left + 1 < width else 0
    below = top + 1 if top + 1 < height else 0
    left = left if left >= 0 else width - 1
    top = top if top >= 0 else height - 1
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
                    start = levels[texture[t], 0, 0]
                    across = levels[texture[t], 0, 1]
                    down = levels[texture[t], 0, 2]
                    if bilinear(texels, start, across, down, u, v, 3) < OPAQUE:
                        continue
                depth[row, column] = here
                triangles[row, column] = t
                weights[row, column, 0] = second
                weights[row, column, 1] = third
