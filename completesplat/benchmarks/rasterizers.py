"""`completesplat bench rasterizers`: speed and memory of the backends."""

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from rich.console import Console

from completesplat.benchmarks.measuring import Row, report
from completesplat.benchmarks.workloads import OPACITIES, Backend, rendering_milliseconds, splatter_scene
from completesplat.commands import quieten
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.selection import FASTER, failure
from completesplat.settings.schema import Positive
from completesplat.training.steps import peak_megabytes

BACKENDS = {"reference": ReferenceRasterizer, **FASTER}
LONGEST_SECONDS = 4.0  # a backend that has run this long on a workload does not repeat it
OnProgress = Callable[[str], None]


def run(
    backends: Sequence[str], sizes: Sequence[Positive], views: Sequence[Positive], repeats: Positive,
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
        quieten()
        tick = lambda text: status.update(f"timing {text}")  # noqa: E731
        rows = speed_rows(working, sizes, views, repeats, tick)
    report(out / "rasterizers.json", {"not_measured": absent, "rows": rows}, {"Speed": rows})


def working_backends(names: Sequence[str], constants: RenderingConstants) -> tuple[list[Backend], dict[str, str]]:
    """Return the named backends that work on this machine, and reasons for the others (`selection.failure`).

    Raises:
        CompleteSplatError: a name is not in `BACKENDS`.
    """
    backends, absent = [], {}
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
    backends: Sequence[Backend], sizes: Sequence[int], views: Sequence[int], repeats: int, tick: OnProgress
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
