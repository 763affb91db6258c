"""Regression baseline "Splatter Image (full images)": one pass of a U-Net, without sampling and latent."""

from typing import Any

from diffusers import UNet2DModel
from jaxtyping import Float
from torch import Tensor

from completesplat.autoreconstructor.encoder import recompute
from completesplat.autoreconstructor.model import Reconstruction, ReconstructionModel
from completesplat.quantities import Few, Levels, Share, Width, Widths
from completesplat.splatter_image import Parameterization, from_channels, initialize_head


class SplatterImageUNet(ReconstructionModel):
    """U-Net from an image to a Splatter Image, after Szymanowicz et al., "Splatter Image" (CVPR 2024).

    Upstream's network is EDM's SongUNet without noise level (`scene/gaussian_predictor.py`); defaults are its sizes.
    This network is built of similar blocks from diffusers, which resample within residual blocks, attend with one head,
    and normalise in 32 groups. Differences from upstream:

    - The blocks need a time embedding. They get the one of a constant timestep 0, which is a learned bias.
    - Residual sums are not scaled by sqrt(1/2), and weights start from PyTorch's default initialisation.
    - Resampling blocks have no 1x1 convolution in their shortcut.
    - On the way up, attention follows every block of a level instead of only the last one.
    - The last 3x3 convolution is the head. Upstream has a 1x1 convolution after it.

    Args:
        channels: width of each level, from full resolution down. The image's sides are multiples of 2^(levels - 1).
        attention_levels: levels with self-attention (upstream: at 16 pixels, level 3 of images of 128).
        layers_per_block: residual blocks per level on the way down (the way up has one more).
        dropout: dropout probability before the second convolution of each residual block.
        gradient_checkpointing: recompute the residual blocks' activations in the backward pass.
    """

    def __init__(
        self,
        parameterization: Parameterization,
        channels: Widths = (128, 256, 256, 256),
        attention_levels: Levels = (3,),
        layers_per_block: Few = 4,
        dropout: Share = 0.1,
        norm_groups: Width = 32,
        gradient_checkpointing: bool = False,
    ) -> None:
        super().__init__()
        self.parameterization = parameterization
        attends = [level in attention_levels for level in range(len(channels))]
        network: Any = UNet2DModel(  # type: ignore[no-untyped-call]
            in_channels=3,
            out_channels=parameterization.channels,
            block_out_channels=tuple(channels),
            down_block_types=tuple("AttnDownBlock2D" if a else "ResnetDownsampleBlock2D" for a in attends),
            up_block_types=tuple("AttnUpBlock2D" if a else "ResnetUpsampleBlock2D" for a in reversed(attends)),
            downsample_type="resnet",
            upsample_type="resnet",
            layers_per_block=layers_per_block,
            dropout=dropout,
            attention_head_dim=None,
            norm_num_groups=norm_groups,
            norm_eps=1e-6,
        )
        initialize_head(network.conv_out, parameterization)
        if gradient_checkpointing:
            network.enable_gradient_checkpointing(recompute)
        self.network = network

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Reconstruction:
        """Reconstruct from sRGB images in [0, 1], without a posterior."""
        output = self.network(images * 2 - 1, timestep=0).sample
        return Reconstruction(from_channels(output.float(), self.parameterization), posterior=None)
