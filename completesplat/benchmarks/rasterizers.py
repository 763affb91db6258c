"""The rasterizers side by side: speed, growth, agreement on a large scene."""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from rich.console import Console
from torch import Tensor

from completesplat.benchmarks.workloads import OPACITIES, milliseconds, peak_megabytes, splatter_scene
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer, RenderingConstants
from completesplat.rasterizers.reference import (
    ReferenceRasterizer,
    alphas_at,
    project_gaussians,
    visible_in_depth_order,
)
from completesplat.results.tables import Column, table

# `torch_tiled` and `gsplat_torch` are baselines: kept for this comparison, not to be chosen for training.
CLASSES = {
    "reference": "completesplat.rasterizers.reference.ReferenceRasterizer",
    "torch_tiled": "completesplat.benchmarks.torch_tiled.TorchTiledRasterizer",
    "gsplat_torch": "completesplat.benchmarks.gsplat_torch.GsplatTorchRasterizer",
    "tiled": "completesplat.rasterizers.tiled.TiledRasterizer",
    "cuda": "completesplat.rasterizers.cuda.CudaRasterizer",
}
MOST_REFERENCE_PAIRS = 2**28  # of a Gaussian and a pixel: the reference takes a second for a tenth of them


@dataclass(frozen=True)
class Backend:
    """A rasterizer, its name in the tables, and where it takes its tensors."""

    name: str
    rasterizer: Rasterizer

    @property
    def device(self) -> str:
        return "cuda" if self.name == "cuda" else "cpu"

    def takes(self, gaussians: int, pixels: int) -> bool:
        """Whether a workload with this many pixels in all views is not hopelessly large for it."""
        return self.name != "reference" or gaussians * pixels <= MOST_REFERENCE_PAIRS


def working_backends(names: Sequence[str], constants: RenderingConstants) -> tuple[list[Backend], dict[str, str]]:
    """Those of the named backends that render a small scene here, and for each of the others the reason why not.

    Raises:
        CompleteSplatError: a name that is not in `CLASSES`.
    """
    for name in names:
        if name not in CLASSES:
            raise CompleteSplatError(f"there is no backend {name!r} to time; there are {', '.join(CLASSES)}")
    backends, absent = [], {}
    for name in names:
        module, _, class_name = CLASSES[name].rpartition(".")
        try:
            backend = Backend(name, getattr(import_module(module), class_name)(constants))
            gaussians, cameras = splatter_scene(8, 1, "trained")
            milliseconds(backend.rasterizer, gaussians.to(backend.device), cameras.to(backend.device))  # compiles
        except Exception as error:  # a broken installation may raise anything
            absent[name] = " ".join(str(error).split()) or type(error).__name__
        else:
            backends.append(backend)
    return backends, absent


LONGEST_SECONDS = 4.0  # a backend that has taken this long on a workload is not run again on it


def speed_rows(
    backends: Sequence[Backend], sizes: Sequence[int], views: Sequence[int], repeats: int, tick: Callable[[str], None]
) -> list[dict[str, Any]]:
    """One row for each backend and workload (size, number of views, kind of opacities)."""
    result = []
    for size, number, opacity in product(sizes, views, OPACITIES):
        tick(f"{size} x {size}, {number} views, {opacity}")
        gaussians, cameras = splatter_scene(size, number, opacity)
        workload = {"size": size, "gaussians": gaussians.count, "views": number, "opacity": opacity}
        figures = side_by_side(backends, gaussians, cameras, repeats)
        result += [{"backend": name} | workload | figure for name, figure in figures.items()]
    return result


def side_by_side(
    backends: Sequence[Backend], gaussians: Gaussians, cameras: Cameras, repeats: int
) -> dict[str, dict[str, Any]]:
    """Medians in ms of the forward pass and of both passes, the backends taking turns, and the peak of memory in MB.

    Memory is what a first rendering with its backward pass adds. That one is timed only where it is the only one.
    """
    pixels = cameras.image_size[0] * cameras.image_size[1] * cameras.intrinsics.shape[1]
    backends = [backend for backend in backends if backend.takes(gaussians.count, pixels)]
    times: dict[str, list[tuple[float, float]]] = {}
    peaks, spent = {}, {}
    for backend in backends:
        inputs = (backend.rasterizer, gaussians.to(backend.device), cameras.to(backend.device))
        first: list[tuple[float, float]] = []
        start = time.perf_counter()
        peaks[backend.name] = peak_megabytes(lambda: first.append(milliseconds(*inputs)), backend.device)  # noqa: B023
        spent[backend.name] = time.perf_counter() - start
        times[backend.name] = first if spent[backend.name] > LONGEST_SECONDS else []
    for _, backend in product(range(repeats), backends):
        if spent[backend.name] > LONGEST_SECONDS:
            continue
        start = time.perf_counter()
        inputs = (backend.rasterizer, gaussians.to(backend.device), cameras.to(backend.device))
        times[backend.name].append(milliseconds(*inputs))
        spent[backend.name] += time.perf_counter() - start
    return {name: _medians(taken) | {"peak_mb": peaks[name]} for name, taken in times.items()}


def _medians(times: list[tuple[float, float]]) -> dict[str, float]:
    forward, both = (statistics.median(column) for column in zip(*times, strict=True))
    return {"forward_ms": forward, "forward_backward_ms": both}


AXES = ("gaussians", "views", "size")
SOURCE_SIZES = (23, 72, 229, 724)  # two Gaussians to a pixel of the source: 1k, 10k, 105k and 1M
IMAGE_SIZE, SOURCE_SIZE = 512, 128
VIEWS = (1, 2, 4, 8, 16)
IMAGE_SIZES = (64, 128, 256, 512)
PATIENCE_MS = 8e3  # a backend that took longer than this is not tried on the next larger workload
REPEATS = 3


def growth_rows(backends: Sequence[Backend], tick: Callable[[str], None], most_gaussians: int) -> list[dict[str, Any]]:
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


# `tiled` projects and sorts in float64, like the reference. The others do so in float32: in a large scene some
# neighbours in depth then change places.
TOLERANCE, FLOAT32_TOLERANCE = {"tiled": 1e-5}, 1e-4
PIXELS_PER_VIEW, PIXELS_AT_ONCE = 128, 8
# Where an alpha is this close to its threshold, or a transmittance to the stop (relatively), float32 may decide
# otherwise than float64, rightly so. Such pixels are counted, not compared.
BAND, STOP_BAND = 1e-4, 1e-3


def agreement_rows(
    backends: Sequence[Backend], gaussians: Gaussians, cameras: Cameras, constants: RenderingConstants,
    tick: Callable[[str], None],
) -> list[dict[str, Any]]:  # fmt: skip
    """For each backend the largest errors over the sampled pixels of all views of one scene (batch of 1).

    `color` and `alpha` are absolute, `depth` is relative to the largest depth of the sample; `pixels` of them were
    compared, `undecided` left out. `agrees` says whether all three are within the backend's tolerance; one that is not
    finite is None, and does not agree.
    """
    scene, seen = gaussians[0].to(torch.float64), cameras[0].to(torch.float64)
    views, (height, width) = len(seen.intrinsics), cameras.image_size
    generator = torch.Generator().manual_seed(0)
    positions = torch.randint(height * width, (views, PIXELS_PER_VIEW), generator=generator)
    exact, decided = [], []
    for view in range(views):
        tick(f"reference at {PIXELS_PER_VIEW} pixels of view {view}")
        pixels = (torch.stack([positions[view] % width, positions[view] // width], dim=-1) + 0.5).double()
        exact.append(ReferenceRasterizer(constants).at_pixels(scene, seen[view], pixels))
        decided.append(is_decided(scene, seen[view], pixels, constants))
    expected, mask = torch.stack(exact), torch.stack(decided)
    scale = torch.ones(5).index_fill(0, torch.tensor(3), expected[..., 3].max().item() or 1.0)
    result = []
    for backend in backends:
        if backend.name == "reference":
            continue
        tick(backend.name)
        errors = ((draw_at(backend, gaussians, cameras, positions) - expected).abs() / scale)[mask]
        largest = errors.amax(0) if len(errors) else torch.full((5,), torch.nan)
        figures = {"color": largest[:3].max().item(), "depth": largest[3].item(), "alpha": largest[4].item()}
        agrees = bool((largest <= TOLERANCE.get(backend.name, FLOAT32_TOLERANCE)).all())
        counts = {"pixels": int(mask.sum()), "undecided": int((~mask).sum())}
        finite = {name: error if math.isfinite(error) else None for name, error in figures.items()}
        result.append({"backend": backend.name, **finite, "agrees": agrees, **counts})
    return result


@torch.no_grad()
def draw_at(
    backend: Backend, gaussians: Gaussians, cameras: Cameras, positions: Int[Tensor, "view pixel"]
) -> Float[Tensor, "view pixel 5"]:
    """Red, green, blue, depth and alpha of one scene at these positions (row-major) of each view's image."""
    rendering = backend.rasterizer(gaussians.to(backend.device), cameras.to(backend.device)).to("cpu")[0]
    images = torch.cat([rendering.color, rendering.depth, rendering.alpha], dim=1).flatten(-2)
    return images.gather(-1, positions[:, None].expand(-1, 5, -1)).mT


@torch.no_grad()
def is_decided(
    gaussians: Gaussians, camera: Cameras, pixels: Float[Tensor, "pixel 2"], constants: RenderingConstants
) -> Bool[Tensor, " pixel"]:
    """Which pixels keep clear of the steps of the function: no decision there hangs on rounding."""
    visible, order = visible_in_depth_order(gaussians, camera, constants)
    chosen = gaussians[visible][order]
    centers, _, covariances = project_gaussians(chosen, camera, constants)
    marks = []
    for chunk in pixels.split(PIXELS_AT_ONCE):
        alphas = alphas_at(chunk, centers, covariances, chosen.opacities, replace(constants, min_alpha=0.0))
        drawn = torch.where(alphas >= constants.min_alpha, alphas, 0)
        behind = torch.cumprod(1 - drawn, dim=0)
        steps = (alphas / constants.min_alpha - 1).abs() < BAND
        steps |= (behind / constants.min_transmittance - 1).abs() < STOP_BAND
        marks.append(~steps.any(0))
    return torch.cat(marks)


SPEED: list[Column] = [
    ("backend", "backend", ""),
    ("size", "size", ""),
    ("Gaussians", "gaussians", ","),
    ("views", "views", ""),
    ("opacity", "opacity", ""),
    ("forward\nms", "forward_ms", ",.1f"),
    ("with backward\nms", "forward_backward_ms", ",.1f"),
    ("times\ntiled", "times_tiled", ",.1f"),
    ("peak\nMB", "peak_mb", ",.0f"),
]
GROWTH: list[Column] = [("along", "axis", ""), *(column for column in SPEED if column[1] != "opacity")]
STEP: list[Column] = [
    ("backend", "backend", ""),
    ("size", "size", ""),
    ("batch", "batch", ""),
    ("views", "views", ""),
    ("step\nms", "step_ms", ",.0f"),
    ("rasterizer\nms", "rasterizer_ms", ",.1f"),
    ("share", "share", ".1%"),
]
AGREEMENT: list[Column] = [
    ("backend", "backend", ""),
    ("agrees", "agrees", ""),
    ("colour", "color", ".1e"),
    ("depth", "depth", ".1e"),
    ("alpha", "alpha", ".1e"),
    ("pixels\ncompared", "pixels", ""),
    ("left out", "undecided", ""),
]
# Key in the results, title, columns.
SECTIONS = [
    ("rows", "Speed", SPEED),
    ("growth", "Growth", GROWTH),
    ("training_step", "Share of a training step", STEP),
    (
        "agreement",
        "Largest differences from the float64 reference (colour and alpha absolute, depth relative)",
        AGREEMENT,
    ),
]
WORKLOAD = ("axis", "size", "gaussians", "views", "opacity")


def show(results: dict[str, Any]) -> None:
    """Print all that there is in the results."""
    machine = results["machine"]
    # No markup: a reason may hold brackets, `pip install "completesplat[cuda]"` for one.
    console = Console(width=None if Console().is_terminal else 120, markup=False)
    console.print(f"{machine['processor']}, {machine['threads']} threads, torch {machine['torch']}, {machine['date']}")
    for key, title, columns in SECTIONS:
        rows = results.get(key, [])
        if rows:
            compared = against_tiled(rows) if key in ("rows", "growth") else rows
            console.print(table(title, columns, compared))
    for name, reason in results["not_measured"].items():
        console.print(f"{name}: not measured, because {reason}")


def against_tiled(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The rows with how many times slower than `tiled` on the same workload they are, forward and backward."""

    def workload(row: dict[str, Any]) -> tuple[Any, ...]:
        return tuple(row.get(key) for key in WORKLOAD)

    tiled = {workload(row): row["forward_backward_ms"] for row in rows if row["backend"] == "tiled"}
    ratios = [row["forward_backward_ms"] / tiled[workload(row)] if workload(row) in tiled else None for row in rows]
    return [row | {"times_tiled": ratio} for row, ratio in zip(rows, ratios, strict=True)]
