"""Metrics that cannot be measured here: they are named with the reason, and nothing stands in for them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from completesplat.errors import WeightsError

Metric = TypeVar("Metric")


@dataclass(frozen=True)
class Missing:
    """Why metrics are not measured, and their names in results."""

    reason: str
    names: tuple[str, ...]

    def __str__(self) -> str:
        return f"missing: {self.reason}"


def unless_missing(
    weights: str | None, load: Callable[[str], Metric], advice: str, names: tuple[str, ...]
) -> Metric | Missing:
    """What `load` makes of the weights; without them, or where they cannot be used, the reason.

    Args:
        advice: what to do where there are none.
        names: of what cannot be measured then.
    """
    if weights is None:
        return Missing(advice, names)
    try:
        return load(weights)
    except WeightsError as error:
        return Missing(" ".join(str(error).split()), names)
