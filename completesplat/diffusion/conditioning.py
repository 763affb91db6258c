"""Feature encoders F_feat of the reference image: phi_ref = F_feat(I_ref) (paper, Section 3.3).

`frozen` says whether an encoder is constant in training, so that its features can be computed once and stored.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.encoder import Encoder, vae_encoder
from completesplat.autoreconstructor.pretrained import load_pretrained
from completesplat.quantities import Few, Width, Widths

STABLE_DIFFUSION_SCALE = 0.18215
"""Scale of Stable Diffusion's latents (CompVis `configs/stable-diffusion/v1-inference.yaml`, scale_factor)."""


class LearnedConditioning(nn.Module):
    """Small convolutional encoder that is trained together with the denoiser.

    It is for setups without Stable Diffusion's weights. The paper uses the frozen encoder of Stable Diffusion's VAE.

    Args:
        out_channels: channels of phi_ref.
        channels, layers_per_block, norm_groups: see `Encoder`; with as many levels as the latent's encoder.
    """

    frozen = False

    def __init__(
        self,
        out_channels: Width = 16,
        channels: Widths = (8, 16, 32, 64),
        layers_per_block: Few = 1,
        norm_groups: Width = 8,
    ) -> None:
        super().__init__()
        self.out_channels = out_channels
        self.network = vae_encoder(3, out_channels, channels, layers_per_block, norm_groups)

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch channel _ _"]:
        """Return features of sRGB images in [0, 1], at the latent's resolution."""
        return self.network(images * 2 - 1)


class StableDiffusionConditioning(nn.Module):
    """Frozen encoder of Stable Diffusion's original VAE: the posterior's mean times 0.18215, as in Marigold.

    This is not the autoreconstructor's encoder, whose weights training has changed.

    Args:
        pretrained: folder or hub id of the VAE in diffusers' layout; None if a checkpoint supplies the weights.
        out_channels: channels of phi_ref, which are the VAE's latent channels.
        channels, layers_per_block, norm_groups: the VAE's sizes, see `Encoder`.

    Raises:
        WeightsError: the pretrained weights are missing, damaged or of another size.
    """

    frozen = True

    def __init__(
        self,
        pretrained: str | None = None,
        out_channels: Width = 4,
        channels: Widths = (128, 256, 512, 512),
        layers_per_block: Few = 2,
        norm_groups: Width = 32,
    ) -> None:
        super().__init__()
        self.pretrained = pretrained
        self.out_channels = out_channels
        self.encoder = Encoder(channels, layers_per_block, out_channels, norm_groups)
        if pretrained is not None:
            load_pretrained(pretrained, self.encoder)
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> "StableDiffusionConditioning":
        return super().train(False)

    @torch.no_grad()
    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Float[Tensor, "batch channel _ _"]:
        """Return features of sRGB images in [0, 1], at an eighth of their resolution."""
        return self.encoder(images)[0].mean * STABLE_DIFFUSION_SCALE
