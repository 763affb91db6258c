"""Colours of Gaussians fitted to an image of them, as far as they are seen in it."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.gaussians import DirectionalGaussians, Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer


def fit_colors(
    gaussians: Gaussians,
    cameras: Cameras,
    images: Float[Tensor, "batch 3 height width"],
    rasterizer: Rasterizer,
    rounds: int,
    background: float,
    visible: Float[Tensor, "batch 1 height width"] | None = None,
) -> Gaussians:
    """Move the colours of Gaussians [batch] so that each set, seen from its camera, looks like its image.

    In each round a Gaussian's colour moves by the mean difference between image and render over the pixels that it
    covers, weighted by its contributions to them (simultaneous iterative reconstruction, Gilbert 1972). If these sum
    to less than 1, the colour moves by the weighted sum, so that colours of hidden Gaussians stay as they are.

    Of `DirectionalGaussians`, the means of the colours move, by as much as the colours that the camera sees.

    This also works where autograd is off, as in `torch.inference_mode()`.

    Args:
        background: grey value of the images where Gaussians leave a pixel open.
        visible: 0 where an image is not to be fitted.
    """
    with torch.inference_mode(False), torch.enable_grad():
        # Autograd cannot use tensors that were made in inference mode, but it can use copies.
        fixed, views = gaussians.map(torch.clone).detach(), cameras.map(lambda x: x[:, None].clone())
        fixed = fixed.seen_from(views.centers[:, 0])
        shown = 1.0 if visible is None else visible[:, None].clone()
        colors, total = fixed.colors, torch.ones(())
        for number in range(rounds):
            colors = colors.detach().requires_grad_()
            rendering = rasterizer(replace(fixed, colors=colors), views)
            if number == 0:
                (total,) = torch.autograd.grad((rendering.color * shown).sum(), colors, retain_graph=True)
            missing = (images[:, None] - rendering.over(background)).detach() * shown
            (change,) = torch.autograd.grad((rendering.color * missing).sum(), colors)
            colors = (colors + change / total.clamp(min=1)).clamp(min=0)
        if isinstance(gaussians, DirectionalGaussians):
            colors = gaussians.colors + colors - fixed.colors
    return replace(gaussians, colors=colors.detach())
