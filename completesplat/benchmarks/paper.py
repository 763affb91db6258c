"""The paper's figures of speed (one A100), beside what they are here."""

import gc
import statistics
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import torch
from rich.console import Console
from torch import Tensor, nn

from completesplat.benchmarks.diffusion import WARM_UP, Training, autocast, milliseconds
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.geometry.trajectories import orbit
from completesplat.results.tables import Column, table
from completesplat.scene import SceneBatch
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.training.scene_module import SceneModule


@dataclass(frozen=True)
class Figure:
    """A duration in ms: of the paper, on an A100, and what is aimed at on a newer GPU."""

    text: str
    paper_ms: float | None
    aim_ms: float | None

    def durations(self) -> dict[str, float | None]:
        """For the row of a table."""
        return {"paper_ms": self.paper_ms, "aim_ms": self.aim_ms}


FIGURES = {
    "reconstruct": Figure("encode and reconstruct a picture", 15.7, 5),  # Table 2, "Ours - AutoReconstructor"
    "sample": Figure("draw a sample", 2_700, 500),  # Table 2, "Ours - Diffusion single sample"
    "samples": Figure("draw all samples at once", 54_000, 2_000),  # Table 2, "20-best oracle"
    "render": Figure("render 100 views of a scene", 29.1, 5),  # Table 2; the paper does not say how many views
    "stage1_step": Figure("training step of stage 1", None, None),
    "stage2_step": Figure("training step of stage 2", 157, None),  # supplement: 1,100,000 steps in 2 days
}


@dataclass(frozen=True)
class Way:
    """How networks are computed.

    Args:
        compile: arguments of `torch.compile`; None leaves them as they are.
    """

    name: str
    precision: str
    compile: Mapping[str, Any] | None = None

    @property
    def graphs(self) -> bool:
        """Whether kernels are recorded and replayed as CUDA graphs."""
        return bool(self.compile)


WAYS = (
    Way("float32", "32-true"),
    Way("bfloat16", "bf16-mixed"),
    Way("bfloat16, compiled", "bf16-mixed", {}),
    Way("bfloat16, CUDA graphs", "bf16-mixed", {"mode": "reduce-overhead"}),
)


@contextmanager
def compiled(networks: list[nn.Module], way: Way) -> Iterator[None]:
    """Within the context, these networks are compiled on their first call."""
    before = [network._compiled_call_impl for network in networks]
    if way.compile is not None:
        torch.compiler.reset()
        for network in networks:
            network.compile(**way.compile)
    try:
        yield
    finally:
        for network, call in zip(networks, before, strict=True):
            network._compiled_call_impl = call


VIEWS = 100

Works = dict[str, Callable[[], object]]


def stage1(module: ReconstructionModule, scenes: SceneBatch, precision: str) -> Works:
    """Of the autoreconstructor: the first scene from its picture, its views, and an optimizer step on all scenes."""
    scene = scenes[:1]

    @torch.no_grad()
    def reconstruct() -> Gaussians:
        with autocast(scene.depth_range.device, precision):
            return module.eval().reconstruct(scene)

    gaussians = reconstruct().map(Tensor.float)
    cameras = orbit_cameras(scene.reference.cameras[0], gaussians)

    @torch.no_grad()
    def render() -> Tensor:
        return module.rasterizer(gaussians, cameras).color

    return {"reconstruct": reconstruct, "render": render, "stage1_step": _step(module, scenes, precision)}


def stage2(module: LatentDiffusion, scenes: SceneBatch, precision: str, samples: int) -> Works:
    """Of latent diffusion: samples of the first picture, and an optimizer step on all, encoded within the time."""
    scene = scenes[:1]
    parts = module.completesplat

    def draw(count: int) -> Gaussians:
        with autocast(scene.depth_range.device, precision):
            reference = scene.reference
            return parts.eval().generate(reference.images, reference.cameras, scene.depth_range, samples=count)

    return {
        "sample": lambda: draw(1),
        "samples": lambda: draw(samples),
        "stage2_step": _step(module, scenes, precision),
    }


def networks(module: ReconstructionModule | LatentDiffusion) -> list[nn.Module]:
    """What can be compiled: the parts that are called as a whole."""
    if isinstance(module, ReconstructionModule):
        return [module.model.get_submodule("encoder"), module.model.get_submodule("reconstructor")]
    parts = module.completesplat
    frozen = parts.autoreconstructor
    return [frozen.encoder, frozen.reconstructor, parts.conditioning, parts.denoiser]


def orbit_cameras(camera: Cameras, gaussians: Gaussians) -> Cameras:
    """Cameras around the scene: [1, VIEWS]."""
    pivot = gaussians.means[0].mean(0)
    up = pivot.new_tensor([0.0, -1.0, 0.0])
    return orbit(camera, pivot, up, VIEWS).map(lambda tensor: tensor[None])


def _step(module: SceneModule, scenes: SceneBatch, precision: str) -> Callable[[], None]:
    @cache
    def training() -> Training:  # its optimizer's memory is not wanted before
        return Training(module, precision)

    def step() -> None:
        module.train()
        training().step(scenes)

    return step


MEGABYTE = 1e6


def rows(
    way: Way, works: Mapping[str, Callable[[], object]], repeats: int, device: torch.device, tick: Callable[[str], None]
) -> list[dict[str, Any]]:
    """A row for each work: median ms, and on a GPU the most memory that torch held, weights included, in MB.

    What fails, for want of memory, say, has the reason in its row instead.
    """
    found = []
    for name, work in works.items():
        tick(f"{way.name}: {FIGURES[name].text}")
        row: dict[str, Any] = {"name": name, "way": way.name}
        try:
            found.append(row | _measured(work, repeats, device))
        except (RuntimeError, AssertionError) as error:  # both kinds come from torch's compiler, too
            first = (str(error).strip().splitlines() or [""])[0]
            found.append(row | {"not_measured": f"{type(error).__name__}: {first}"})
        gc.collect()
    return found


def _measured(work: Callable[[], object], repeats: int, device: torch.device) -> dict[str, Any]:
    on_gpu = device.type == "cuda"
    for _ in range(WARM_UP):
        work()
    if on_gpu:
        torch.cuda.reset_peak_memory_stats(device)
    times = [milliseconds(work, device) for _ in range(repeats)]
    memory = {"memory_mb": torch.cuda.max_memory_allocated(device) / MEGABYTE} if on_gpu else {}
    return {"ms": statistics.median(times), **memory}


COLUMNS: list[Column] = [
    ("", "text", ""),
    ("", "way", ""),
    ("ms", "ms", ",.1f"),
    ("paper, A100\nms", "paper_ms", ",.1f"),
    ("aim\nms", "aim_ms", ",.0f"),
    ("memory\nMB", "memory_mb", ",.0f"),
    ("", "not_measured", ""),
]


def show(results: dict[str, Any]) -> None:
    """Print all that there is in the results, the ways of one work next to each other."""
    machine, work = results["machine"], results["workload"]
    console = Console(width=None if Console().is_terminal else 140, markup=False)
    where = machine["gpu"] if work["device"] == "cuda" else f"{machine['processor']}, {machine['threads']} threads"
    console.print(f"{where}, torch {machine['torch']}, {machine['date']}")
    order = list(FIGURES)
    rows = sorted(results["rows"], key=lambda row: order.index(row["name"]))
    size = work["image_size"]
    drawn = f"{work['samples']} samples in {work['steps']} steps"
    title = f"{size} x {size} pixels, {drawn}, training batches of {work['batch']}"
    console.print(table(title, COLUMNS, [row | {"text": FIGURES[row["name"]].text} for row in rows]))
