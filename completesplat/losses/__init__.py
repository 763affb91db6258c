"""Training losses of the reconstruction stage (paper, Eq. 1): terms, combined by name."""

from completesplat.losses.terms import LossTerm, Prediction, WeightedSum

__all__ = ["LossTerm", "Prediction", "WeightedSum"]
