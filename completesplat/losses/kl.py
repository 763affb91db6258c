"""Divergence of the posterior from the prior."""

from jaxtyping import Float
from torch import Tensor

from completesplat.losses.weighted_sum import Prediction
from completesplat.scene import Views


class KullbackLeibler:
    """KL of the latent posterior to the standard normal, in nats per value of an image, averaged over the batch.

    Stable Diffusion adds 1e-6 times the KL of a latent to the *sum* of the errors over the 3 * H * W values of its
    image (CompVis `ldm/modules/losses/contperceptual.py`). The other terms here are means over values, so the KL is
    divided by 3 * H * W too: its weight means the same as Stable Diffusion's at every image size. The KL is 0 for a
    model without a posterior.
    """

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        posterior, values = prediction.posterior, prediction.images[0, 0].numel()
        return posterior.kl().mean() / values if posterior is not None else prediction.images.new_zeros(())
