"""What the other views of a scene add to the posterior of its reference picture: q(h | reference, other views).

The paper's posterior sees the reference picture alone, so that a latent cannot say what the picture hides. An encoder
of views moves its moments by what the other views show; its last layer starts at zero, so that training starts from the
paper's posterior. Skips always come from the reference picture. Other works that encode more than what they generate
from: LN3Diff and GaussianAnything (6 and 8 views with Pluecker rays), TRELLIS (features of many renders).
"""

from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.encoder import vae_encoder
from completesplat.geometry.cameras import pixel_centers, project, rays_through
from completesplat.scene import Views
from completesplat.schema import Few, Range, Width, Widths


class PlaneSweep(nn.Module):
    """Colours that the other views show along each of the reference's rays, at depths even in disparity.

    At each depth there are two: of views that look along the ray, as the reference does, and of views that look against
    it, which see the backs of things. Both are means over the views, weighted by how much they do so: the views' order
    and number do not matter. With the reference's own colours they go through Stable Diffusion's encoder. All this
    starts at its second level, at half the picture's resolution, which the latent's is not above.

    Args:
        planes: depths along each ray, from near to far.
        channels, layers_per_block, latent_channels, norm_groups: of the encoder; levels as the autoreconstructor's.
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
        _zero(self.network.conv_out)

    def forward(
        self, views: Views, depth_range: Float[Tensor, "batch 2"]
    ) -> Float[Tensor, "batch moment latent_height latent_width"]:
        """Views, the reference first and its frame as the world -> what to add to the moments."""
        with torch.autocast(views.images.device.type, enabled=False):
            found = sweep(views, depth_range, self.planes)
        own = nn.functional.avg_pool2d(views.images[:, 0], 2)
        moments: Tensor = self.network(torch.cat([own * 2 - 1, found.flatten(1, 3)], 1))
        return moments.float()


SHARPNESS = 4.0
"""Of the weights: a view at a right angle to the ray counts exp(-4) of one along it."""


def sweep(
    views: Views, depth_range: Float[Tensor, "batch 2"], planes: int
) -> Float[Tensor, "batch plane side value height width"]:
    """What the other views show at points along the rays between each four pixels of the reference.

    Returns:
        Of views that look along the ray and of those that look against it: colour (-1 to 1; 0 where no view sees the
        point), and the mean cosine between its ray and theirs.
    """
    reference, others = views[:, 0], views[:, 1:]
    near, far = depth_range[:, :1], depth_range[:, 1:]
    share = torch.linspace(0, 1, planes, device=near.device)
    depth = 1 / (1 / near + share * (1 / far - 1 / near))
    batch, count, _, height, width = others.images.shape
    corners = pixel_centers(height // 2, width // 2, near.device).flatten(0, 1) * 2
    rays = rays_through(reference.cameras.intrinsics, corners)
    flat = (depth[:, :, None, None] * rays[:, None]).flatten(1, 2)[:, None]
    pixels, ahead = project(others.cameras, flat)
    grid = (pixels / pixels.new_tensor([width, height]) * 2 - 1).clamp(-2, 2).nan_to_num(2)
    sampled = nn.functional.grid_sample(others.images.flatten(0, 1), grid.flatten(0, 1)[:, None], align_corners=False)
    colors = sampled.view(batch, count, 3, -1).mT * 2 - 1
    toward = nn.functional.normalize(flat - others.cameras.centers[:, :, None], dim=-1)
    cosine = (nn.functional.normalize(flat, dim=-1) * toward).sum(-1, keepdim=True)
    seen = ((grid.abs() <= 1).all(-1) & (ahead > 0.01 * near[:, :, None]))[..., None]
    hidden = torch.finfo(torch.float32).min * (~seen).float()
    values = torch.cat([colors, cosine], -1)
    sides = [(values * (sign * SHARPNESS * cosine + hidden).softmax(1)).sum(1) for sign in (1, -1)]
    found = torch.stack(sides, -2) * seen.any(1)[..., None]
    return found.view(batch, planes, height // 2, width // 2, 2, 4).permute(0, 1, 4, 5, 2, 3)


@torch.no_grad()
def _zero(layer: nn.Module) -> None:
    for parameter in layer.parameters():
        parameter.zero_()
