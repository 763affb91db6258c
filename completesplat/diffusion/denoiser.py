"""The denoiser eps_theta(h_t, phi_ref, t): Stable Diffusion's UNet on [conditioning, noisy latent]."""

from collections.abc import Sequence
from typing import Any

import torch
from diffusers import UNet2DModel
from jaxtyping import Float, Int
from torch import Tensor, nn


class Denoiser(nn.Module):
    """UNet built from Stable Diffusion's blocks, without text: its attention is self-attention only.

    The paper follows Stable Diffusion's denoiser, trained from scratch, and does not say what takes the place of the
    text; blocks without cross-attention are the plain reading. The conditioning is concatenated before the noisy
    latent, as in Marigold.

    Args:
        latent_channels: channels of the latent.
        conditioning_channels: channels of phi_ref.
        channels: width of each level (Stable Diffusion: 320, 640, 1280, 1280).
        attention_levels: levels with self-attention (Stable Diffusion: 0, 1, 2).
        layers_per_block: residual blocks per level.
        head_channels: channels of one attention head.
        norm_groups: groups of the group normalisation.
    """

    def __init__(
        self,
        latent_channels: int = 4,
        conditioning_channels: int = 4,
        channels: Sequence[int] = (320, 640, 1280, 1280),
        attention_levels: Sequence[int] = (0, 1, 2),
        layers_per_block: int = 2,
        head_channels: int = 40,
        norm_groups: int = 32,
    ) -> None:
        super().__init__()
        self.latent_channels = latent_channels
        down = ["AttnDownBlock2D" if level in attention_levels else "DownBlock2D" for level in range(len(channels))]
        self.network = UNet2DModel(
            in_channels=conditioning_channels + latent_channels,
            out_channels=latent_channels,
            block_out_channels=tuple(channels),
            down_block_types=tuple(down),
            up_block_types=tuple(name.replace("Down", "Up") for name in reversed(down)),
            layers_per_block=layers_per_block,
            attention_head_dim=head_channels,
            norm_num_groups=norm_groups,
        )

    def forward(
        self,
        noisy_latent: Float[Tensor, "batch channel height width"],
        timestep: Int[Tensor, " batch"],
        conditioning: Float[Tensor, "batch features height width"],
    ) -> Float[Tensor, "batch channel height width"]:
        """Predict the noise in h_t (paper, Eq. 3)."""
        network: Any = self.network
        return network(torch.cat([conditioning, noisy_latent], dim=1), timestep).sample.float()
