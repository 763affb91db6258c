"""Gaussians fitted to an image of them, as far as they are seen in it."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer

# Rates of Adam: sRGB units, logits of opacities, logarithms of scales.
RATES = {"colors": 0.1, "opacities": 0.4, "scales": 0.12}
DAMPING = 0.01
"""Adam's epsilon: a Gaussian moves slowly if the image's squared error changes by less than this with its values."""
SMALLEST = 1e-4  # opacity's distance from 0 and 1


def fit_front(
    gaussians: Gaussians,
    cameras: Cameras,
    images: Float[Tensor, "batch 3 height width"],
    rasterizer: Rasterizer,
    rounds: int,
    background: float,
    visible: Float[Tensor, "batch 1 height width"] | None = None,
) -> Gaussians:
    """Fit colours, opacities and scales of Gaussians [batch], so that each set looks like its image from its camera.

    Each round is a step of Adam on the squared error; the best of all rounds is returned. Gaussians that the image
    hides stay as they are, and none changes its place. Of `DirectionalGaussians`, the means of the colours change.

    This also works where autograd is off, as in `torch.inference_mode()`.

    Args:
        background: grey value of the images where Gaussians leave a pixel open.
        visible: 0 where an image is not to be fitted.
    """
    with torch.inference_mode(False), torch.enable_grad():
        # Autograd cannot use tensors that were made in inference mode, but it can use copies.
        fixed, views = gaussians.map(torch.clone).detach(), cameras.map(lambda x: x[:, None].clone())
        image = images[:, None].clone()
        shown = 1.0 if visible is None else visible[:, None].clone()
        moves = {name: torch.zeros_like(getattr(fixed, name), requires_grad=True) for name in RATES}
        optimizer = torch.optim.Adam(
            [{"params": [moves[name]], "lr": rate} for name, rate in RATES.items()], eps=DAMPING
        )
        schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, max(rounds, 1))
        best, least = gaussians, math.inf
        for number in range(rounds + 1):
            moved = _moved(fixed, **moves)
            error = ((rasterizer(moved, views).over(background) - image) * shown).square().sum() / 2
            if error.item() < least:
                best, least = moved.detach(), error.item()
            if number < rounds:
                optimizer.zero_grad()
                torch.autograd.backward(error)
                optimizer.step()
                schedule.step()
    return best


def _moved(gaussians: Gaussians, colors: Tensor, opacities: Tensor, scales: Tensor) -> Gaussians:
    """Return Gaussians with changed values; where a change is 0, the value stays exactly as it is."""
    logits = torch.logit(gaussians.opacities, SMALLEST)
    return replace(
        gaussians,
        colors=(gaussians.colors + colors).clamp(min=0),
        opacities=(gaussians.opacities + (torch.sigmoid(logits + opacities) - torch.sigmoid(logits))).clamp(0, 1),
        scales=gaussians.scales * scales.exp(),
    )
