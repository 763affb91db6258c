"""Treatment of what cannot be read in a data set: skipped up to a share, or refused at once."""

from dataclasses import dataclass
from typing import Literal

from completesplat.errors import DataError

OnBad = Literal["skip", "raise"]


@dataclass(frozen=True)
class ErrorTolerance:
    """Rule for what cannot be read.

    Args:
        on_bad: "skip" what cannot be read, or "raise" its error.
        max_bad_fraction: largest share that may be skipped.
    """

    on_bad: OnBad = "skip"
    max_bad_fraction: float = 0.1

    def check(self, error: DataError) -> None:
        """Raise the error if nothing may be skipped."""
        if self.on_bad == "raise":
            raise error

    def is_exceeded(self, bad: int, items: int) -> bool:
        """Return whether more items are bad than may be skipped. One always may, unless the share is 0."""
        if self.max_bad_fraction == 0:
            return bad > 0
        return bad > max(1, self.max_bad_fraction * items)


SKIP_ALL = ErrorTolerance("skip", 1.0)
