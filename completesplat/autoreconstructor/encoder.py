"""Stable Diffusion's VAE encoder, unchanged, which also hands out its features before each downsampling."""

from collections.abc import Sequence
from typing import Any

from diffusers.models.autoencoders import vae
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.posterior import Posterior, from_moments


class Encoder(nn.Module):
    """Image -> posterior over latents at 1 / 2^(levels - 1) of the resolution, and one feature map per level.

    The defaults are Stable Diffusion's (`AutoencoderKL`, 34.2 M parameters).

    Args:
        channels: width of each level, from full resolution down.
        layers_per_block: residual blocks per level.
        latent_channels: channels of the latent.
        norm_groups: groups of the group normalisation.
    """

    def __init__(
        self,
        channels: Sequence[int] = (128, 256, 512, 512),
        layers_per_block: int = 2,
        latent_channels: int = 4,
        norm_groups: int = 32,
    ) -> None:
        super().__init__()
        self.network = vae.Encoder(
            in_channels=3,
            out_channels=latent_channels,
            down_block_types=("DownEncoderBlock2D",) * len(channels),
            block_out_channels=tuple(channels),
            layers_per_block=layers_per_block,
            norm_num_groups=norm_groups,
            double_z=True,
        )
        self.quant_conv = nn.Conv2d(2 * latent_channels, 2 * latent_channels, 1)

    def forward(
        self, images: Float[Tensor, "batch 3 height width"]
    ) -> tuple[Posterior, list[Float[Tensor, "batch _ _ _"]]]:
        """Encode sRGB images in [0, 1].

        Returns:
            The posterior, and each level's features before its downsampling (level 0 at full resolution).
        """
        network: Any = self.network
        hidden = network.conv_in(images * 2 - 1)
        features = []
        for block in network.down_blocks:
            for resnet in block.resnets:
                hidden = resnet(hidden, temb=None)
            features.append(hidden)
            for downsampler in block.downsamplers or ():
                hidden = downsampler(hidden)
        hidden = network.conv_act(network.conv_norm_out(network.mid_block(hidden)))
        return from_moments(self.quant_conv(network.conv_out(hidden))), features
