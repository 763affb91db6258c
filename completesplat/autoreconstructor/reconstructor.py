"""Stable Diffusion's VAE decoder with a Splatter Image head and weighted skips from the encoder."""

from collections.abc import Sequence

import torch
from diffusers.models.autoencoders import vae
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.encoder import recompute
from completesplat.errors import CompleteSplatError
from completesplat.quantities import Few, Levels, Width, Widths
from completesplat.splatter_image import Parameterization, SplatterImage, from_channels, initialize_head, zeroed


class Reconstructor(nn.Module):
    """Decoder from a latent to a Splatter Image, whose channels (M * 15 in the paper) its last convolution has.

    A skip passes the encoder's features of one level, before its downsampling, through a zero-initialised 1x1
    convolution and adds them to the input of the up block of the same resolution. The paper does not state the merge
    operator. Zero initialisation leaves pretrained weights intact at step 0.

    Args:
        parameterization: layers and activations of the Splatter Image.
        channels: width of each level, from full resolution down; equal to the encoder's.
        layers_per_block: residual blocks per level of the encoder (the decoder has one more, as in Stable Diffusion).
        latent_channels: channels of the latent.
        norm_groups: groups of the group normalisation.
        skip_levels: encoder levels with a skip. The paper's model has level 0; its ablations none, or 0 and 1.

    Attributes:
        gradient_checkpointing: see `recompute`.

    Raises:
        CompleteSplatError: a level of `skip_levels` does not exist.
    """

    def __init__(
        self,
        parameterization: Parameterization,
        channels: Widths = (128, 256, 512, 512),
        layers_per_block: Few = 2,
        latent_channels: Width = 4,
        norm_groups: Width = 32,
        skip_levels: Levels = (0,),
    ) -> None:
        super().__init__()
        if max(skip_levels, default=0) >= len(channels):
            raise CompleteSplatError(f"skip_levels={list(skip_levels)}: there are levels 0 to {len(channels) - 1}")
        self.parameterization = parameterization
        self.post_quant_conv = nn.Conv2d(latent_channels, latent_channels, 1)
        self.network = vae.Decoder(
            in_channels=latent_channels,
            out_channels=parameterization.channels,
            up_block_types=("UpDecoderBlock2D",) * len(channels),
            block_out_channels=tuple(channels),
            layers_per_block=layers_per_block,
            norm_num_groups=norm_groups,
        )
        initialize_head(self.network.conv_out, parameterization)
        # The input of the up block at level l's resolution has the channels of the next coarser level.
        inputs = {level: channels[min(level + 1, len(channels) - 1)] for level in skip_levels}
        convolutions = {str(level): zeroed(nn.Conv2d(channels[level], inputs[level], 1)) for level in skip_levels}
        self.skips = nn.ModuleDict(convolutions)
        self.gradient_checkpointing = False

    @property
    def feature_levels(self) -> int:
        """Return the number of encoder levels, counted from the first, that the skips need."""
        return max((int(level) + 1 for level in self.skips), default=0)

    def forward(
        self,
        latent: Float[Tensor, "batch channel latent_height latent_width"],
        features: Sequence[Float[Tensor, "batch _ _ _"]],
        skip_weight: Float[Tensor, " batch"] | float = 1.0,
    ) -> SplatterImage:
        """Reconstruct, with the encoder's features weighted by `skip_weight` in [0, 1] (one weight, or one per sample).

        Args:
            features: features of at least `feature_levels` levels. If empty, there are no skips, as with a weight of 0.
        """
        network = self.network
        run = recompute if self.gradient_checkpointing else nn.Module.__call__
        weight = torch.as_tensor(skip_weight, dtype=latent.dtype, device=latent.device).view(-1, 1, 1, 1)
        hidden = run(network.mid_block, network.conv_in(self.post_quant_conv(latent)))
        for level, block in zip(reversed(range(len(network.up_blocks))), network.up_blocks, strict=True):
            if str(level) in self.skips and features:
                hidden = hidden + weight * self.skips[str(level)](features[level])
            hidden = run(block, hidden)
        output = network.conv_out(network.conv_act(network.conv_norm_out(hidden)))
        return from_channels(output.float(), self.parameterization)
