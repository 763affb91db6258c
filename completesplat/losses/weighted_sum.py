"""Named loss terms and their weighted sum."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.autoreconstructor.model import Reconstruction
from completesplat.scene import Views
from completesplat.tensors import TensorDataclass


@dataclass(frozen=True)
class Prediction(TensorDataclass):
    """Rendered images of the reference and all targets (sRGB), with the reconstruction they come from."""

    images: Float[Tensor, "batch view 3 height width"]
    reconstruction: Reconstruction


class LossTerm(Protocol):
    """One term: a scalar from a prediction and the true views of the same cameras."""

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]: ...


class Weighted(NamedTuple):
    """A term with its weight in the sum."""

    weight: float
    term: LossTerm


class WeightedSum:
    """Sum of weighted terms, by name.

    Args:
        terms: name -> {weight, term}; an entry that is None is left out (that is how an ablation drops one).
    """

    def __init__(self, terms: Mapping[str, Mapping | None]) -> None:
        self.terms = {name: Weighted(**entry) for name, entry in terms.items() if entry is not None}

    def __call__(self, prediction: Prediction, truth: Views) -> tuple[Float[Tensor, ""], dict[str, Tensor]]:
        """The weighted sum, and the unweighted value of each term for logging."""
        values = {name: entry.term(prediction, truth) for name, entry in self.terms.items()}
        total = torch.stack([self.terms[name].weight * value for name, value in values.items()]).sum()
        return total, {name: value.detach() for name, value in values.items()}
