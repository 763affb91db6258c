"""Unweighted loss terms of the reconstruction stage (paper, Eq. 1)."""

from jaxtyping import Float
from torch import Tensor, nn

from completesplat.losses.ssim import structural_similarity
from completesplat.losses.weighted_sum import Prediction
from completesplat.scene import Views


class MeanSquaredError:
    """Mean over all pixels, channels and views (paper, Eq. 1, first term)."""

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        return nn.functional.mse_loss(prediction.images, truth.images)


class MeanAbsoluteError:
    """Mean over all pixels, channels and views (3DGS's loss, first term)."""

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        return nn.functional.l1_loss(prediction.images, truth.images)


class StructuralDissimilarity:
    """1 - SSIM, averaged over pixels and views (paper, Eq. 1, second term; the paper may mean half of it)."""

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        return 1 - structural_similarity(prediction.images.flatten(0, 1), truth.images.flatten(0, 1)).mean()


class KullbackLeibler:
    """KL of the latent posterior to the standard normal, in nats per value of an image, averaged over the batch.

    Stable Diffusion adds 1e-6 times the KL of a latent to the *sum* of the errors over the 3 * H * W values of its
    image (CompVis `ldm/modules/losses/contperceptual.py`). The other terms here are means over values, so the KL is
    divided by 3 * H * W too: its weight means the same as Stable Diffusion's at every size. Without posterior it is 0.
    """

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        posterior, values = prediction.posterior, prediction.images[0, 0].numel()
        return posterior.kl().mean() / values if posterior is not None else prediction.images.new_zeros(())
