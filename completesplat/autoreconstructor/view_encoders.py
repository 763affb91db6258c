"""Encoders of a scene's other views, which extend the posterior of its reference image to q(h | reference, views).

The paper's posterior sees the reference image alone, so a latent cannot encode what that image hides. A view encoder
adds to the posterior's moments what the other views show. Its last layer starts at zero, so training starts from the
paper's posterior. Skips always come from the reference image. Related work that encodes more than it generates from:
LN3Diff and GaussianAnything (6 and 8 views with Pluecker rays), TRELLIS (features of many renders).
"""

from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.encoder import vae_encoder
from completesplat.autoreconstructor.model import DepthRange
from completesplat.geometry.cameras import pixel_centers, project, rays_through
from completesplat.quantities import Few, Range, Width, Widths
from completesplat.scene import Views
from completesplat.splatter_image import zeroed


class PlaneSweep(nn.Module):
    """Plane-sweep encoder of the colours that other views see along the reference's rays.

    Depths are evenly spaced in disparity. Each depth has two colours: one of views that look along the ray, as the
    reference does, and one of views that look against it and see the backs of objects. Both are means over all views,
    weighted by direction, so the order and number of views do not matter. These colours and the reference's go through
    Stable Diffusion's encoder, from its second level on: at half the image's resolution, which suffices for the latent.

    Args:
        planes: depths along each ray, from near to far.
        channels, layers_per_block, latent_channels, norm_groups: see `Encoder`; as many levels as it has.
    """

    def __init__(
        self,
        planes: Annotated[int, Range(1, 256)] = 12,
        channels: Widths = (128, 256, 512, 512),
        layers_per_block: Few = 2,
        latent_channels: Width = 4,
        norm_groups: Width = 32,
    ) -> None:
        super().__init__()
        self.planes = planes
        inputs = 3 + planes * 2 * 4
        self.network = vae_encoder(inputs, 2 * latent_channels, channels[1:], layers_per_block, norm_groups)
        zeroed(self.network.conv_out)

    def forward(self, views: Views, depth_range: DepthRange) -> Float[Tensor, "batch moment _ _"]:
        """Return what to add to the moments.

        The reference is the first view, and its frame is the world.
        """
        with torch.autocast(views.images.device.type, enabled=False):
            swept = sweep(views, depth_range, self.planes)
        reference = nn.functional.avg_pool2d(views.images[:, 0], 2)
        return self.network(torch.cat([reference * 2 - 1, swept.flatten(1, 3)], 1)).float()


SHARPNESS = 4.0
"""Sharpness of the weights: a view at a right angle to the ray has exp(-4) of the weight of one along it."""


def sweep(views: Views, depth_range: DepthRange, planes: int) -> Float[Tensor, "batch plane side value height width"]:
    """Sample the other views along the rays through the centres of 2 x 2 blocks of the reference's pixels.

    Returns:
        For views that look along the ray, and for views that look against it: the mean colour (-1 to 1; 0 where no view
        sees the point), and the mean cosine between the reference's ray and theirs.
    """
    reference = views[:, 0]
    others = views[:, 1:]
    near = depth_range[:, :1]
    far = depth_range[:, 1:]
    share = torch.linspace(0, 1, planes, device=near.device)
    depth = 1 / (1 / near + share * (1 / far - 1 / near))
    batch, count, _, height, width = others.images.shape
    corners = pixel_centers(height // 2, width // 2, near.device).flatten(0, 1) * 2
    rays = rays_through(reference.cameras.intrinsics, corners)
    flat = (depth[:, :, None, None] * rays[:, None]).flatten(1, 2)[:, None]
    pixels, ahead = project(others.cameras, flat)
    size = torch.tensor([width, height]).to(pixels, non_blocking=True)
    grid = (pixels / size * 2 - 1).clamp(-2, 2).nan_to_num(2)
    sampled = nn.functional.grid_sample(others.images.flatten(0, 1), grid.flatten(0, 1)[:, None], align_corners=False)
    colors = sampled.view(batch, count, 3, -1).mT * 2 - 1
    toward = nn.functional.normalize(flat - others.cameras.centers[:, :, None], dim=-1)
    cosine = (nn.functional.normalize(flat, dim=-1) * toward).sum(-1, keepdim=True)
    seen = ((grid.abs() <= 1).all(-1) & (ahead > 0.01 * near[:, :, None]))[..., None]
    hidden = torch.finfo(torch.float32).min * (~seen).float()
    values = torch.cat([colors, cosine], -1)
    sides = [(values * (sign * SHARPNESS * cosine + hidden).softmax(1)).sum(1) for sign in (1, -1)]
    features = torch.stack(sides, -2) * seen.any(1)[..., None]
    return features.view(batch, planes, height // 2, width // 2, 2, 4).permute(0, 1, 4, 5, 2, 3)
