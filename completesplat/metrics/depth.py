"""Errors of predicted depth against measured depth."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor


def depth_errors(
    predicted: Float[Tensor, "image 1 height width"],
    true: Float[Tensor, "image 1 height width"],
    valid: Bool[Tensor, "image 1 height width"],
) -> list[dict[str, float] | None]:
    """For each image, over its valid pixels (Eigen et al. 2014, Section 4.2), without alignment of scale.

    `abs_rel`: mean of |predicted - true| / true; `rmse`: in the depth's unit; `delta1`: share of pixels where
    predicted / true and true / predicted are less than 1.25. None for an image without a valid pixel.

    Args:
        predicted: depth, in the unit of `true`; where nothing is predicted, 0.
        true: depth; a pixel counts only where it is finite and above 0.
        valid: pixels that count.
    """
    counted = valid & true.isfinite() & (true > 0)
    return [_errors(p[c], t[c]) if c.any() else None for p, t, c in zip(predicted, true, counted, strict=True)]


def _errors(predicted: Float[Tensor, " pixel"], true: Float[Tensor, " pixel"]) -> dict[str, float]:
    difference = predicted - true
    ratio = torch.maximum(predicted / true, true / predicted)
    return {
        "abs_rel": (difference.abs() / true).mean().item(),
        "rmse": difference.square().mean().sqrt().item(),
        "delta1": ((ratio < 1.25) & (predicted > 0)).float().mean().item(),
    }
