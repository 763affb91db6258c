"""Surfaces given by depth images: their normals, and which of them another camera does not see."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.geometry.cameras import Cameras, pixel_centers, pixel_rays, project, unproject

DepthMaps = Float[Tensor, "*batch 1 height width"]
VectorMaps = Float[Tensor, "*batch 3 height width"]


def normals_from_depth(depth: DepthMaps, cameras: Cameras) -> VectorMaps:
    """Return unit normals in the camera's frame (+x right, +y down, +z forward) that face the camera.

    A pixel's normal is orthogonal to two lines: through the points of its left and right neighbours, and through those
    above and below. It is exact on planes, and of second order in the pixels' distance on smooth surfaces. The pixel's
    own point replaces a missing neighbour.

    Args:
        depth: along the optical axis, at the pixels' centres. Values that are not finite or not positive are missing.
        cameras: of the depth's size, [*batch] or one for all. Only their intrinsics matter.

    Returns:
        Normals, 0 where the depth is missing, or where both neighbours in a row or a column are.
    """
    known = depth.isfinite() & (depth > 0)
    points = torch.where(known, depth, 0) * pixel_rays(cameras).movedim(-1, -3)
    right = _difference(points, known, -1)
    down = _difference(points, known, -2)
    # Rows run downwards: right x down would point away from the camera.
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, right, dim=-3), dim=-3, eps=1e-30)
    return torch.where(known, normals, 0)


def _difference(points: VectorMaps, known: Bool[Tensor, "*batch 1 height width"], axis: int) -> VectorMaps:
    """Subtract the point before from the next one, where the point itself replaces a missing one."""
    indices = torch.arange(points.shape[axis], device=points.device)
    before, following = (
        torch.where(known.index_select(axis, index), points.index_select(axis, index), points)
        for index in ((indices - 1).clamp(min=0), (indices + 1).clamp(max=len(indices) - 1))
    )
    return following - before


TOLERANCE = 0.03
"""Relative difference in depth from which on surfaces differ; a pixel of one slanted surface spans less."""


def hidden_from(
    reference: Cameras,
    reference_depth: Float[Tensor, "1 height width"],
    cameras: Cameras,
    depths: Float[Tensor, "view 1 height width"],
) -> tuple[Bool[Tensor, "view height width"], Bool[Tensor, "view height width"]]:
    """Return masks of the pixels whose surface the reference view hides, and of those for which this is known.

    A surface is hidden if it lies outside the reference image, behind the reference camera, or behind the surface that
    the reference shows there. This is unknown if the depth is missing (0) in the view itself or in the reference.
    """
    height, width = reference.image_size
    pixels = pixel_centers(height, width, depths.device, depths.dtype).flatten(0, 1)
    points = unproject(cameras, pixels, depths.flatten(1))
    places, ahead = project(reference, points)
    inside = (ahead > 0) & (places >= 0).all(-1) & (places < places.new_tensor([width, height])).all(-1)
    # The furthest of the four pixels around the point: at an edge it may belong to either side.
    corners = places.new_tensor([[0, 0], [0, 1], [1, 0], [1, 1]])
    around = (places - 0.5 + corners[:, None, None]).floor()
    columns, rows = around.nan_to_num().long().unbind(-1)
    front = reference_depth[0][rows.clamp(0, height - 1), columns.clamp(0, width - 1)]
    hidden = ~inside | (ahead > (1 + TOLERANCE) * front.amax(0))
    known = (depths.flatten(1) > 0) & (~inside | (front > 0).all(0))
    return (hidden & known).view(-1, height, width), known.view(-1, height, width)
