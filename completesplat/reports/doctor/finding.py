"""One line of the doctor's table."""

from dataclasses import dataclass
from typing import Literal

State = Literal["yes", "no", "broken"]


@dataclass(frozen=True)
class Finding:
    """What was found, or not, or is broken.

    Args:
        part: of the machine, the same for lines that belong together.
        name: of the thing.
        state: `broken` is what completing a photograph needs and does not have; `no` is no error.
        said: a version, a place, or the reason and what to do.
    """

    part: str
    name: str
    state: State
    said: str


def one_line(error: BaseException) -> str:
    """An exception's kind and message, without line breaks and not too long."""
    message = " ".join(str(error).split())
    return f"{type(error).__name__}: {message[:200]}" if message else type(error).__name__


def size(count: float) -> str:
    """Bytes as `3.2 GB`, `14.1 MB`, `0.3 MB`."""
    return f"{count / 1e9:.1f} GB" if count >= 1e9 else f"{count / 1e6:.1f} MB"
