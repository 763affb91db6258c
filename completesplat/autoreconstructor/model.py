"""The Variational AutoReconstructor as one module."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.posterior import Posterior, from_moments
from completesplat.autoreconstructor.pretrained import load_pretrained
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.scene import Views
from completesplat.schema import Share
from completesplat.splatter_image import Parameterization, SplatterImage
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
        view_encoder: (views, depth range) -> what other views of the scene add to the posterior's moments
            (`view_encoders`); None: the paper's posterior, of the picture alone.

    Raises:
        WeightsError: the pretrained weights are missing, damaged or of another size.
    """

    def __init__(
        self,
        encoder: Encoder,
        reconstructor: Reconstructor,
        skip_dropout: Share = 0.5,
        variational: bool = True,
        pretrained: str | None = None,
        gradient_checkpointing: bool = False,
        view_encoder: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.encoder = encoder
        self.reconstructor = reconstructor
        self.skip_dropout = skip_dropout
        self.view_encoder = view_encoder
        self.variational = variational
        encoder.gradient_checkpointing = reconstructor.gradient_checkpointing = gradient_checkpointing
        if pretrained is not None:
            load_pretrained(encoder, reconstructor, pretrained)

    @property
    def sees_views(self) -> bool:
        """Whether the posterior takes in other views than the reference."""
        return self.view_encoder is not None

    @property
    def parameterization(self) -> Parameterization:
        """How the raw values of its Splatter Images are read."""
        return self.reconstructor.parameterization

    def posterior(
        self,
        images: Float[Tensor, "batch 3 height width"],
        views: Views | None = None,
        depth_range: Float[Tensor, "batch 2"] | None = None,
    ) -> tuple[Posterior, list[Float[Tensor, "batch _ _ _"]]]:
        """The posterior of latents, and the reference's features for the skips.

        Args:
            images: the reference pictures, sRGB in [0, 1].
            views: all views that the posterior may see, the reference first and its frame as the world; without others
                than the reference, and without an encoder of views, it is the paper's.
        """
        own, features = self.encoder(images)
        if self.view_encoder is None or views is None or views.images.shape[1] < 2:
            return own, features
        assert depth_range is not None
        mean, log_variance = self.view_encoder(views, depth_range).chunk(2, 1)
        return from_moments(torch.cat([own.mean + mean, own.log_variance + log_variance], 1)), features

    def forward(
        self,
        images: Float[Tensor, "batch 3 height width"],
        views: Views | None = None,
        depth_range: Float[Tensor, "batch 2"] | None = None,
    ) -> Reconstruction:
        """Reconstruct from sRGB images in [0, 1]; in training also from `views` (see `posterior`)."""
        posterior, features = self.posterior(images, views, depth_range)
        if not self.training:
            return Reconstruction(self.reconstructor(posterior.mode(), features), posterior)
        kept = (torch.rand(len(images), device=images.device) >= self.skip_dropout).float()
        latent = posterior.sample() if self.variational else posterior.mode()
        return Reconstruction(self.reconstructor(latent, features, kept), posterior)
