"""Renderings of a finished scene from a camera path, for videos and contact sheets."""

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.geometry.trajectories import orbit
from completesplat.rasterizers.protocol import Rasterizer


def orbit_views(
    rasterizer: Rasterizer,
    gaussians: Gaussians,
    reference: Cameras,
    pivot: Float[Tensor, "3"],
    frames: int,
    background: Float[Tensor, "3"] | float = 1.0,
    up: Float[Tensor, "3"] | None = None,
    chunk: int = 8,
) -> tuple[Float[Tensor, "frame 3 height width"], Float[Tensor, "frame 1 height width"]]:
    """Render one scene on a full turn about `pivot` that starts at the reference camera.

    Args:
        rasterizer: any backend.
        gaussians: the scene, unbatched.
        reference: the reference camera, unbatched.
        pivot: the point in the centre of every frame, in world coordinates.
        frames: how many views a turn has.
        background: colour behind the scene.
        up: axis of the turn, in world coordinates. A photograph does not tell where gravity points, so the default
            is the reference camera's own up direction.
        chunk: how many views are rendered at a time.

    Returns:
        Images over the background, and expected depths (0 where nothing is seen).
    """
    if up is None:
        up = -reference.world_to_camera[1, :3]
    return render_views(rasterizer, gaussians, orbit(reference, pivot, up, frames), background, chunk)


@torch.no_grad()
def render_views(
    rasterizer: Rasterizer,
    gaussians: Gaussians,
    cameras: Cameras,
    background: Float[Tensor, "3"] | float = 1.0,
    chunk: int = 8,
) -> tuple[Float[Tensor, "frame 3 height width"], Float[Tensor, "frame 1 height width"]]:
    """Render one unbatched scene from several cameras, `chunk` at a time.

    Returns:
        Images over the background, and expected depths (0 where nothing is seen).
    """
    if isinstance(background, Tensor):
        background = background[:, None, None]
    images, depths = [], []
    for start in range(0, len(cameras.world_to_camera), chunk):
        rendering = rasterizer(gaussians[None], cameras[start : start + chunk][None])
        images.append(rendering.over(background)[0])
        depths.append(rendering.expected_depth()[0])
    return torch.cat(images), torch.cat(depths)
