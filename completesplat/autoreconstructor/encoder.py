"""Stable Diffusion's VAE encoder, unchanged except that it also returns the features before each downsampling."""

from collections.abc import Sequence
from typing import Annotated, Any

import torch
from diffusers.models.autoencoders import vae
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from completesplat.autoreconstructor.posterior import LOG_VARIANCE_RANGE, Posterior, from_moments
from completesplat.quantities import Few, Range, Width, Widths

Images = Float[Tensor, "batch 3 height width"]
Features = list[Float[Tensor, "batch _ _ _"]]


def recompute(block: nn.Module, *inputs: Tensor | None) -> Tensor:
    """Apply a block. In training its activations are not stored, but recomputed in the backward pass."""
    recomputed = block.training and torch.is_grad_enabled()
    return checkpoint(block, *inputs, use_reentrant=False) if recomputed else block(*inputs)


def vae_encoder(inputs: int, outputs: int, channels: Sequence[int], layers_per_block: int, groups: int) -> vae.Encoder:
    """Build the network of Stable Diffusion's VAE encoder, whose resolution halves between levels."""
    return vae.Encoder(
        in_channels=inputs,
        out_channels=outputs,
        down_block_types=("DownEncoderBlock2D",) * len(channels),
        block_out_channels=tuple(channels),
        layers_per_block=layers_per_block,
        norm_num_groups=groups,
        double_z=False,
    )


class Encoder(nn.Module):
    """Encoder from an image to a posterior over latents at 1 / 2^(levels - 1) of its resolution.

    It also returns one feature map per level. The defaults are Stable Diffusion's (`AutoencoderKL`, 34.2 M parameters).
    If `gradient_checkpointing` is set, `recompute` applies the blocks.

    Args:
        channels: width of each level, from full resolution down.
        layers_per_block: residual blocks per level.
        latent_channels: channels of the latent.
        norm_groups: groups of the group normalisation.
        in_channels: channels of the input; 3 for images.
        first_log_variance: approximate log-variance of the posterior at the start, without pretrained weights. At 0,
            noise of standard deviation 1 hides what the latents encode at first.
    """

    def __init__(
        self,
        channels: Widths = (128, 256, 512, 512),
        layers_per_block: Few = 2,
        latent_channels: Width = 4,
        norm_groups: Width = 32,
        in_channels: Width = 3,
        first_log_variance: Annotated[float, Range(*LOG_VARIANCE_RANGE)] = 0.0,
    ) -> None:
        super().__init__()
        self.network = vae_encoder(in_channels, 2 * latent_channels, channels, layers_per_block, norm_groups)
        self.quant_conv = nn.Conv2d(2 * latent_channels, 2 * latent_channels, 1)
        with torch.no_grad():
            self.quant_conv.bias[latent_channels:] += first_log_variance  # type: ignore[index]
        self.gradient_checkpointing = False

    def forward(self, images: Images) -> tuple[Posterior, Features]:
        """Encode sRGB images in [0, 1].

        Returns:
            The posterior, and each level's features before its downsampling (level 0 at full resolution).
        """
        return self.encode(images * 2 - 1)

    def encode(self, values: Float[Tensor, "batch channel height width"]) -> tuple[Posterior, Features]:
        """Encode values around zero without rescaling them (see `forward`)."""
        network = self.network
        run = recompute if self.gradient_checkpointing else nn.Module.__call__
        features = self.features(values, len(network.down_blocks))
        hidden = run(network.mid_block, features[-1])
        hidden = network.conv_act(network.conv_norm_out(hidden))
        return from_moments(self.quant_conv(network.conv_out(hidden))), features

    def features(self, values: Float[Tensor, "batch channel height width"], levels: int) -> Features:
        """Return the features of the first levels as `encode` does, without computing anything after them."""
        network: Any = self.network
        run = recompute if self.gradient_checkpointing else nn.Module.__call__
        features: Features = []
        hidden = network.conv_in(values)
        for level, block in enumerate(network.down_blocks[:levels]):
            for downsampler in network.down_blocks[level - 1].downsamplers if level else ():
                hidden = run(downsampler, hidden)
            for resnet in block.resnets:
                hidden = run(resnet, hidden, None)
            features.append(hidden)
        return features
