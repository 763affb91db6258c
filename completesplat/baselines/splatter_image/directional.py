"""Gaussians whose colours change with the viewing direction, and a wrapper by which any rasterizer draws them."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer, Rendering


@dataclass(frozen=True)
class DirectionalGaussians(Gaussians):
    """Gaussians with spherical harmonics of degree 1, for models by others; this package's have one colour.

    Seen along a unit vector d in the Gaussians' frame, their colour is max(0, mean_colors + d @ slopes).
    Files and viewers, which hold one colour only, use `colors`.
    """

    mean_colors: Float[Tensor, "*batch gaussian 3"]
    slopes: Float[Tensor, "*batch gaussian 3 3"]

    def seen_from(self, centers: Float[Tensor, "*batch 3"]) -> Gaussians:
        """Return the Gaussians with the colours that these points see."""
        directions = torch.nn.functional.normalize(self.means - centers[..., None, :], dim=-1)
        colors = self.mean_colors + (directions[..., None, :] @ self.slopes).squeeze(-2)
        return Gaussians(self.means, self.quaternions, self.scales, self.opacities, colors.clamp(min=0))

    def transform(self, matrix: Float[Tensor, "*#batch 4 4"]) -> "DirectionalGaussians":
        """Move the Gaussians as `Gaussians.transform` does, and rotate the slopes of their colours."""
        moved = super().transform(matrix)
        slopes = matrix[..., None, :3, :3] @ self.slopes
        return DirectionalGaussians(**{**vars(moved), "slopes": slopes})


class DirectionalRasterizer:
    """Wrapper that gives another rasterizer `DirectionalGaussians` in the colours that each camera sees."""

    def __init__(self, rasterizer: Rasterizer) -> None:
        self.rasterizer = rasterizer

    def __call__(self, gaussians: Gaussians, cameras: Cameras) -> Rendering:
        """Render scenes [batch] from cameras [batch view]: each view becomes a scene with one camera."""
        if not isinstance(gaussians, DirectionalGaussians):
            return self.rasterizer(gaussians, cameras)
        shape = cameras.world_to_camera.shape[:2]
        for_each_view = gaussians.map(lambda values: values.repeat_interleave(shape[1], dim=0))
        seen = for_each_view.seen_from(cameras.centers.flatten(0, 1))
        single = cameras.map(lambda values: values.flatten(0, 1)[:, None])
        return self.rasterizer(seen, single).map(lambda values: values.view(*shape, *values.shape[2:]))
