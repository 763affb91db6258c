"""Distribution over latents that the encoder predicts."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.tensors import TensorDataclass

LOG_VARIANCE_RANGE = (-30.0, 20.0)
"""Range to which Stable Diffusion's VAE clamps log-variances (CompVis `ldm/modules/distributions/distributions.py`)."""

ACTIVE_BITS = 0.1
"""A channel of the latent is active if its values carry more bits than this on average."""


@dataclass(frozen=True)
class Posterior(TensorDataclass):
    """Diagonal Gaussian posterior q(h | image)."""

    mean: Float[Tensor, "batch channel height width"]
    log_variance: Float[Tensor, "batch channel height width"]

    @property
    def std(self) -> Float[Tensor, "batch channel height width"]:
        return torch.exp(0.5 * self.log_variance)

    def sample(self, generator: torch.Generator | None = None) -> Float[Tensor, "batch channel height width"]:
        """Draw h = mu + epsilon * sigma, the reparameterisation trick (paper, Section 3.2)."""
        noise = torch.randn(self.mean.shape, generator=generator, device=self.mean.device, dtype=self.mean.dtype)
        return self.mean + noise * self.std

    def mode(self) -> Float[Tensor, "batch channel height width"]:
        """Return the most probable latent."""
        return self.mean

    def kl(self) -> Float[Tensor, " batch"]:
        """Return the KL to the standard normal, summed over the latent: 0.5 sum(mu^2 + sigma^2 - 1 - log sigma^2)."""
        return self._kl_of_values().sum(dim=(1, 2, 3))

    def channel_bits(self) -> Float[Tensor, " channel"]:
        """Return each channel's KL in bits, summed over space and averaged over the batch."""
        return self._kl_of_values().sum(dim=(2, 3)).mean(0) / math.log(2)

    def active_channels(self) -> int:
        """Return the number of channels whose values carry more than `ACTIVE_BITS` on average."""
        return int((self.channel_bits() > ACTIVE_BITS * self.mean[0, 0].numel()).sum())

    def _kl_of_values(self) -> Float[Tensor, "batch channel height width"]:
        return 0.5 * (self.mean.square() + self.log_variance.exp() - 1 - self.log_variance)


def from_moments(moments: Float[Tensor, "batch channel height width"]) -> Posterior:
    """Split the encoder's output into mean and (clamped) log-variance, in float32."""
    mean, log_variance = moments.float().chunk(2, dim=1)
    return Posterior(mean, log_variance.clamp(*LOG_VARIANCE_RANGE))
