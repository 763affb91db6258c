"""`completesplat bench paper`: our durations beside those that the paper states for an A100."""

import gc
import statistics
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import torch
from hydra.utils import instantiate
from rich.console import Console
from torch import Tensor, nn

from completesplat.benchmarks.diffusion import WARM_UP, Training, autocast, milliseconds
from completesplat.benchmarks.printing import device_of, print_results
from completesplat.commands import quieten
from completesplat.commands.protocol import write_json
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.geometry.trajectories import orbit
from completesplat.results.machine import machine
from completesplat.results.tables import Column, table
from completesplat.scene import SceneBatch
from completesplat.settings.schema import Positive
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.training.stage import Stage


@dataclass(frozen=True)
class Figure:
    """Durations in ms of one kind of work: the paper's on an A100, and our aim on a newer GPU."""

    text: str
    paper_ms: float | None
    aim_ms: float | None

    def durations(self) -> dict[str, float | None]:
        """Return both durations by their columns of the table."""
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
    """A way of computing networks: precision and compilation.

    Args:
        compile: arguments of `torch.compile`; None does not compile.
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


Works = dict[str, Callable[[], object]]

# The paper's durations are shown beside ours only for the same work.
PAPERS_WORK = {"image_size": 128, "batch": 32, "samples": 20, "steps": 50}
PAPERS_CHANNELS = {"encoder": [128, 256, 512, 512], "denoiser": [320, 640, 1280, 1280]}


def run(
    data: Mapping[str, Any],
    stage1: Mapping[str, Any],
    stage2: Mapping[str, Any],
    steps: Positive,
    device: Literal["cuda", "cpu"],
    repeats: Positive,
    samples: Positive,
    compile: bool,
    training: bool,
    channels: Mapping[str, Sequence[int]],
    seed: int,
    out: Path,
) -> None:
    """Measure with random weights, write `paper.json`, and print a table.

    Args:
        data, stage1, stage2: configs of the data module and of both stages' modules.
        steps: number of steps of the sampler.
        repeats: number of timed calls of each kind of work.
        samples: number of samples that are drawn of one image at once.
        compile: whether to measure with `torch.compile` and with CUDA graphs as well.
        training: whether to measure optimizer steps of both stages as well.
        channels: channels of the `encoder` and the `denoiser`, which tell whether the work is the paper's.

    Raises:
        CompleteSplatError: there is no GPU.
    """
    _refuse_missing_gpu(device)
    stages: dict[str, tuple[Mapping[str, Any], Callable[..., Works]]]
    stages = {"stage1": (stage1, stage1_works), "stage2": (stage2, partial(stage2_works, samples=samples))}
    ways = [way for way in WAYS if compile or way.compile is None]
    quieten()
    measured = []
    with (
        TemporaryDirectory(prefix="bench_paper_", dir=out) as folder,
        Console(stderr=True).status("building") as status,
    ):
        measure = partial(rows, repeats=repeats, tick=lambda text: status.update(f"timing {text}"))
        scenes = _first_batch(data, folder).to(torch.device(device))
        # One stage after the other, so that the memory of one is not counted for the other.
        for name, (config, works) in stages.items():
            torch.manual_seed(seed)
            module = instantiate(config, _convert_="all").to(device)
            measured += _rows_of_stage(name, module, ways, partial(works, module, scenes), training, measure)
    work = {"image_size": data["image_size"], "batch": data["batch_size"], "samples": samples, "steps": steps}
    measured = _beside_the_papers(measured) if is_as_in_the_paper(work, channels) else measured
    results = {"machine": machine(), "workload": {"device": device, **work, "repeats": repeats}, "rows": measured}
    write_json(out / "paper.json", results)
    show(results)


def _refuse_missing_gpu(device: str) -> None:
    """Raise an error if the device is "cuda" and there is no GPU."""
    if device == "cuda" and not torch.cuda.is_available():
        raise CompleteSplatError(
            "the paper's figures are a GPU's, and there is none here: device=cpu measures all the same, "
            "autoreconstructor=tiny conditioning=learned denoiser=tiny in minutes"
        )


def _beside_the_papers(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Add the paper's durations to rows."""
    return [FIGURES[row["name"]].durations() | row for row in rows]


def _first_batch(data: Mapping[str, Any], folder: str) -> SceneBatch:
    """Make scenes in a folder, and return their first training batch."""
    module = instantiate(data, root=f"{folder}/scenes", _convert_="all")
    module.prepare_data()
    batch: SceneBatch = next(iter(module.train_dataloader()))
    return batch


def _rows_of_stage(
    name: str,
    module: ReconstructionModule | LatentDiffusion,
    ways: Sequence[Way],
    works: Callable[..., Works],
    training: bool,
    measure: Callable[..., list[dict[str, Any]]],
) -> list[dict[str, Any]]:
    """Measure a stage in each way; leave out optimizer steps with CUDA graphs, which do not go together.

    `works` makes the stage's kinds of work for a precision, and `measure` returns the rows of a way and its work.
    """
    measured = []
    for way in ways:
        with compiled(networks(module), way):
            pieces = works(precision=way.precision)
            if not training or way.graphs:
                del pieces[f"{name}_step"]
            measured += measure(way, pieces, device=module.device)
    return measured


def is_as_in_the_paper(work: Mapping[str, int], channels: Mapping[str, Sequence[int]]) -> bool:
    """Return whether the paper's durations belong to the same work, so that they can stand beside ours."""
    return dict(work) == PAPERS_WORK and dict(channels) == PAPERS_CHANNELS


@contextmanager
def compiled(networks: list[nn.Module], way: Way) -> Iterator[None]:
    """Within the context, let these networks compile on their first call."""
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


def stage1_works(module: ReconstructionModule, scenes: SceneBatch, precision: str) -> Works:
    """Return the work of stage 1: reconstruct the first scene from its image, render it, train on all scenes."""
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


def stage2_works(module: LatentDiffusion, scenes: SceneBatch, precision: str, samples: int) -> Works:
    """Return the work of stage 2: draw samples of the first image, train on all scenes (encoded in this time)."""
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
    """Return the parts that are called as a whole, which can be compiled."""
    if isinstance(module, ReconstructionModule):
        return [module.model.get_submodule("encoder"), module.model.get_submodule("reconstructor")]
    parts = module.completesplat
    frozen = parts.autoreconstructor
    return [frozen.encoder, frozen.reconstructor, parts.conditioning, parts.denoiser]


def orbit_cameras(camera: Cameras, gaussians: Gaussians) -> Cameras:
    """Return cameras around the scene, [1, VIEWS]."""
    pivot = gaussians.means[0].mean(0)
    up = pivot.new_tensor([0.0, -1.0, 0.0])
    return orbit(camera, pivot, up, VIEWS).map(lambda tensor: tensor[None])


def _step(module: Stage, scenes: SceneBatch, precision: str) -> Callable[[], None]:
    @cache
    def training() -> Training:  # made late, because its optimizer needs memory
        return Training(module, precision)

    def step() -> None:
        module.train()
        training().step(scenes)

    return step


MEGABYTE = 1e6


def rows(
    way: Way, works: Mapping[str, Callable[[], object]], repeats: int, device: torch.device, tick: Callable[[str], None]
) -> list[dict[str, Any]]:
    """Return a row for each kind of work: median ms and, on a GPU, torch's peak memory in MB, weights included.

    If some work fails, for example because memory is short, its row has the reason instead.
    """
    results = []
    for name, work in works.items():
        tick(f"{way.name}: {FIGURES[name].text}")
        row: dict[str, Any] = {"name": name, "way": way.name}
        try:
            results.append(row | _measured(work, repeats, device))
        except (RuntimeError, AssertionError) as error:  # torch's compiler raises both kinds, too
            first = (str(error).strip().splitlines() or [""])[0]
            results.append(row | {"not_measured": f"{type(error).__name__}: {first}"})
        gc.collect()
    return results


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
    """Print the results, with the ways of doing one kind of work next to each other."""
    work = results["workload"]
    order = list(FIGURES)
    rows = sorted(results["rows"], key=lambda row: order.index(row["name"]))
    size = work["image_size"]
    drawn = f"{work['samples']} samples in {work['steps']} steps"
    title = f"{size} x {size} pixels, {drawn}, training batches of {work['batch']}"
    durations = table(title, COLUMNS, [row | {"text": FIGURES[row["name"]].text} for row in rows])
    print_results(results, device_of(results), [durations], width=140)
