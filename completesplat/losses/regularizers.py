"""Regularisers of the Gaussians, both off by default (weight 0) and not in the paper."""

from jaxtyping import Float
from torch import Tensor

from completesplat.losses.weighted_sum import Prediction
from completesplat.scene import Views


class MeanScale:
    """Mean of the Gaussians' scales, in scene units (Kheradmand et al. 2024, "3DGS as Markov Chain Monte Carlo")."""

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        return prediction.gaussians.scales.mean()


class MeanOpacity:
    """Mean of the Gaussians' opacities (Kheradmand et al. 2024)."""

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        return prediction.gaussians.opacities.mean()
