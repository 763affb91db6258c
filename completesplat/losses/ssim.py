"""Structural similarity."""

from jaxtyping import Float
from kornia.metrics import ssim
from torch import Tensor

from completesplat.losses.weighted_sum import Prediction
from completesplat.scene import Views


class StructuralDissimilarity:
    """1 - SSIM, averaged over pixels and views (paper, Eq. 1, second term, which may also mean half of it).

    The Gaussian window has 11 pixels a side (Wang et al. 2004, as in Splatter Image's metric).
    """

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        similarity = ssim(prediction.images.flatten(0, 1), truth.images.flatten(0, 1), window_size=11)
        return 1 - similarity.mean()
