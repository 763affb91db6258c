"""Discrete code of a scene: says which of several completions is drawn, before the denoiser draws it.

Not in the paper. A denoiser that sees noise alone cannot know which completion it is to draw, answers with their mean,
and often keeps to it. DisCo-Diff (Xu et al. 2024, arXiv 2407.03300) therefore gives it discrete values, which an
encoder learns with it and which a prior draws.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import gumbel_softmax, one_hot
from torch.special import entr

from completesplat.diffusion.guidance import Features, Latents

WIDTH = 64
BONUS = 0.1


class SceneCode(nn.Module):
    """Code of some values out of a few each, in training from the latent, in sampling from a prior given phi_ref.

    Args:
        latent_channels, conditioning_channels: channels of the latent and of phi_ref.
        length, values: number of the code's values, and how many each can have.
    """

    def __init__(self, latent_channels: int, conditioning_channels: int, length: int, values: int) -> None:
        super().__init__()
        self.shape = length, values
        self.encoder = _classifier(latent_channels + conditioning_channels, length * values)
        self.prior = _classifier(conditioning_channels, length * values)
        self.embedding = nn.Parameter(torch.randn(length, values, conditioning_channels) / 4)

    def forward(self, latent: Latents, conditioning: Features) -> tuple[Features, Float[Tensor, ""], Float[Tensor, ""]]:
        """Encode latents in training; return phi_ref with their codes, a loss, and what the code tells (nats a value).

        What it tells is its divergence from the prior: what the latent says and phi_ref does not. The loss is the
        prior's cross-entropy. It is lowered by what the code tells and by the entropy of all scenes' values, `BONUS`
        for each nat, because codes often became constant without. Values are drawn by the Gumbel trick with
        straight-through gradients (Jang et al. 2017). phi_ref gets gradients from the denoiser alone.
        """
        seen = conditioning.detach()
        logits = self.encoder(torch.cat([latent, seen], 1)).float().unflatten(1, self.shape)
        predicted = self.prior(seen).float().unflatten(1, self.shape)
        shares, own, expected = logits.softmax(2), logits.log_softmax(2), predicted.log_softmax(2)
        told = (shares * (own - expected.detach())).sum(2).mean()
        loss = -(shares.detach() * expected).sum(2).mean() - BONUS * (told + entr(shares.mean(0)).sum(1).mean())
        return self._added(conditioning, gumbel_softmax(logits, hard=True, dim=2)), loss, told.detach()

    def encoded(self, latent: Latents, conditioning: Features) -> Features:
        """Return phi_ref with the most probable codes of latents."""
        logits = self.encoder(torch.cat([latent, conditioning], 1)).unflatten(1, self.shape)
        return self._added(conditioning, one_hot(logits.argmax(2), self.shape[1]).to(logits))

    def drawn(self, conditioning: Features, noise: Latents) -> Features:
        """Return phi_ref with codes drawn from the prior; `noise` alone decides each, as it does a sample's latent."""
        shares = self.prior(conditioning).float().unflatten(1, self.shape).softmax(2).cpu()
        seeds = noise.float().contiguous().view(torch.int32).flatten(1).sum(1).tolist()
        generators = [torch.Generator().manual_seed(seed) for seed in seeds]
        drawn = [torch.multinomial(share, 1, generator=own) for share, own in zip(shares, generators, strict=True)]
        codes = one_hot(torch.stack(drawn)[..., 0], self.shape[1])
        return self._added(conditioning, codes.to(self.embedding))

    def _added(self, conditioning: Features, code: Float[Tensor, "batch value choice"]) -> Features:
        """Add the sum of a code's embeddings at every place."""
        return conditioning + torch.einsum("bvk,vkc->bc", code, self.embedding)[..., None, None]


def _classifier(channels: int, classes: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width, stride in ((WIDTH, 1), (WIDTH, 2), (2 * WIDTH, 2), (2 * WIDTH, 1)):
        layers += [nn.Conv2d(channels, width, 3, stride, 1), nn.GroupNorm(8, width), nn.SiLU()]
        channels = width
    return nn.Sequential(*layers, nn.AdaptiveAvgPool2d(2), nn.Flatten(), nn.Linear(4 * channels, classes))
