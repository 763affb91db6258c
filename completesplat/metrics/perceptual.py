"""LPIPS as a metric, where its weights are at hand."""

from collections.abc import Callable

from jaxtyping import Float
from torch import Tensor

from completesplat.losses.lpips import PerceptualDistance, load_heads
from completesplat.losses.vgg import load_vgg16
from completesplat.metrics.missing import Missing, unless_missing

ADVICE = "give torchvision's VGG16 as evaluation.scoring.perceptual.vgg_weights=FILE_OR_URL"


class PerceptualMetric:
    """LPIPS with VGG16 of each pair of images with values in [0, 1]: the paper's (Tables 2 to 5)."""

    def __init__(self, distance: PerceptualDistance) -> None:
        self.distance = distance

    def __call__(
        self, predicted: Float[Tensor, "image 3 height width"], true: Float[Tensor, "image 3 height width"]
    ) -> Float[Tensor, " image"]:
        return self.distance.to(predicted.device)(predicted, true)


def perceptual_metric(
    vgg_weights: str | None, vgg_sha256: str | None = None
) -> Callable[[Tensor, Tensor], Tensor] | Missing:
    """LPIPS, or why there is none; see `load_vgg16` for the weights."""
    load = lambda weights: PerceptualMetric(PerceptualDistance(load_vgg16(weights, vgg_sha256), load_heads()))  # noqa: E731
    return unless_missing(vgg_weights, load, ADVICE, ("lpips",))
