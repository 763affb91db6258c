"""How time grows with the number of Gaussians, of views and of pixels."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.reports.rasterizers.backends import Backend
from completesplat.reports.rasterizers.speed import side_by_side
from completesplat.reports.rasterizers.workloads import splatter_scene

AXES = ("gaussians", "views", "size")
SOURCE_SIZES = (23, 72, 229, 724)  # two Gaussians to a pixel of the source: 1k, 10k, 105k and 1M
IMAGE_SIZE, SOURCE_SIZE = 512, 128
VIEWS = (1, 2, 4, 8, 16)
IMAGE_SIZES = (64, 128, 256, 512)
PATIENCE_MS = 8e3  # a backend that took longer than this is not tried on the next larger workload
REPEATS = 3


def rows(backends: Sequence[Backend], tick: Callable[[str], None], most_gaussians: int) -> list[dict[str, Any]]:
    """One row for each backend and point of an axis, all with opacities as after training.

    Gaussians: in one image of 512 x 512, which they cover alike (many small ones, or few large ones). Views: of
    128 x 128. Size: of one image of the same 32,768 Gaussians. On the first axis `most_gaussians` are not exceeded.
    """
    result: list[dict[str, Any]] = []
    tired: set[tuple[str, str]] = set()
    for axis, gaussians, cameras in _workloads(most_gaussians):
        point = {
            "axis": axis,
            "gaussians": gaussians.count,
            "views": cameras.intrinsics.shape[1],
            "size": cameras.image_size[0],
        }
        tick(f"growth with {axis}: {point[axis]}")
        ready = [backend for backend in backends if (backend.name, axis) not in tired]
        for name, figures in side_by_side(ready, gaussians, cameras, REPEATS).items():
            result.append({"backend": name} | point | figures)
            if figures["forward_backward_ms"] > PATIENCE_MS:
                tired.add((name, axis))
    return result


def _workloads(most_gaussians: int) -> Iterator[tuple[str, Gaussians, Cameras]]:
    for source_size in SOURCE_SIZES:
        if 2 * source_size**2 <= most_gaussians:
            yield "gaussians", *splatter_scene(source_size, 1, "trained", IMAGE_SIZE)
    for views in VIEWS:
        yield "views", *splatter_scene(SOURCE_SIZE, views, "trained")
    for size in IMAGE_SIZES:
        yield "size", *splatter_scene(SOURCE_SIZE, 1, "trained", size)


def plot(growth: list[dict[str, Any]], path: Path) -> None:
    """Time of both passes against each axis, on logarithmic scales."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4), layout="constrained")
    labels = {"gaussians": "Gaussians (512 x 512, 1 view)", "views": "views (128 x 128, 32,768 Gaussians)"}
    names = list(dict.fromkeys(row["backend"] for row in growth))
    labels["size"] = "image side in pixels (32,768 Gaussians, 1 view)"
    for panel, axis in zip(figure.subplots(1, len(AXES), sharey=True), AXES, strict=True):
        along = [row for row in growth if row["axis"] == axis]
        for i, name in enumerate(names):
            points = [(row[axis], row["forward_backward_ms"]) for row in along if row["backend"] == name]
            if points:
                panel.plot(*zip(*points, strict=True), marker="o", color=f"C{i}", label=name)
        panel.set(xscale="log", yscale="log", xlabel=labels[axis])
        panel.set_xticks(sorted({row[axis] for row in along}), minor=False)
        panel.set_xticks([], minor=True)
        panel.xaxis.set_major_formatter(lambda value, _: f"{value:,.0f}")
        panel.grid(alpha=0.3)
    figure.axes[0].set_ylabel("forward + backward, ms")
    figure.axes[-1].legend(loc="upper left")  # its first workload is the smallest of all, which every backend takes
    figure.savefig(path, dpi=120)
