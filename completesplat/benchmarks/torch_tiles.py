"""Projection for the pure-torch baseline, all views at once, and the lists of Gaussians that each tile draws.

A splat is one Gaussian as seen by one camera. Splats are numbered [batch view gaussian], flattened. The exponent is

    log2 alpha(x, y) = log_opacity - (root_x dx + root_y dy)^2 - rest_y dy^2,   dx = x - center_x, dy = y - center_y,

with the Cholesky factor of the inverse covariance. Unlike the three entries of the inverse itself, it loses nothing to
cancellation when a splat is long and thin.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.geometry.rotations import quaternion_to_matrix
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.reference import LARGEST_PROJECTION
from completesplat.tensors import TensorDataclass

TILE_HEIGHT, TILE_WIDTH = 4, 8  # px
HALF_LOG2_E = 0.5 / math.log(2)
# A splat's outline is moved out by this much, in bits of alpha and in px, so that rounding never hides a pixel.
SLACK_BITS, SLACK_PIXELS = 1e-3, 1e-3


@dataclass(frozen=True)
class Splats(TensorDataclass):
    """All Gaussians as seen by all cameras. Those that are not `drawable` hold harmless values without gradients."""

    log_opacities: Float[Tensor, " splat"]
    root_x: Float[Tensor, " splat"]
    root_y: Float[Tensor, " splat"]
    rest_y: Float[Tensor, " splat"]
    center_x: Float[Tensor, " splat"]
    center_y: Float[Tensor, " splat"]
    depths: Float[Tensor, " splat"]
    colors: Float[Tensor, "3 splat"]
    drawable: Bool[Tensor, " splat"]


@dataclass(frozen=True)
class TileLists:
    """Splats of all tiles of all images, tile after tile, front to back."""

    splats: Int[Tensor, " entry"]
    ends: Int[Tensor, " tile"]
    grid: tuple[int, int]
    """Rows and columns of tiles in an image."""

    def centers(self) -> Float[Tensor, "tile 2"]:
        """Return the centres (x, y) of all tiles, in px of their image."""
        rows, columns = self.grid
        y, x = torch.meshgrid(torch.arange(rows) + 0.5, torch.arange(columns) + 0.5, indexing="ij")
        one_image = torch.stack([x * TILE_WIDTH, y * TILE_HEIGHT], dim=-1).flatten(0, 1)
        return one_image.repeat(self.ends.numel() // (rows * columns), 1)


def project(gaussians: Gaussians, cameras: Cameras, constants: RenderingConstants) -> Splats:
    """Project scenes [batch] for cameras [batch view], with the function of `reference.project_gaussians`.

    Values of splats that cannot be drawn are replaced by constants wherever NaN or infinity could enter a gradient.
    """
    finite = gaussians.finite()
    sane = gaussians.map(lambda t: t.where(finite.reshape(finite.shape + (1,) * (t.ndim - 2)), torch.zeros_like(t)))
    (batch, view), count = cameras.intrinsics.shape[:2], gaussians.count
    rotation = cameras.world_to_camera[..., :3, :3].reshape(batch, 3 * view, 3)
    translation = cameras.world_to_camera[..., :3, 3].reshape(batch, 3 * view, 1)
    points = (rotation @ sane.means.mT + translation).reshape(batch, view, 3, count)
    roots = (quaternion_to_matrix(sane.quaternions) * sane.scales[..., None, :]).permute(0, 2, 3, 1)
    roots = (rotation @ roots.reshape(batch, 3, 3 * count)).reshape(batch, view, 3, 3, count)

    x, y, z = points.unbind(2)
    front = (z > constants.near_plane) & z.isfinite()
    z = torch.where(front, z, torch.ones_like(z))
    height, width = cameras.image_size
    center_x, row_x = _project_axis(x, z, roots[:, :, 0], roots[:, :, 2], cameras, 0, width, constants)
    center_y, row_y = _project_axis(y, z, roots[:, :, 1], roots[:, :, 2], cameras, 1, height, constants)
    with torch.no_grad():
        bounded = (row_x.square().sum(2) <= LARGEST_PROJECTION) & (row_y.square().sum(2) <= LARGEST_PROJECTION)
        bounded &= (center_x.abs() <= LARGEST_PROJECTION) & (center_y.abs() <= LARGEST_PROJECTION)
        drawable = front & bounded & (finite & (gaussians.opacities >= constants.min_alpha))[:, None]
    center_x, center_y, z = (torch.where(drawable, t, torch.zeros_like(t)) for t in (center_x, center_y, z))
    row_x, row_y = (torch.where(drawable[:, :, None], t, torch.zeros_like(t)) for t in (row_x, row_y))
    opacities = torch.where(drawable, sane.opacities[:, None], torch.ones_like(z))
    colors = sane.colors.permute(2, 0, 1)[:, :, None].expand(3, batch, view, count).reshape(3, -1)
    root_x, root_y, rest_y = _factorize(row_x, row_y, constants.blur)
    fields = (opacities.log2(), root_x, root_y, rest_y, center_x, center_y, z)
    log_opacities, root_x, root_y, rest_y, center_x, center_y, z = (field.flatten() for field in fields)
    return Splats(log_opacities, root_x, root_y, rest_y, center_x, center_y, z, colors, drawable.flatten())


def _project_axis(
    offset: Float[Tensor, "batch view gaussian"],
    depth: Float[Tensor, "batch view gaussian"],
    root: Float[Tensor, "batch view 3 gaussian"],
    root_z: Float[Tensor, "batch view 3 gaussian"],
    cameras: Cameras,
    axis: int,
    extent: int,
    constants: RenderingConstants,
) -> tuple[Float[Tensor, "batch view gaussian"], Float[Tensor, "batch view 3 gaussian"]]:
    """Return centres along one image axis, and that axis' row of Jacobian x rotation x covariance root."""
    focal = cameras.intrinsics[..., axis, axis, None]
    principal = cameras.intrinsics[..., axis, 2, None]
    slope = offset / depth
    beyond = constants.frustum_margin * 0.5 * extent / focal
    limited = slope.clamp(-principal / focal - beyond, (extent - principal) / focal + beyond)
    return focal * slope + principal, (focal / depth)[:, :, None] * (root - limited[:, :, None] * root_z)


def _factorize(
    row_x: Float[Tensor, "batch view 3 gaussian"], row_y: Float[Tensor, "batch view 3 gaussian"], blur: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return (root_x, root_y, rest_y) of the covariance of these rows plus the blur."""
    variance_x, variance_y = row_x.square().sum(2), row_y.square().sum(2)
    covariance = (row_x * row_y).sum(2)
    (x1, x2, x3), (y1, y2, y3) = row_x.unbind(2), row_y.unbind(2)
    # Lagrange's identity: without blur, the determinant is the squared length of the rows' cross product.
    squared_area = (x2 * y3 - x3 * y2).square() + (x3 * y1 - x1 * y3).square() + (x1 * y2 - x2 * y1).square()
    determinant = (squared_area + blur * (variance_x + variance_y) + blur**2).clamp(min=1e-10)
    variance_y = variance_y + blur
    root_x = (HALF_LOG2_E * variance_y / determinant).sqrt()
    return root_x, -root_x * covariance / variance_y, HALF_LOG2_E / variance_y


@torch.no_grad()
def list_splats(splats: Splats, images: int, image_size: tuple[int, int], constants: RenderingConstants) -> TileLists:
    """List, for each tile, the splats whose outline (alpha = min_alpha) meets the hull of the tile's pixel centres.

    The test is exact: it finds the rows of tiles that an outline touches, then the outline's extent within each row.
    The lists are ordered by one sort of the splats by depth and one stable sort of the entries by tile.
    """
    height, width = image_size
    grid = -(-height // TILE_HEIGHT), -(-width // TILE_WIDTH)
    outlines, numbers = _outlines(splats, image_size, constants)
    y, reach_y = outlines[:, 1], outlines[:, 3]
    first = _first_pixel(y - reach_y, height) // TILE_HEIGHT
    counts = _last_pixel(y + reach_y, height) // TILE_HEIGHT - first + 1
    item, rank = _expand(counts)
    row = first.index_select(0, item) + rank

    left, right = _extent_in_row(outlines.index_select(0, item), row, height)
    start, stop = _first_pixel(left, width), _last_pixel(right, width)
    column = start // TILE_WIDTH
    counts = torch.where(stop >= start, stop // TILE_WIDTH - column + 1, 0)
    splat = numbers.index_select(0, item)
    tile = (splat // max(1, splats.depths.numel() // images) * grid[0] + row) * grid[1] + column
    entry, rank = _expand(counts)
    tile = (tile.index_select(0, entry) + rank).int()
    tile, order = tile.sort(stable=True)
    ordered = splat.int().index_select(0, entry.index_select(0, order))
    ends = torch.searchsorted(tile, torch.arange(images * grid[0] * grid[1], dtype=tile.dtype), right=True)
    return TileLists(ordered, ends, grid)


def _outlines(
    splats: Splats, image_size: tuple[int, int], constants: RenderingConstants
) -> tuple[Float[Tensor, "outline 8"], Int[Tensor, " outline"]]:
    """Return the ellipses that meet the image, front to back, with the numbers of their splats.

    Columns: centre x and y, reach in x and y, the shear dx/dy of the ellipse's axis of row midpoints, dy of its
    rightmost point, root_x, and rest_y over the level.
    """
    fields = [splats.center_x, splats.center_y, splats.root_x, splats.root_y, splats.rest_y, splats.log_opacities]
    numbers = splats.drawable.nonzero().squeeze(1)
    x, y, root_x, root_y, rest_y, log_opacities = (field.index_select(0, numbers) for field in fields)
    level = log_opacities - math.log2(constants.min_alpha) + SLACK_BITS
    shear = -root_y / root_x
    squared_y = level / rest_y
    reach_x = (level / root_x.square() + shear.square() * squared_y).sqrt()
    reach_y = squared_y.sqrt()
    height, width = image_size
    met = (x + reach_x >= 0) & (x - reach_x <= width) & (y + reach_y >= 0) & (y - reach_y <= height)
    met = met.nonzero().squeeze(1)
    # Positive floats have the same order as their bits, and torch sorts integers several times faster.
    depths = splats.depths.index_select(0, numbers).index_select(0, met)
    met = met.index_select(0, depths.view(torch.int32).sort(stable=True).indices)
    columns = [x, y, reach_x, reach_y, shear, shear * squared_y / reach_x, level.sqrt() / root_x, 1 / squared_y]
    return torch.stack(columns, dim=-1).index_select(0, met), numbers.index_select(0, met)


def _extent_in_row(
    outlines: Float[Tensor, "item 8"], row: Int[Tensor, " item"], height: int
) -> tuple[Float[Tensor, " item"], Float[Tensor, " item"]]:
    """Return the leftmost and rightmost x of ellipses between the first and last pixel centres of a row of tiles."""
    x, y, _, reach_y, shear, extreme, half_width, flattening = outlines.unbind(1)
    top = row * TILE_HEIGHT + 0.5
    bottom = torch.clamp(top + (TILE_HEIGHT - 1), max=height - 0.5)
    top, bottom = torch.maximum(top - y, -reach_y), torch.minimum(bottom - y, reach_y)

    def edge(side: int) -> Tensor:
        # The edge is a concave function of y (convex on the left), outermost at the y that is closest to its extreme.
        dy = torch.minimum(torch.maximum(side * extreme, top), bottom)
        return x + shear * dy + side * half_width * (1 - flattening * dy.square()).clamp(min=0).sqrt()

    return edge(-1), edge(1)


def _first_pixel(position: Float[Tensor, " n"], extent: int) -> Int[Tensor, " n"]:
    """Return the first pixel whose centre is not before this position; `extent` if there is none."""
    return (position - (0.5 + SLACK_PIXELS)).ceil().clamp(0, extent).int()


def _last_pixel(position: Float[Tensor, " n"], extent: int) -> Int[Tensor, " n"]:
    """Return the last pixel whose centre is not beyond this position; -1 if there is none."""
    return (position - (0.5 - SLACK_PIXELS)).floor().clamp(-1, extent - 1).int()


def _expand(counts: Int[Tensor, " n"]) -> tuple[Int[Tensor, " total"], Int[Tensor, " total"]]:
    """Repeat item i `counts[i]` times; return items, and the rank of each copy among those of its item."""
    item = torch.repeat_interleave(counts)
    before = counts.cumsum(0) - counts
    return item, torch.arange(item.numel()) - before.index_select(0, item)
