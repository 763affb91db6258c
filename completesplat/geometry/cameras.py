"""Pinhole cameras and their conventions, which are stated here only.

Axes are OpenCV's: +x right, +y down, +z forward. `world_to_camera` maps homogeneous world points to camera
points. Intrinsics are in pixels. Pixel (column i, row j) covers [i, i + 1) x [j, j + 1), so its centre lies at
(i + 0.5, j + 0.5) and (0, 0) is the top left corner of the image.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.tensors import TensorDataclass

Vectors = Float[Tensor, "*#batch 3"]
Points = Float[Tensor, "*#batch n 3"]
Pixels = Float[Tensor, "*#batch n 2"]

PARALLEL = 1e-5
"""Mean squared sine between axes and their mean direction, below which they count as parallel (0.2 degrees)."""


@dataclass(frozen=True)
class Cameras(TensorDataclass):
    """Pinhole cameras that share one image size (height, width), in pixels."""

    world_to_camera: Float[Tensor, "*batch 4 4"]
    intrinsics: Float[Tensor, "*batch 3 3"]
    image_size: tuple[int, int]

    @property
    def camera_to_world(self) -> Float[Tensor, "*batch 4 4"]:
        """Return the rigid inverse of `world_to_camera`."""
        return invert_rigid(self.world_to_camera)

    @property
    def centers(self) -> Float[Tensor, "*batch 3"]:
        """Return the optical centres in world coordinates."""
        return self.camera_to_world[..., :3, 3]

    def relative_to(self, reference: "Cameras") -> "Cameras":
        """Return the cameras in a world whose frame is the reference camera's frame."""
        return replace(self, world_to_camera=self.world_to_camera @ reference.camera_to_world)

    def scale_world(self, factor: Float[Tensor, "*#batch"]) -> "Cameras":
        """Return the cameras after all world coordinates are multiplied by `factor`."""
        matrix = self.world_to_camera.clone()
        matrix[..., :3, 3] = matrix[..., :3, 3] * factor[..., None]
        return replace(self, world_to_camera=matrix)


def invert_rigid(matrix: Float[Tensor, "*batch 4 4"]) -> Float[Tensor, "*batch 4 4"]:
    """Invert a rotation and translation: (R, t) -> (R^T, -R^T t)."""
    rotation = matrix[..., :3, :3].mT
    return _rigid(rotation, -(rotation @ matrix[..., :3, 3:]))


def _rigid(rotation: Float[Tensor, "*batch 3 3"], translation: Float[Tensor, "*batch 3 1"]) -> Tensor:
    matrix = rotation.new_zeros(*rotation.shape[:-2], 4, 4)
    matrix[..., :3, :3] = rotation
    matrix[..., :3, 3:] = translation
    matrix[..., 3, 3] = 1
    return matrix


def transform_points(matrix: Float[Tensor, "*#batch 4 4"], points: Points) -> Float[Tensor, "*batch n 3"]:
    """Apply an affine 4 x 4 matrix to points."""
    return points @ matrix[..., :3, :3].mT + matrix[..., None, :3, 3]


def project(cameras: Cameras, points: Points) -> tuple[Float[Tensor, "*batch n 2"], Float[Tensor, "*batch n"]]:
    """Project world points to pixel coordinates (u, v) and depth along the optical axis."""
    camera_points = transform_points(cameras.world_to_camera, points)
    homogeneous = camera_points @ cameras.intrinsics.mT
    return homogeneous[..., :2] / homogeneous[..., 2:], camera_points[..., 2]


def unproject(cameras: Cameras, pixels: Pixels, depth: Float[Tensor, "*#batch n"]) -> Float[Tensor, "*batch n 3"]:
    """Convert pixel coordinates with depth along the optical axis to world points (the inverse of `project`)."""
    camera_points = rays_through(cameras.intrinsics, pixels) * depth[..., None]
    return transform_points(cameras.camera_to_world, camera_points)


def rays_through(intrinsics: Float[Tensor, "*#batch 3 3"], pixels: Pixels) -> Float[Tensor, "*batch n 3"]:
    """Return camera-frame rays ((u - cx) / fx, (v - cy) / fy, 1), not normalised, so that ray * depth is a point."""
    focal = torch.diagonal(intrinsics, dim1=-2, dim2=-1)[..., None, :2]
    xy = (pixels - intrinsics[..., None, :2, 2]) / focal
    return torch.cat([xy, torch.ones_like(xy[..., :1])], dim=-1)


def pixel_centers(
    height: int, width: int, device: torch.device | None = None, dtype: torch.dtype = torch.float32
) -> Float[Tensor, "height width 2"]:
    """Return the coordinates (u, v) of all pixel centres."""
    v = torch.arange(height, device=device, dtype=dtype) + 0.5
    u = torch.arange(width, device=device, dtype=dtype) + 0.5
    return torch.stack(torch.meshgrid(u, v, indexing="xy"), dim=-1)


def pixel_rays(cameras: Cameras) -> Float[Tensor, "*batch height width 3"]:
    """Return camera-frame rays through all pixel centres, scaled so that z = 1."""
    k = cameras.intrinsics
    pixels = pixel_centers(*cameras.image_size, k.device, k.dtype).flatten(0, 1)
    return rays_through(k, pixels).reshape(*k.shape[:-2], *cameras.image_size, 3)


def pinhole(fov_degrees: float, size: int) -> Float[Tensor, "3 3"]:
    """Return the intrinsics of a square image with the given horizontal field of view and a central principal point."""
    focal = 0.5 * size / torch.tensor(fov_degrees).deg2rad().div(2).tan().item()
    return torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])


def nearest_to_axes(cameras: Cameras, least_spread: float = PARALLEL) -> Float[Tensor, "3"] | None:
    """Return the point (float64) nearest to all optical axes (least squares), or None if they are too parallel."""
    axes = cameras.camera_to_world[:, :3, 2].double()
    centers = cameras.centers.double()
    across = torch.eye(3, dtype=axes.dtype, device=axes.device) - axes[:, :, None] * axes[:, None]
    mean = across.mean(0)
    if torch.linalg.eigvalsh(mean)[0] < least_spread:
        return None
    return torch.linalg.solve(mean, (across @ centers[..., None]).mean(0))[:, 0]


def crop_resize(cameras: Cameras, left: float, top: float, side: float, size: int) -> Cameras:
    """Return the cameras of images cut to a square (in pixels, fractions allowed) and resized to `size`."""
    intrinsics = cameras.intrinsics.clone()
    intrinsics[..., 0, 2] -= left
    intrinsics[..., 1, 2] -= top
    intrinsics[..., :2, :] *= size / side
    return Cameras(cameras.world_to_camera, intrinsics, (size, size))


def mirror(cameras: Cameras) -> Cameras:
    """Return the cameras of horizontally mirrored images, in the world mirrored at its plane x = 0.

    With M = diag(-1, 1, 1, 1), `world_to_camera` becomes M W M, a rotation and translation again. A point at (u, v)
    moves to (width - u, v), at the same depth.
    """
    signs = cameras.world_to_camera.new_tensor([-1, 1, 1, 1])
    intrinsics = cameras.intrinsics.clone()
    intrinsics[..., 0, 2] = cameras.image_size[1] - intrinsics[..., 0, 2]
    return Cameras(cameras.world_to_camera * signs[:, None] * signs, intrinsics, cameras.image_size)


def look_at(eye: Vectors, target: Vectors, up: Vectors) -> Float[Tensor, "*batch 4 4"]:
    """Return `world_to_camera` of a camera at `eye` with `target` in the image's centre and `up` pointing up."""
    eye, target, up = torch.broadcast_tensors(eye, target, up)  # type: ignore[no-untyped-call]
    forward = torch.nn.functional.normalize(target - eye, dim=-1)
    aside = torch.linalg.cross(forward, up)
    other = torch.linalg.cross(forward, up.roll(1, -1))
    straight = aside.norm(dim=-1, keepdim=True) < 1e-6 * up.norm(dim=-1, keepdim=True)  # along `up`
    right = torch.nn.functional.normalize(torch.where(straight, other, aside), dim=-1)
    down = torch.linalg.cross(forward, right)
    rotation = torch.stack([right, down, forward], dim=-2)
    return _rigid(rotation, -(rotation @ eye[..., None]))
