"""Feature encoders F_feat of the reference image: phi_ref = F_feat(I_ref) (paper, Section 3.3)."""

from collections.abc import Sequence

from diffusers.models.autoencoders import vae
from jaxtyping import Float
from torch import Tensor, nn


class LearnedConditioning(nn.Module):
    """A small convolutional encoder, trained together with the denoiser.

    For setups without Stable Diffusion's weights; the paper uses the frozen encoder of Stable Diffusion's VAE.

    Args:
        out_channels: channels of phi_ref.
        channels: width of each level; the resolution halves between levels, down to the latent's.
        layers_per_block: residual blocks per level.
        norm_groups: groups of the group normalisation.
    """

    def __init__(
        self,
        out_channels: int = 16,
        channels: Sequence[int] = (8, 16, 32, 64),
        layers_per_block: int = 1,
        norm_groups: int = 8,
    ) -> None:
        super().__init__()
        self.out_channels = out_channels
        self.network = vae.Encoder(
            in_channels=3,
            out_channels=out_channels,
            down_block_types=("DownEncoderBlock2D",) * len(channels),
            block_out_channels=tuple(channels),
            layers_per_block=layers_per_block,
            norm_num_groups=norm_groups,
            double_z=False,
        )

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch channel _ _"]:
        """Features of sRGB images in [0, 1], at the latent's resolution."""
        return self.network(images * 2 - 1)
