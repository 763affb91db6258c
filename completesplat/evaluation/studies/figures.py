"""Writer of the studies' figures."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from matplotlib.figure import Figure

from completesplat.files import atomic_path


@contextmanager
def written_figure(path: Path, title: str, size: tuple[float, float]) -> Iterator[Figure]:
    """Yield a figure of this width and height in inches and write it as a PNG if the block ends without exception."""
    figure = Figure(figsize=size, layout="constrained")
    figure.suptitle(title)
    yield figure
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110)
