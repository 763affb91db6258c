"""`completesplat bench rasterizers`: speed and memory of the backends on scenes like splatter images."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from hydra.utils import instantiate
from rich.console import Console

from completesplat.commands import quieten
from completesplat.errors import CompleteSplatError
from completesplat.evaluation.provenance import machine
from completesplat.evaluation.scorer import synchronized_time
from completesplat.evaluation.table_writers import show
from completesplat.evaluation.tables import records_table
from completesplat.files import write_json
from completesplat.gaussians import Gaussians, merge_gaussians
from completesplat.geometry.cameras import Cameras, pinhole, pixel_centers, unproject
from completesplat.quantities import Entries, Positive
from completesplat.rasterizers import Rasterizer, RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.selection import FASTER, failure
from completesplat.training.steps import DISTANCE, FOV_DEGREES, cameras_on_orbit, peak_megabytes

Row = dict[str, object]  # of the table; its values can be written as JSON
Sizes = Annotated[Sequence[Positive], Entries(1)]

BACKENDS = {"reference": ReferenceRasterizer, **FASTER}
LONGEST_SECONDS = 4.0  # a backend that has run this long on a workload does not repeat it
OPACITIES = ("trained", "initial")
MOST_REFERENCE_PAIRS = 2**28  # of a Gaussian and a pixel; the reference takes a second for a tenth of them


class Backend(NamedTuple):
    """A rasterizer, its name in the tables, and the device of its tensors."""

    name: str
    rasterizer: Rasterizer

    @property
    def device(self) -> torch.device:
        return torch.device("cuda" if self.name == "cuda" else "cpu")

    def takes(self, gaussians: int, pixels: int) -> bool:
        """Return whether a workload with this many pixels in all views is feasible."""
        return self.name != "reference" or gaussians * pixels <= MOST_REFERENCE_PAIRS


def run(
    backends: Annotated[Sequence[str], Entries(1)], sizes: Sizes, views: Sizes, repeats: Positive,
    constants: Mapping[str, object], out: Path,
) -> None:  # fmt: skip
    """Time the rasterizers, write `rasterizers.json`, and print tables.

    `conf/bench_task/rasterizers.yaml` explains the settings. Every combination of sizes and numbers of views is timed.

    Raises:
        CompleteSplatError: a backend does not exist.
    """
    with Console(stderr=True).status("compiling") as status:
        shared = instantiate(constants)
        working, absent = working_backends(backends, shared)
        if not working:
            raise CompleteSplatError("; ".join(f"{name}: not measured, because {why}" for name, why in absent.items()))
        quieten()
        tick = lambda text: status.update(f"timing {text}")  # noqa: E731
        rows = speed_rows(working, sizes, views, repeats, tick)
    here = machine()
    write_json(out / "rasterizers.json", {"machine": here, "not_measured": absent, "rows": rows})
    print(f"{here['processor']}, {here['threads']} threads, torch {here['torch']}, {here['date']}")
    show(records_table("Speed", rows), width=140)
    for name, reason in absent.items():
        print(f"{name}: not measured, because {reason}")


def working_backends(names: Sequence[str], constants: RenderingConstants) -> tuple[list[Backend], dict[str, str]]:
    """Return the named backends that work on this machine, and reasons for the others (`selection.failure`).

    Raises:
        CompleteSplatError: a name is not in `BACKENDS`.
    """
    backends = []
    absent = {}
    for name in names:
        if name not in BACKENDS:
            raise CompleteSplatError(f"backends: {name!r} does not exist; choose from {', '.join(BACKENDS)}")
        reason = failure(name, constants) if name in FASTER else None
        if reason is None:
            backends.append(Backend(name, BACKENDS[name](constants)))
        else:
            absent[name] = " ".join(reason.split())
    return backends, absent


def speed_rows(
    backends: Sequence[Backend], sizes: Sequence[int], views: Sequence[int], repeats: int, tick: Callable[[str], None]
) -> list[Row]:
    """Return a row for each backend and workload (size, number of views, kind of opacities)."""
    rows: list[Row] = []
    for size, number, opacity in product(sizes, views, OPACITIES):
        tick(f"{size} x {size}, {number} views, {opacity}")
        gaussians, cameras = splatter_scene(size, number, opacity)
        workload: Row = {"size": size, "gaussians": gaussians.count, "views": number, "opacity": opacity}
        results = side_by_side(backends, gaussians, cameras, repeats)
        for name, figures in results.items():
            rows.append({"backend": name} | workload | figures)
            if "tiled" in results:
                rows[-1]["times_tiled"] = figures["forward_backward_ms"] / results["tiled"]["forward_backward_ms"]
    return rows


def side_by_side(
    backends: Sequence[Backend], gaussians: Gaussians, cameras: Cameras, repeats: int
) -> dict[str, dict[str, Any]]:
    """Time the backends in turn; return median ms of the forward pass and of both passes, and the peak memory in MB.

    The memory is that of the first rendering with its backward pass, whose time counts only if there is no other.
    """
    pixels = cameras.image_size[0] * cameras.image_size[1] * cameras.intrinsics.shape[1]
    backends = [backend for backend in backends if backend.takes(gaussians.count, pixels)]
    times: dict[str, list[tuple[float, float]]] = {backend.name: [] for backend in backends}
    spent = dict.fromkeys(times, 0.0)

    def render(backend: Backend) -> None:
        start = time.perf_counter()
        inputs = gaussians.to(backend.device), cameras.to(backend.device)
        times[backend.name].append(rendering_milliseconds(backend.rasterizer, *inputs))
        spent[backend.name] += time.perf_counter() - start

    peaks = {backend.name: peak_megabytes(lambda: render(backend), backend.device) for backend in backends}  # noqa: B023
    for _, backend in product(range(repeats), backends):
        if spent[backend.name] <= LONGEST_SECONDS:
            render(backend)
    results: dict[str, dict[str, Any]] = {}
    for name, pairs in times.items():
        forward, both = (statistics.median(column) for column in zip(*(pairs[1:] or pairs), strict=True))
        results[name] = {"forward_ms": forward, "forward_backward_ms": both, "peak_mb": peaks[name]}
    return results


def splatter_scene(size: int, views: int, opacity: str) -> tuple[Gaussians, Cameras]:
    """Return a scene (batch of 1) with two layers of one Gaussian per pixel, and cameras on an orbit about it.

    Opacities are as after training ("trained": a dense object, where pixels are soon opaque, before a thin background)
    or as at its start ("initial": all low, so that every Gaussian counts).
    """
    generator = torch.Generator().manual_seed(0)
    source = Cameras(torch.eye(4), pinhole(FOV_DEGREES, size), (size, size))
    layers = [_layer(layer, source, opacity, generator) for layer in range(2)]
    return merge_gaussians(layers)[None], cameras_on_orbit(size, views)


def _layer(layer: int, source: Cameras, opacity: str, generator: torch.Generator) -> Gaussians:
    """Return the front (0) or the back (1) of an ellipsoid, and a piece of background further away."""
    size = source.image_size[0]
    pixels = pixel_centers(size, size).flatten(0, 1)
    x, y = (pixels / size * 2 - 1).unbind(-1)
    radius = (x / 0.75).square() + (y / 0.8).square()
    bulge = 0.75 * (1 - radius).clamp(min=0).sqrt() * (1 if layer else -1)
    depth = DISTANCE + torch.where(radius < 1, bulge, 0.3 + 0.3 * layer)
    pixel_width = depth / source.intrinsics[0, 0]
    spread = 1.0 + layer if opacity == "trained" else 1.5  # standard deviation, in pixels
    noise = torch.randn(size * size, 9, generator=generator)
    uniform = torch.rand(size * size, generator=generator)
    trained = torch.where(radius < 1, (0.1 if layer else 0.55) + 0.44 * uniform, 0.02 + 0.3 * uniform**3)
    return Gaussians(
        means=unproject(source, pixels + 0.25 * noise[:, :2], depth),
        quaternions=torch.tensor([1.0, 0, 0, 0]) + 0.5 * noise[:, 2:6],
        scales=(spread * pixel_width)[:, None] * torch.exp(0.4 * noise[:, 6:]),
        opacities=trained if opacity == "trained" else 0.1 + 0.2 * uniform,
        colors=torch.stack([x, y, x * y], dim=-1).mul(3 + layer).sin() / 2 + 0.5,
    )


def rendering_milliseconds(rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras) -> tuple[float, float]:
    """Return the times of the forward pass, and of both passes with gradients to all parameters of the Gaussians."""
    gaussians = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    # NumPy, because torch would wake its own threads, which then spin for a while on the cores that are timed.
    shapes = [(*cameras.intrinsics.shape[:2], channels, *cameras.image_size) for channels in (3, 1, 1)]
    ones = [torch.from_numpy(np.ones(shape, np.float32)).to(cameras.intrinsics.device) for shape in shapes]
    start = synchronized_time()
    rendering = rasterizer(gaussians, cameras)
    middle = synchronized_time()
    torch.autograd.backward([rendering.color, rendering.depth, rendering.alpha], ones)
    return (middle - start) * 1e3, (synchronized_time() - start) * 1e3
