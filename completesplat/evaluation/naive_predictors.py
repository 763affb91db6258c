"""Naive predictors, which see the reference image or no image. A model that does not beat them learned nothing."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from completesplat.geometry.cameras import invert_rigid, nearest_to_axes, pixel_centers, rays_through
from completesplat.scene import SceneBatch, Views

Renders = Float[Tensor, "batch view 3 height width"]


def copy_reference(scenes: SceneBatch) -> Renders:
    """Return the reference image for every view. A model that does not beat this and `repeat_image` learned nothing."""
    return scenes.reference.images[:, None].expand_as(scenes.all_views().images)


def mirror_reference(scenes: SceneBatch) -> Renders:
    """Return the reference image, flipped left to right, for every view: often the best naive guess of a back."""
    return copy_reference(scenes).flip(-1)


def repeat_image(image: Float[Tensor, "3 height width"], scenes: SceneBatch) -> Renders:
    """Return an image for every view. The training set's mean image is the best constant prediction of the MSE."""
    return image.to(scenes.reference.images).expand_as(scenes.all_views().images)


def flat_reference(scenes: SceneBatch) -> Renders:
    """Return the reference image on a plane that faces its camera at the object's distance, as each view sees it.

    The object is where the optical axes come nearest to each other, or else in the middle of the scene's depth range.
    Beyond the image, its border pixels continue.
    """
    views = scenes.all_views()
    return torch.stack([_on_plane(views[b], scenes.depth_range[b]) for b in range(len(scenes.names))])


def _on_plane(views: Views, depth_range: Float[Tensor, "2"]) -> Float[Tensor, "view 3 height width"]:
    cameras = views.cameras
    intrinsics = cameras.intrinsics
    center = nearest_to_axes(cameras)
    distance = depth_range.mean() if center is None or not center[2] > 0 else center[2].to(intrinsics)
    height, width = cameras.image_size
    pixels = pixel_centers(height, width, intrinsics.device).flatten(0, 1)
    poses = invert_rigid(cameras.world_to_camera)
    rays = rays_through(intrinsics, pixels) @ poses[:, :3, :3].mT
    origins = poses[:, None, :3, 3]
    points = origins + (distance - origins[..., 2:]) / rays[..., 2:] * rays
    seen = points @ intrinsics[0].T
    places = 2 * seen[..., :2] / seen[..., 2:] / seen.new_tensor([width, height]) - 1
    grid = places.nan_to_num().view(len(poses), height, width, 2)
    image = views.images[:1]
    others = image.expand(len(poses) - 1, -1, -1, -1)
    seen_by_others = functional.grid_sample(others, grid[1:], padding_mode="border", align_corners=False)
    return torch.cat([image, seen_by_others])
