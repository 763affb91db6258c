"""Regions of views in which images are scored: all pixels, the object's, and those that the reference view hides."""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.geometry.surfaces import hidden_from
from completesplat.metrics.images import Images
from completesplat.metrics.proper_scores import SampledValues, TrueValues
from completesplat.metrics.sample_scores import SampledViews
from completesplat.scene import Views

REGIONS = ("full", "object")


def object_only(images: Images, masks: Float[Tensor, "image 1 height width"]) -> Images:
    """Make the background of images black, by the true mask binarised at 0.5 (supplement, "Objects only").

    The paper does not say whether its masks are soft; CO3D's own challenge binarises at 0.5.
    """
    return torch.where(masks > 0.5, images, torch.zeros_like(images))


def in_region(images: Tensor, truth: Views, region: str) -> Tensor:
    """Return images of the true views with the pixels outside the region black."""
    return object_only(images, truth.masks) if region == "object" else images


def counted_pixels(truth: Views, region: str) -> Bool[Tensor, "view 1 height width"]:
    """Return the mask of the pixels that count in a region."""
    return truth.masks > 0.5 if region == "object" else torch.ones_like(truth.masks, dtype=torch.bool)


def novel_values(images: SampledViews, truth: Views) -> dict[str, tuple[SampledValues, TrueValues]]:
    """Return the values of the samples and the true values by region. The first view of `truth` is the reference.

    Regions are all pixels (`full`) and, if true depth is known, those that the reference view does not show (`hidden`).
    """
    novel = truth[1:]
    masks = {"full": torch.ones_like(novel.masks[:, 0], dtype=torch.bool)}
    if truth.depths is not None and truth.depths.shape[-2:] == images.shape[-2:]:
        hidden, _ = hidden_from(truth.cameras[0], truth.depths[0], novel.cameras, truth.depths[1:])
        if hidden.any():
            masks["hidden"] = hidden
    sampled = images.movedim(2, -1).float()
    true = novel.images.movedim(1, -1).float()
    return {region: (sampled[:, mask].flatten(1), true[mask].flatten()) for region, mask in masks.items()}
