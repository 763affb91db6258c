"""Mean squared error."""

from jaxtyping import Float
from torch import Tensor, nn

from completesplat.losses.weighted_sum import Prediction
from completesplat.scene import Views


class MeanSquaredError:
    """Mean over all pixels, channels and views (paper, Eq. 1, first term)."""

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        return nn.functional.mse_loss(prediction.images, truth.images)
