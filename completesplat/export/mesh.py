"""Closed triangle mesh of a scene: rendered depths, fused into a signed distance field (Curless and Levoy 1996)."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from completesplat.errors import CompleteSplatError, needing
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, look_at, pixel_centers, project, unproject
from completesplat.rasterizers import Rasterizer

VOXELS = 128  # along the longest side of the box
VIEWS = 64
SIDE = 256
TRUNCATION = 4.0  # voxels
REACH = 1.25  # radius of the ball, over half the width that the photo shows at the pivot

Points = Float[Tensor, "point 3"]
Faces = Int[np.ndarray, "face 3"]
Maps = Float[Tensor, "view channel height width"]


class Mesh(NamedTuple):
    """Closed surface with sRGB colours, whose triangles run counter-clockwise, seen from outside."""

    vertices: Points
    faces: Faces
    colors: Points
    voxel: float


def check_available() -> None:
    """Raise an error if scikit-image, which finds the triangles, is missing."""
    with needing("mesh", "formats=[mesh] needs scikit-image"):
        import skimage.measure  # noqa: F401


@torch.no_grad()
def mesh_of(rasterizer: Rasterizer, scene: Gaussians, reference: Cameras, pivot: Float[Tensor, "3"]) -> Mesh:
    """Return a mesh of the ball around what the photo shows in its middle, as `VIEWS` cameras around it see it.

    What no camera sees counts as inside, so that an object becomes a solid. Only the largest solid is kept.

    Raises:
        CompleteSplatError: there is no surface in the ball.
    """
    check_available()
    arm = pivot - reference.centers
    tangent = reference.image_size[1] / 2 / reference.intrinsics[0, 0].item()
    radius = REACH * tangent * arm.norm().item()
    # The pivot lies on the front, or in objects.
    center = pivot + torch.nn.functional.normalize(arm, dim=-1) * radius / 3
    scene = scene[(scene.means - center).norm(dim=-1) < radius]
    cameras = cameras_around(center, radius, tangent)
    views = [rasterizer(scene[None], cameras[i : i + 1][None])[0, 0] for i in range(VIEWS)]
    maps = torch.stack([torch.cat([view.surface_depth(), view.color / view.alpha.clamp(min=1e-10)]) for view in views])
    depths = maps[:, 0].flatten(1)
    if not (depths > 0).any():
        raise CompleteSplatError("mesh: no surface in the middle of the photo")
    seen = unproject(cameras, pixel_centers(SIDE, SIDE, maps.device).flatten(0, 1), depths)[depths > 0]
    voxel = max((seen.amax(0) - seen.amin(0)).max().item(), 1e-3 * radius) / VOXELS
    low = seen.amin(0) - 2 * voxel
    high = seen.amax(0) + 2 * voxel
    axes = [torch.arange(low[i].item(), high[i].item(), voxel, device=maps.device) for i in range(3)]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1)
    field = signed_distances(grid.flatten(0, 2), cameras, maps[:, :1], TRUNCATION * voxel).view(grid.shape[:3])
    field = torch.where((grid - center).norm(dim=-1) < radius, field, 1)
    if not (field < 0).any():
        raise CompleteSplatError("mesh: what is seen in the middle of the photo is too thin to be a solid")
    corners, faces, normals = surface_of(field.cpu().numpy())
    vertices = low + voxel * corners.to(low)
    return Mesh(vertices, faces, vertex_colors(vertices, normals.to(low), cameras, maps, 2 * voxel), voxel)


def cameras_around(center: Float[Tensor, "3"], radius: float, tangent: float) -> Cameras:
    """Return cameras that see a whole ball, evenly spread around it (Fibonacci's lattice)."""
    index = torch.arange(VIEWS, device=center.device) + 0.5
    height = 1 - 2 * index / VIEWS
    angle = index * math.pi * (3 - math.sqrt(5))
    ring = (1 - height**2).sqrt()
    distance = radius * math.sqrt(1 + tangent**-2)  # radius / sin(fov / 2)
    eyes = center + distance * torch.stack([ring * angle.cos(), height, ring * angle.sin()], dim=-1)
    focal = SIDE / 2 / tangent
    half = SIDE / 2
    intrinsics = center.new_tensor([[focal, 0, half], [0, focal, half], [0, 0, 1]]).expand(VIEWS, 3, 3)
    return Cameras(look_at(eyes, center, center.new_tensor([0, -1, 0])), intrinsics, (SIDE, SIDE))


def looked_up(points: Points, cameras: Cameras, maps: Maps) -> Iterator[tuple[Tensor, Float[Tensor, " point"]]]:
    """Yield the values [channel, point] of the pixels that show the points, and the points' depths, for each view."""
    for camera, values in enumerate(maps):
        places, ahead = project(cameras[camera], points)
        column, row = places.floor().long().clamp(0, SIDE - 1).unbind(-1)
        yield values[:, row, column], ahead


def signed_distances(points: Points, cameras: Cameras, depths: Maps, truncation: float) -> Float[Tensor, " point"]:
    """Return mean signed distances to the surfaces in units of the truncation, from -1 (inside, unseen) to 1."""
    total = torch.zeros_like(points[:, 0])
    weights = torch.zeros_like(points[:, 0])
    for (depth,), ahead in looked_up(points, cameras, depths):
        distance = ((torch.where(depth > 0, depth, torch.inf) - ahead) / truncation).clamp(max=1)
        weight = (1 + distance).clamp(0, 1)  # behind a surface, less is known
        total = total + weight * distance.clamp(min=-1)
        weights = weights + weight
    return torch.where(weights > 0, total / weights.clamp(min=1e-6), -1)


def surface_of(field: Float[np.ndarray, "x y z"]) -> tuple[Points, Faces, Points]:
    """Return vertices in voxels, triangles and outward normals of the largest solid with negative distances."""
    from skimage import measure

    def largest(mask: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
        pieces = measure.label(mask, connectivity=1)  # type: ignore[no-untyped-call]
        return np.asarray(pieces == np.bincount(pieces[mask]).argmax())

    field = np.pad(field, 1, constant_values=1)
    solid = ~largest(~largest(field < 0))
    field = np.where(solid, -np.abs(field).clip(1e-3), np.abs(field).clip(1e-3))
    corners, faces, normals, _ = measure.marching_cubes(-field, 0, allow_degenerate=False)  # type: ignore[no-untyped-call]
    # scikit-image's triangles are clockwise, seen from outside.
    return torch.from_numpy(corners - 1), faces[:, ::-1].copy(), torch.from_numpy(normals.copy())


def vertex_colors(vertices: Points, normals: Points, cameras: Cameras, maps: Maps, behind: float) -> Points:
    """Return mean colours over views, weighted by the squared cosine between normal and ray.

    Views that do not see a vertex hardly count.
    """
    total = torch.zeros_like(vertices)
    weights = torch.zeros_like(vertices[:, :1])
    for center, ((depth, *color), ahead) in zip(cameras.centers, looked_up(vertices, cameras, maps), strict=True):
        cosine = torch.nn.functional.cosine_similarity(center - vertices, normals, dim=-1).clamp(min=1e-3)
        weight = (cosine.square() * ((depth > 0) & (ahead < depth + behind)).float().clamp(min=1e-6))[:, None]
        total = total + weight * torch.stack(color, dim=-1)
        weights = weights + weight
    return (total / weights).clamp(0, 1)
