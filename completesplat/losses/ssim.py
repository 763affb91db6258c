"""Structural similarity."""

from jaxtyping import Float
from kornia.metrics import ssim
from torch import Tensor

from completesplat.losses.weighted_sum import Prediction
from completesplat.scene import Views


class StructuralDissimilarity:
    """1 - SSIM, averaged over pixels and views (paper, Eq. 1, second term; it does not state 1 - SSIM or half of it).

    Args:
        window: side of the Gaussian window (11, Wang et al. 2004, as in Splatter Image's metric).
    """

    def __init__(self, window: int = 11) -> None:
        self.window = window

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        similarity = ssim(prediction.images.flatten(0, 1), truth.images.flatten(0, 1), self.window)
        return 1 - similarity.mean()
