"""The Variational AutoReconstructor as one module."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.posterior import Posterior
from completesplat.autoreconstructor.pretrained import load_pretrained
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.splatter_image import SplatterImage
from completesplat.tensors import TensorDataclass


@dataclass(frozen=True)
class Reconstruction(TensorDataclass):
    """What a reconstruction model predicts from one image; regression baselines have no posterior."""

    splatter_image: SplatterImage
    posterior: Posterior | None


class VariationalAutoReconstructor(nn.Module):
    """Encoder and reconstructor (paper, Section 3.2 and Figure 3).

    In training a latent is drawn from the posterior, and the skip features of a sample are zeroed, all of them at
    once, with probability `skip_dropout` (supplement, "Skip connection"; the probability is not stated in the
    paper). In evaluation the posterior's mode is used, with full skips.

    Args:
        variational: draw latents in training; False uses the posterior's mode there too (ablation "no variational
            sampling", which also drops the KL from the loss).
        gradient_checkpointing: in training, recompute the blocks' activations in the backward pass: less memory for one
            more forward pass.
        pretrained: folder or hub id of a VAE in diffusers' layout to start from (`load_pretrained`); random if None.

    Raises:
        WeightsError: the pretrained weights are missing, damaged or of another size.
    """

    def __init__(
        self,
        encoder: Encoder,
        reconstructor: Reconstructor,
        skip_dropout: float = 0.5,
        variational: bool = True,
        pretrained: str | None = None,
        gradient_checkpointing: bool = False,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.reconstructor = reconstructor
        self.skip_dropout = skip_dropout
        self.variational = variational
        encoder.gradient_checkpointing = reconstructor.gradient_checkpointing = gradient_checkpointing
        if pretrained is not None:
            load_pretrained(encoder, reconstructor, pretrained)

    def forward(self, images: Float[Tensor, "batch 3 height width"]) -> Reconstruction:
        """Reconstruct from sRGB images in [0, 1]."""
        posterior, features = self.encoder(images)
        if not self.training:
            return Reconstruction(self.reconstructor(posterior.mode(), features), posterior)
        kept = (torch.rand(len(images), device=images.device) >= self.skip_dropout).float()
        latent = posterior.sample() if self.variational else posterior.mode()
        return Reconstruction(self.reconstructor(latent, features, kept), posterior)
