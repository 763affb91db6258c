"""Metrics with one value per image: PSNR, SSIM, LPIPS (if its weights are available), depth errors, the user's own."""

from collections.abc import Callable
from dataclasses import dataclass
from inspect import signature
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from completesplat.errors import WeightsError
from completesplat.losses.lpips import PerceptualDistance, load_heads, load_vgg16
from completesplat.losses.ssim import structural_similarity
from completesplat.metrics import METRIC_FORMATS, PSNR_LIMIT, MetricFormat

T = TypeVar("T")
Images = Float[Tensor, "image 3 height width"]
PerImage = Float[Tensor, " image"]
DepthMaps = Float[Tensor, "image 1 height width"]
Counted = Bool[Tensor, "image 1 height width"]
ImageMetric = Callable[..., Tensor]
"""Callable of predicted and true images, and of `masks` if it has this argument, as `values_of` calls it."""

FLATTEST = (1 / 255) ** 2
"""Smallest gradient energy of a truth that sharpness is measured against: one step of 8 bits in all images together."""
ADVICE = "give torchvision's VGG16 as evaluation.metrics.lpips.vgg_weights=FILE_OR_URL"


@dataclass(frozen=True)
class MissingMetrics:
    """Metrics that cannot be measured: the reason, and the names that are absent from results."""

    reason: str
    names: tuple[str, ...]

    def __str__(self) -> str:
        return f"missing: {self.reason}"


def load_or_missing(
    weights: str | None, load: Callable[[str], T], advice: str, names: tuple[str, ...]
) -> T | MissingMetrics:
    """Load a metric, or return `MissingMetrics`: with `advice` without `weights`, with the error for unusable ones."""
    if weights is None:
        return MissingMetrics(advice, names)
    try:
        return load(weights)
    except WeightsError as error:
        return MissingMetrics(" ".join(str(error).split()), names)


def values_of(metric: ImageMetric, predicted: Images, true: Images, counted: Counted) -> Tensor:
    """Return a metric's values, one for each image, of float32 images in [0, 1].

    An argument `masks` gets the pixels that count: all of them, or the object's, where other pixels are black. Metrics
    of torchmetrics, which may average over the images of a call, are called for each image. Networks are moved to the
    images' device.
    """
    from torchmetrics import Metric

    if isinstance(metric, nn.Module):
        metric.to(predicted.device)
    if isinstance(metric, Metric):
        values = [metric(image[None], truth[None]) for image, truth in zip(predicted, true, strict=True)]
        metric.reset()
        return torch.stack(values).flatten()
    masked = "masks" in signature(getattr(metric, "forward", metric)).parameters
    return metric(predicted, true, masks=counted) if masked else metric(predicted, true)


def format_of(name: str, metric: Any) -> MetricFormat:
    """Return a metric's format in tables.

    Its attributes `heading`, `higher_is_better` and `decimals` replace the values of the format with its name.
    """
    known = METRIC_FORMATS.get(name, MetricFormat(name))
    better = known.better
    higher = getattr(metric, "higher_is_better", None)
    if higher is not None:
        better = "↑" if higher else "↓"
    return MetricFormat(getattr(metric, "heading", known.heading), better, getattr(metric, "decimals", known.decimals))


def psnr(predicted: Images, true: Images) -> PerImage:
    """Return the peak signal-to-noise ratio in dB, for values in [0, 1], at most `PSNR_LIMIT`."""
    # torchmetrics makes the number of values on the GPU, which waits for it.
    return (-10 * (predicted - true).square().mean((1, 2, 3)).log10()).clamp(max=PSNR_LIMIT)


def ssim(predicted: Images, true: Images) -> PerImage:
    """Return the structural similarity with a Gaussian window of 11 pixels, sigma 1.5, for values in [0, 1].

    The mean is over all pixels; the image is mirrored beyond its border, as in torchmetrics.
    """
    return structural_similarity(predicted, true).mean((1, 2, 3))


def gradient_energy(images: Images, counted: Counted) -> float:
    """Return the sum of squared differences between neighbours in rows and columns, where both pixels are counted."""
    total = 0.0
    for axis in (-2, -1):
        pairs = counted.shape[axis] - 1
        first = counted.narrow(axis, 0, pairs)
        second = counted.narrow(axis, 1, pairs)
        total += images.diff(dim=axis).square().mul(first & second).sum().item()
    return total


def sharpness(predicted: Images, true: Images, counted: Counted) -> float | None:
    """Return the gradient energy of predicted images over that of the true ones: 1 is as sharp, less is a blur.

    Noise has gradients, too, so more than 1 is not better. Both energies are sums over all images, so that an image
    with few gradients has little weight. None if the truth has no gradient (`FLATTEST`).
    """
    truth = gradient_energy(true, counted)
    if truth < FLATTEST:
        return None
    return gradient_energy(predicted, counted) / truth


def perceptual_metric(vgg_weights: str | None, vgg_sha256: str | None = None) -> PerceptualDistance | MissingMetrics:
    """Return LPIPS with VGG16 as in the paper (Tables 2 to 5), or why it is missing. See `load_vgg16`."""

    def load(weights: str) -> PerceptualDistance:
        return PerceptualDistance(load_vgg16(weights, vgg_sha256), load_heads())

    return load_or_missing(vgg_weights, load, ADVICE, ("lpips",))


def depth_errors(predicted: DepthMaps, true: DepthMaps, valid: Counted) -> list[dict[str, float] | None]:
    """Return each image's errors over valid pixels with finite, positive true depth, without aligning the scale.

    `abs_rel`: mean of |predicted - true| / true; `rmse`: in the depth's unit; `delta1`: share of pixels where
    predicted / true and true / predicted are less than 1.25 (Eigen et al. 2014, Section 4.2). None for an image
    without any of these pixels. `predicted` is 0 where nothing is predicted.
    """
    errors: list[dict[str, float] | None] = []
    for estimate, depth, counted in zip(predicted, true, valid & true.isfinite() & (true > 0), strict=True):
        if not counted.any():
            errors.append(None)
            continue
        p = estimate[counted]
        t = depth[counted]
        ratio = torch.maximum(p / t, t / p)
        difference = p - t
        measured = {
            "abs_rel": (difference.abs() / t).mean().item(),
            "rmse": difference.square().mean().sqrt().item(),
            "delta1": ((ratio < 1.25) & (p > 0)).float().mean().item(),
        }
        errors.append(measured)
    return errors
