"""Unweighted loss terms of the reconstruction stage (paper, Eq. 1), and their weighted sum."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, TypedDict

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.posterior import Posterior
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.losses.ssim import structural_similarity
from completesplat.quantities import Natural, NonNegative, Positive
from completesplat.rasterizers import Rasterizer
from completesplat.scene import Views
from completesplat.tensors import TensorDataclass


@dataclass(frozen=True)
class Prediction(TensorDataclass):
    """Rendered images of the reference and all targets (sRGB), their Gaussians, and the posterior if any."""

    images: Float[Tensor, "batch view 3 height width"]
    gaussians: Gaussians
    posterior: Posterior | None


class LossTerm(Protocol):
    """Loss term: a scalar from a prediction and the true views of the same cameras."""

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]: ...


class Term(TypedDict, total=False):
    """Loss term, its weight in the sum, and the optimizer step from which on it counts (by default 0)."""

    weight: NonNegative
    term: LossTerm
    start_step: Natural


class WeightedSum:
    """Weighted sum of named loss terms.

    Args:
        terms: name -> {weight, term, start_step (default 0)}; None (an ablation) or weight 0 leaves it out.

    Raises:
        CompleteSplatError: no term counts at step 0, or an entry lacks its term or has other keys.
    """

    def __init__(self, terms: Mapping[str, Term | None]) -> None:
        self.terms = {name: entry for name, entry in terms.items() if entry and entry["weight"]}
        for name, entry in self.terms.items():
            if "term" not in entry or entry.keys() - Term.__annotations__:
                keys = ", ".join(entry)
                raise CompleteSplatError(f"loss.terms.{name}: give weight, term and perhaps start_step, not {keys}")
        if all(entry.get("start_step", 0) > 0 for entry in self.terms.values()):
            raise CompleteSplatError("no loss at step 0: loss.terms needs a term with start_step=0")

    def __call__(
        self, prediction: Prediction, truth: Views, step: int = 0
    ) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
        """Return the weighted sum at an optimizer step, and each term's unweighted value for logging.

        A term is not computed before its `start_step`.
        """
        values: dict[str, Tensor] = {}
        weighted: list[Tensor] = []
        for name, entry in self.terms.items():
            if step >= entry.get("start_step", 0):
                value = entry["term"](prediction, truth)
                weighted.append(entry["weight"] * value)
                values[name] = value.detach()
        return torch.stack(weighted).sum(), values


class MeanSquaredError:
    """Mean over all pixels, channels and views (paper, Eq. 1, first term)."""

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        return nn.functional.mse_loss(prediction.images, truth.images)


class MeanAbsoluteError:
    """Mean over all pixels, channels and views (3DGS's loss, first term)."""

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        return nn.functional.l1_loss(prediction.images, truth.images)


class StructuralDissimilarity:
    """1 - SSIM, averaged over pixels and views (paper, Eq. 1, second term). The paper may mean half of it."""

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        return 1 - structural_similarity(prediction.images.flatten(0, 1), truth.images.flatten(0, 1)).mean()


class Silhouettes:
    """Mean squared difference between the masks and what the object's own Gaussians show, in a drawn part of the views.

    Gaussians of the pixels within the reference's mask are the object's. Drawn in white, with all others in black, they
    should show the mask of each view. So an object is solid from behind, too: where it is thin, Gaussians of the
    background can have its colours, but they are black here. The reference is always among the views that are drawn.

    Args:
        rasterizer: draws the Gaussians once more.
        views: number of views beside the reference that are drawn in each step.

    Raises:
        CompleteSplatError: on a call, the Gaussians are not those of a Splatter Image of the reference.
    """

    def __init__(self, rasterizer: Rasterizer, views: Positive = 3) -> None:
        self.rasterizer = rasterizer
        self.views = views

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        others = torch.randperm(truth.masks.shape[1] - 1)[: self.views] + 1
        seen = truth[:, [0, *others.tolist()]]
        gaussians = prediction.gaussians
        reference = truth.masks[:, 0].flatten(1)
        layers, rest = divmod(gaussians.count, reference.shape[1])
        if rest:
            raise CompleteSplatError(
                "the term Silhouettes needs Gaussians of the reference's pixels: it is for stage 1"
            )
        white = reference.repeat(1, layers)[..., None].expand(gaussians.means.shape)
        objects = Gaussians(gaussians.means, gaussians.quaternions, gaussians.scales, gaussians.opacities, white)
        shown = self.rasterizer(objects, seen.cameras).color[:, :, :1]
        return nn.functional.mse_loss(shown, seen.masks)


class KullbackLeibler:
    """KL of the latent posterior to the standard normal, in nats per value of an image, averaged over the batch.

    Stable Diffusion adds 1e-6 times the KL of a latent to the *sum* of the errors over the 3 * H * W values of its
    image (CompVis `ldm/modules/losses/contperceptual.py`). The other terms here are means over values, so the KL is
    divided by 3 * H * W too: its weight means the same as Stable Diffusion's at every size. Without posterior it is 0.
    """

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        posterior = prediction.posterior
        values = prediction.images[0, 0].numel()
        return posterior.kl().mean() / values if posterior is not None else prediction.images.new_zeros(())
