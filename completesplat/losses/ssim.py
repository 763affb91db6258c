"""Structural similarity (SSIM)."""

from functools import cache
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

# Wang et al. 2004, Section III.B and III.C: window of 11 pixels, sigma 1.5, K1 = 0.01, K2 = 0.03, for values in [0, 1].
RADIUS = 5
SIGMA = 1.5
C1 = 0.01**2
C2 = 0.03**2
VALUES_AT_ONCE = 2**17  # on a CPU, so that intermediate results stay in its cache

Images = Float[Tensor, "image channel height width"]


def structural_similarity(first: Images, second: Images) -> Images:
    """Return the SSIM of each pixel (Wang et al. 2004), for values in [0, 1], in the images' precision.

    The Gaussian window is applied as two products with banded matrices, which are three to five times as fast as
    convolutions on a CPU. Images are mirrored at their borders, so sides exceed 5 pixels. Only `first` gets gradients.
    """
    images = max(1, VALUES_AT_ONCE // first.shape[1:].numel()) if first.device.type == "cpu" else max(1, len(first))
    parts = zip(torch.split(first, images), torch.split(second.detach(), images), strict=True)
    with torch.autocast(first.device.type, enabled=False):
        return torch.cat([_Similarity.apply(*part) for part in parts])  # type: ignore[no-untyped-call]


class _Similarity(torch.autograd.Function):
    """SSIM = a b / (c d), with half as many and half as large intermediate results as autograd would keep."""

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor) -> Tensor:
        rows, columns = (blur_matrix(size, first.dtype, first.device) for size in first.shape[-2:])
        products = torch.stack([first, second, first * second, first * first])
        products[3].addcmul_(second, second)
        mean1, mean2, b, d = rows @ (products @ columns.T)
        a = mean1 * mean2
        c = (mean1 * mean1).addcmul_(mean2, mean2)
        b.sub_(a).mul_(2).add_(C2)
        d.sub_(c).add_(C2)
        a.mul_(2).add_(C1)
        c.add_(C1)
        values: Tensor = (a * b).div_(c).div_(d)
        ctx.save_for_backward(first, second, mean1, mean2, a, b, c, d, values)
        return values

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        first, second, mean1, mean2, a, b, c, d, values = ctx.saved_tensors
        rows, columns = (blur_matrix(size, first.dtype, first.device) for size in first.shape[-2:])
        of_b = (2 * gradient).div_(c).div_(d)
        of_value = gradient * values
        of_square = (of_value / d).neg_()
        of_mean = ((b - a) * of_b).mul_(mean2).addcmul_(mean1, (of_value / c).add_(of_square), value=-2)
        blurred = rows.T @ (torch.stack([of_mean, of_b.mul_(a), of_square]) @ columns)
        result: Tensor = blurred[0].addcmul_(blurred[1], second).addcmul_(blurred[2], first, value=2)
        return result, None


@cache
@torch.inference_mode(False)  # because a training may use the matrix that a test has cached
def blur_matrix(size: int, dtype: torch.dtype, device: torch.device) -> Float[Tensor, "{size} {size}"]:
    """Return the matrix that applies the window along an axis: its rows sum to 1."""
    offsets = torch.arange(-RADIUS, RADIUS + 1)
    window = torch.exp(-offsets.double().square() / (2 * SIGMA**2))
    pixels = (torch.arange(size)[:, None] + offsets).abs()
    pixels = torch.where(pixels < size, pixels, 2 * (size - 1) - pixels)
    matrix = torch.zeros(size, size, dtype=torch.float64)
    matrix.scatter_add_(1, pixels, (window / window.sum()).expand(size, -1))
    return matrix.to(dtype).to(device)
