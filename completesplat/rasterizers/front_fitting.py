"""Gaussians fitted to an image of them, as far as they are seen in it."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer

RATES = {"colors": 0.1, "opacities": 0.4, "scales": 0.12}
BETAS = 0.9, 0.999
DAMPING = 0.01
"""Adam's epsilon: a Gaussian moves slowly if the image's squared error changes by less than this with its values."""
ENOUGH = 1e-3
"""Mean squared error (30 dB) at which fitting ends, because more of it makes the sides of a scene worse."""
SMALLEST = 1e-4  # opacity's distance from 0 and 1
ONLY_FALLING = ("opacities", "scales")
"""What fitting does not raise: a Gaussian that grows hides, from other sides, what lies behind it."""


@dataclass(frozen=True)
class Pace:
    """Pace of a fit.

    Attributes:
        warm_up: rounds in which the rates rise, so that a scene that is nearly right moves little.
        rates: Adam's rates, by name: sRGB units, logits of opacities, logarithms of scales.
    """

    warm_up: int = 8
    rates: Mapping[str, float] = field(default_factory=lambda: RATES)


DEFAULT_PACE = Pace()


def fit_front(
    gaussians: Gaussians,
    cameras: Cameras,
    images: Float[Tensor, "batch 3 height width"],
    rasterizer: Rasterizer,
    rounds: int,
    background: float,
    visible: Float[Tensor, "batch 1 height width"] | None = None,
    pace: Pace = DEFAULT_PACE,
) -> Gaussians:
    """Fit colours, opacities and scales of Gaussians [batch], so that each set looks like its image from its camera.

    Each round is a step of Adam on the squared error, until it is `ENOUGH`. The best of all rounds is returned.
    Gaussians that the image hides stay as they are. None changes its place, becomes more opaque or grows. Of
    `DirectionalGaussians`, the means of the colours change.

    This also works where autograd is off, as in `torch.inference_mode()`.

    Args:
        background: grey value of the images where Gaussians leave a pixel open.
        visible: 0 where an image is not to be fitted.
    """
    with torch.inference_mode(False), torch.enable_grad():
        # Autograd cannot use tensors that were made in inference mode, but it can use copies.
        fixed = gaussians.map(torch.clone).detach()
        views = cameras[:, None].map(torch.clone)
        image = images[:, None].clone()
        mask = torch.ones_like(image) if visible is None else visible[:, None].expand_as(image).clone()
        moves = [torch.zeros_like(getattr(fixed, name), requires_grad=True) for name in RATES]
        means = [torch.zeros_like(move) for move in moves]
        squares = [torch.zeros_like(move) for move in moves]
        best = gaussians
        least = math.inf
        for number in range(1, rounds + 2):
            moved = _moved(fixed, *moves)
            error = ((rasterizer(moved, views).over(background) - image) * mask).square().sum() / 2
            if error.item() < least:
                best = moved.detach()
                least = error.item()
            if number > rounds or least <= ENOUGH * mask.sum().item() / 2:
                break
            grads = torch.autograd.grad(error, moves)
            # torch.optim's Adam is the same, but its first step imports torch's compiler, which takes a second.
            factor = min(1, number / pace.warm_up) * (1 + math.cos(math.pi * (number - 1) / rounds)) / 2
            steps = zip(pace.rates.items(), moves, means, squares, grads, strict=True)
            for (name, rate), move, mean, square, grad in steps:
                mean.lerp_(grad, 1 - BETAS[0])
                square.lerp_(grad.square(), 1 - BETAS[1])
                deviation = (square / (1 - BETAS[1] ** number)).sqrt() + DAMPING
                move.data -= rate * factor * mean / (1 - BETAS[0] ** number) / deviation
                if name in ONLY_FALLING:
                    move.data.clamp_(max=0)
    return best


def _moved(gaussians: Gaussians, colors: Tensor, opacities: Tensor, scales: Tensor) -> Gaussians:
    """Return Gaussians with changed values. Where a change is 0, the value stays exactly as it is."""
    logits = torch.logit(gaussians.opacities, SMALLEST)
    return replace(
        gaussians,
        # No colour becomes brighter than white: it would show from the side.
        colors=(gaussians.colors + colors).clamp(gaussians.colors.clamp(max=0), gaussians.colors.clamp(min=1)),
        opacities=(gaussians.opacities + (torch.sigmoid(logits + opacities) - torch.sigmoid(logits))).clamp(0, 1),
        scales=gaussians.scales * scales.exp(),
    )
