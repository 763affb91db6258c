"""Predictors that know nothing of geometry. A model that does not beat them has learned nothing of use."""

from jaxtyping import Float
from torch import Tensor

from completesplat.scene import SceneBatch


def copy_reference(scenes: SceneBatch) -> Float[Tensor, "batch view 3 height width"]:
    """The reference image for every view."""
    views = scenes.all_views().images
    return scenes.reference.images[:, None].expand_as(views)


def repeat_image(
    image: Float[Tensor, "3 height width"], scenes: SceneBatch
) -> Float[Tensor, "batch view 3 height width"]:
    """One image for every view: with the training set's mean image, the best constant prediction of the MSE."""
    return image.to(scenes.reference.images).expand_as(scenes.all_views().images)
