"""`completesplat bench rasterizers`: comparison of the backends in speed, growth and agreement."""

import logging
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any, Literal, TypedDict

from hydra.utils import instantiate
from lightning import LightningModule
from rich.console import Console

from completesplat.benchmarks.agreement import agreement_rows
from completesplat.benchmarks.printing import device_of, print_results
from completesplat.benchmarks.training_step import share
from completesplat.benchmarks.workloads import (
    DEFAULTS,
    OPACITIES,
    Backend,
    milliseconds,
    peak_megabytes,
    read_scene,
    splatter_scene,
)
from completesplat.commands import quieten
from completesplat.commands.protocol import write_json
from completesplat.errors import CompleteSplatError
from completesplat.files import atomic_path
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer, RenderingConstants
from completesplat.results.machine import machine
from completesplat.results.tables import Column, table
from completesplat.settings.schema import Positive

logger = logging.getLogger(__name__)


class Growth(TypedDict):
    """Settings for the growth of time with the workload: backends, and the largest number of Gaussians."""

    backends: Sequence[str]
    most_gaussians: Positive


class TrainingStep(TypedDict):
    """Settings for a training step: backends, size of the scenes, and Lightning's precision."""

    backends: Sequence[str]
    size: Positive
    batch: Positive
    targets: Positive
    precision: str


def run(
    scene: str | None, backends: Sequence[str], sizes: Sequence[Positive], views: Sequence[Positive], repeats: Positive,
    growth: Growth | Literal[False], training_step: TrainingStep | Literal[False],
    model: Mapping[str, Any], constants: Mapping[str, Any], out: Path,
) -> None:  # fmt: skip
    """Time the rasterizers, or compare them on a scene; write `rasterizers.json` and a plot, and print tables.

    Args:
        scene: a file for `read_scene`; only this scene is then rendered, and all other parts are skipped.
        backends: keys of `CLASSES`; those that do not work on this machine are skipped, with the reason.
        sizes, views: sides of the images in pixels and numbers of views; every pair is timed.
        repeats: number of timed calls of each backend.
        growth, training_step: settings of these parts; False skips them.
        model: config of the module whose steps are timed.
        constants: config of the `RenderingConstants` that all backends share.

    Raises:
        CompleteSplatError: the file or a backend does not exist.
    """
    compared = read_scene(Path(scene)) if scene else None
    shared = instantiate(constants)
    with Console(stderr=True).status("compiling") as status:
        working, absent = working_backends(backends, shared)

        def tick(text: str) -> None:
            status.update(f"timing {text}")

        if compared is not None:
            figures = _on_a_scene(str(scene), *compared, working, shared, repeats, tick)
        else:
            quieten()
            figures = {"rows": speed_rows(working, sizes, views, repeats, tick)}
            if growth:
                chosen = [backend for backend in working if backend.name in growth["backends"]]
                figures["growth"] = growth_rows(chosen, tick, growth["most_gaussians"])
            if training_step:
                figures["training_step"] = _step_rows(working, training_step, model, tick)
    results = {"machine": machine(), "not_measured": absent, **figures}
    write_json(out / "rasterizers.json", results)
    if results.get("growth"):
        plot(results["growth"], out / "rasterizers.png")
    show(results)


def _step_rows(
    backends: Sequence[Backend], settings: TrainingStep, model: Mapping[str, Any], tick: Callable[[str], None]
) -> list[dict[str, Any]]:
    size, batch, targets = settings["size"], settings["batch"], settings["targets"]

    def make_module(rasterizer: Rasterizer) -> LightningModule:
        module: LightningModule = instantiate(model, rasterizer=rasterizer, _convert_="all")
        return module

    rows = []
    for backend in (backend for backend in backends if backend.name in settings["backends"]):
        tick(f"a training step with {backend.name}")
        rows.append(share(backend, make_module, size, batch, targets, settings["precision"]))
    return rows


def _on_a_scene(
    file: str, gaussians: Gaussians, cameras: Cameras, defaults: Sequence[str], backends: Sequence[Backend],
    constants: RenderingConstants, repeats: int, tick: Callable[[str], None],
) -> dict[str, Any]:  # fmt: skip
    """Measure time and agreement of the backends on one scene; `defaults` names the arrays that its file lacks."""
    if defaults:
        values = ", ".join(f"{name}={DEFAULTS[name]}" for name in defaults)
        logger.info("%s has no %s: every Gaussian gets %s", file, ", ".join(defaults), values)
    views, (height, width) = cameras.intrinsics.shape[1], cameras.image_size
    tick(f"{gaussians.count} Gaussians in {views} views")
    workload = {"size": max(height, width), "gaussians": gaussians.count, "views": views, "opacity": "file"}
    timed = side_by_side(backends, gaussians, cameras, repeats)
    return {
        "rows": [{"backend": name} | workload | figures for name, figures in timed.items()],
        "scene": {"file": file, "height": height, "width": width, "defaults": defaults},
        "agreement": agreement_rows(backends, gaussians, cameras, constants, tick),
    }


# `gsplat_torch` is a baseline for this comparison; training cannot choose it.
CLASSES = {
    "reference": "completesplat.rasterizers.reference.ReferenceRasterizer",
    "gsplat_torch": "completesplat.benchmarks.gsplat_torch.GsplatTorchRasterizer",
    "tiled": "completesplat.rasterizers.tiled.TiledRasterizer",
    "cuda": "completesplat.rasterizers.cuda.CudaRasterizer",
}


def working_backends(names: Sequence[str], constants: RenderingConstants) -> tuple[list[Backend], dict[str, str]]:
    """Return the named backends that can render a small scene on this machine, and reasons for the others.

    Raises:
        CompleteSplatError: a name is not in `CLASSES`.
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


LONGEST_SECONDS = 4.0  # a backend that has run this long on a workload does not repeat it


def speed_rows(
    backends: Sequence[Backend], sizes: Sequence[int], views: Sequence[int], repeats: int, tick: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Return a row for each backend and workload (size, number of views, kind of opacities)."""
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
    """Return medians in ms of the forward pass and of both passes, and peak memory in MB; backends take turns.

    Memory is what a first rendering with its backward pass adds. Its time counts only if there is no other rendering.
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
PATIENCE_MS = 8e3  # a backend that took longer than this skips the next larger workload
REPEATS = 3


def growth_rows(backends: Sequence[Backend], tick: Callable[[str], None], most_gaussians: int) -> list[dict[str, Any]]:
    """Return a row for each backend and point of an axis, with opacities as after training.

    The axis of Gaussians has one image of 512 x 512, which many small or few large Gaussians cover alike, and at most
    `most_gaussians`. Views are of 128 x 128. The axis of sizes has one image of the same 32,768 Gaussians.
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
    """Plot the time of both passes against each axis, on logarithmic scales."""
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
    figure.axes[-1].legend(loc="upper left")  # its smallest workload is drawn by every backend
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=120)


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
# Keys in the results, titles, columns.
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
    """Print all parts of the results."""
    tables = []
    for key, title, columns in SECTIONS:
        rows = results.get(key, [])
        if rows:
            tables.append(table(title, columns, against_tiled(rows) if key in ("rows", "growth") else rows))
    print_results(results, device_of(results), tables)


def against_tiled(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add to rows how many times slower than `tiled` they are on the same workload, both passes together."""

    def workload(row: dict[str, Any]) -> tuple[Any, ...]:
        return tuple(row.get(key) for key in WORKLOAD)

    tiled = {workload(row): row["forward_backward_ms"] for row in rows if row["backend"] == "tiled"}
    ratios = [row["forward_backward_ms"] / tiled[workload(row)] if workload(row) in tiled else None for row in rows]
    return [row | {"times_tiled": ratio} for row, ratio in zip(rows, ratios, strict=True)]
