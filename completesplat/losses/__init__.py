"""Training losses of the reconstruction stage (paper, Eq. 1): terms, combined by name."""

from completesplat.losses.weighted_sum import LossTerm, Prediction, WeightedSum

__all__ = ["LossTerm", "Prediction", "WeightedSum"]
