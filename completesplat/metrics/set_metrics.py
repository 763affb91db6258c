"""The metrics of whole sets of images: FID and KID of Inception's features, sliced Wasserstein of patches."""

from collections.abc import Sequence
from typing import Any

from jaxtyping import Float
from torch import Tensor

from completesplat.metrics.distribution import frechet_distance, kernel_distance
from completesplat.metrics.image_sets import Descriptors
from completesplat.metrics.inception import InceptionFeatures, load_inception
from completesplat.metrics.missing import Missing, unless_missing
from completesplat.metrics.sliced_wasserstein import descriptors, sliced_wasserstein

ADVICE = "give inception-2015-12-05.pt as evaluation.scoring.sets.inception.weights=FILE_OR_URL"


class Patches:
    """The sliced Wasserstein distance of patches, all pixels, as "swd"; see `sliced_wasserstein`.

    Args:
        patches: of each image and level of its pyramid.
    """

    regions = ("full",)

    def __init__(self, patches: int = 16) -> None:
        self.patches = patches

    def describe(self, images: Float[Tensor, "image 3 height width"], seeds: Sequence[int]) -> Descriptors:
        """See `SetMetric`."""
        return list(descriptors(images, seeds, self.patches))

    def distances(self, true: Descriptors, predicted: Descriptors) -> dict[str, float]:
        """See `SetMetric`."""
        return {"swd": sliced_wasserstein(true, predicted)}

    def settings(self) -> dict[str, dict[str, Any]]:
        """See `SetMetric`."""
        return {"swd": {"patches": self.patches, "patch": 7, "projections": 512, "factor": 1000}}


class Inception:
    """FID and KID, as "fid" and "kid", for all and for object pixels.

    Args:
        features: of images.
        subset_size: of KID: items of a subset, at most.
    """

    regions = ("full", "object")

    def __init__(self, features: InceptionFeatures, subset_size: int = 1000) -> None:
        self.features = features
        self.subset_size = subset_size

    def describe(self, images: Float[Tensor, "image 3 height width"], seeds: Sequence[int]) -> Descriptors:
        """See `SetMetric`; nothing is drawn."""
        return [self.features.to(images.device)(images)]

    def distances(self, true: Descriptors, predicted: Descriptors) -> dict[str, float]:
        """See `SetMetric`."""
        (one,), (other,) = true, predicted
        return {"fid": frechet_distance(one, other), "kid": kernel_distance(one, other, self.subset_size)}

    def settings(self) -> dict[str, dict[str, Any]]:
        """See `SetMetric`."""
        network = {"network": "inception-2015-12-05", "features": "pool, 2048"}
        return {"fid": network, "kid": network | {"subset_size": self.subset_size, "subsets": 100, "factor": 1}}


def inception(weights: str | None, sha256: str | None = None, subset_size: int = 1000) -> Inception | Missing:
    """FID and KID, or why there are none; see `load_inception` for the weights."""
    load = lambda given: Inception(load_inception(given, sha256), subset_size)  # noqa: E731
    return unless_missing(weights, load, ADVICE, ("fid", "kid"))
