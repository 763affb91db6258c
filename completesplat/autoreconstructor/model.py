"""Variational AutoReconstructor as one module."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.encoder import Encoder, Features, Images
from completesplat.autoreconstructor.posterior import Posterior, from_moments
from completesplat.autoreconstructor.pretrained import load_pretrained
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.quantities import Share
from completesplat.scene import Views
from completesplat.splatter_image import Parameterization, SplatterImage
from completesplat.tensors import TensorDataclass

DepthRange = Float[Tensor, "batch 2"]


@dataclass(frozen=True)
class Reconstruction(TensorDataclass):
    """Prediction of a reconstruction model from one image. Regression baselines have no posterior."""

    splatter_image: SplatterImage
    posterior: Posterior | None


class ReconstructionModel(nn.Module):
    """Base class of networks from images to a `Reconstruction`: the autoreconstructor, and baselines without views."""

    parameterization: Parameterization
    """Parameterization of the predicted Splatter Images."""

    sees_views = False
    """Whether the posterior depends on views other than the reference."""


class VariationalAutoReconstructor(ReconstructionModel):
    """Encoder and reconstructor (paper, Section 3.2 and Figure 3).

    In training a latent is drawn from the posterior, and all skip features of a sample are zeroed together with
    probability `skip_dropout` (supplement, "Skip connection"; the paper does not state the probability). Evaluation
    uses the posterior's mode, with full skips.

    Args:
        variational: draw latents in training, in both stages; False uses the posterior's mode there too (ablation "no
            variational sampling", which also drops the KL from the loss), because its variance is then not trained.
        gradient_checkpointing: in training, recompute the blocks' activations in the backward pass, which saves
            memory and costs one more forward pass.
        pretrained: folder or hub id of a VAE in diffusers' layout to start from (`load_pretrained`); random if None.
        view_encoder: maps (views, depth range) to what the other views of the scene add to the posterior's moments
            (`view_encoders`); None: the paper's posterior, which sees the reference image alone.

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
        self.sees_views = view_encoder is not None
        self.parameterization = reconstructor.parameterization
        self.variational = variational
        encoder.gradient_checkpointing = reconstructor.gradient_checkpointing = gradient_checkpointing
        if pretrained is not None:
            load_pretrained(pretrained, encoder, reconstructor)

    def posterior(
        self, images: Images, views: Views | None = None, depth_range: DepthRange | None = None
    ) -> tuple[Posterior, Features]:
        """Return the posterior of latents, and the reference's features for the skips.

        Args:
            images: the reference images, sRGB in [0, 1].
            views: all views that the posterior may see, the reference first and its frame as the world. Without others,
                or without a `view_encoder`, the result is the paper's posterior.
        """
        base, features = self.encoder(images)
        if self.view_encoder is None or views is None or views.images.shape[1] < 2:
            return base, features
        assert depth_range is not None
        mean, log_variance = self.view_encoder(views, depth_range).chunk(2, 1)
        return from_moments(torch.cat([base.mean + mean, base.log_variance + log_variance], 1)), features

    def training_latent(self, posterior: Posterior) -> Float[Tensor, "batch channel height width"]:
        """Return the latent of a training step: a draw, or the mode of a posterior whose variance is not trained."""
        return posterior.sample() if self.variational else posterior.mode()

    def forward(
        self, images: Images, views: Views | None = None, depth_range: DepthRange | None = None
    ) -> Reconstruction:
        """Reconstruct from sRGB images in [0, 1], and from `views` if the posterior sees them."""
        posterior, features = self.posterior(images, views, depth_range)
        if not self.training:
            return Reconstruction(self.reconstructor(posterior.mode(), features), posterior)
        skip_mask = (torch.rand(len(images), device=images.device) >= self.skip_dropout).float()
        return Reconstruction(self.reconstructor(self.training_latent(posterior), features, skip_mask), posterior)
