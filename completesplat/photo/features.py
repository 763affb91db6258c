"""Features that tell images of one kind from others, and how far a photo's are from those of training images."""

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


def image_features(images: Float[Tensor, "*batch 3 height width"]) -> Float[Tensor, "*batch 8"]:
    """Return mean and standard deviation of red, green and blue, and two measures of detail.

    The measures of detail are the mean absolute differences between neighbours in a row, and in a column. All features
    lie in [0, 1].
    """
    means = images.mean((-2, -1))
    deviations = images.std((-2, -1), correction=0)
    steps = [images.diff(dim=axis).abs().mean((-3, -2, -1))[..., None] for axis in (-1, -2)]
    return torch.cat([means, deviations, *steps], dim=-1)


def distance_to_training(image: Float[Tensor, "3 size size"], training: Mapping[str, Any]) -> float | None:
    """Return an image's distance from training images, in standard deviations, or None if nothing is known of them.

    It is the root mean square over the `image_features`: about 1 for an image of the same kind.

    Args:
        training: facts about the training images (`TrainingImages`).
    """
    if "picture_mean" not in training or "picture_std" not in training:
        return None
    mean = torch.tensor(training["picture_mean"])
    deviation = torch.tensor(training["picture_std"])
    return ((image_features(image) - mean) / deviation).square().mean().sqrt().item()
