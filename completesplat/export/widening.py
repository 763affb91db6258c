"""Gaussians for viewers that draw them larger than training did."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, transform_points
from completesplat.rasterizers.protocol import RenderingConstants


def widened(gaussians: Gaussians, reference: Cameras, blur: float = RenderingConstants().blur) -> Gaussians:
    """Gaussians that hold the rasterizer's blur, as it is in the reference view.

    A rasterizer adds `blur` px^2 to each projected covariance. Training counts on it at its own picture size, and
    makes Gaussians far smaller than a pixel; in a larger picture they would be dots with gaps between them. A Gaussian
    at depth z gets `blur * (z / focal length)^2` added to its covariance in all directions, which leaves its axes.

    Args:
        gaussians: [gaussian], in the world of the camera.
        reference: the photograph's camera, unbatched, at the size that the model was trained at.
    """
    variance = blur * (_depth(gaussians, reference) / reference.intrinsics[0, 0]).square()
    return replace(gaussians, scales=(gaussians.scales.square() + variance[:, None]).sqrt())


def _depth(gaussians: Gaussians, camera: Cameras) -> Float[Tensor, " gaussian"]:
    return torch.as_tensor(transform_points(camera.world_to_camera, gaussians.means)[:, 2])
