"""Divergence of the posterior from the prior."""

from jaxtyping import Float
from torch import Tensor

from completesplat.losses.weighted_sum import Prediction
from completesplat.scene import Views


class KullbackLeibler:
    """KL of the latent posterior to the standard normal: summed over the latent, averaged over the batch.

    Zero for a model without a posterior. The paper states no weight; Stable Diffusion's is 1e-6.
    """

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        posterior = prediction.posterior
        return posterior.kl().mean() if posterior is not None else prediction.images.new_zeros(())
