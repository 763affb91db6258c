"""`completesplat bench paper`: our durations beside the paper's on an A100."""

import gc
import statistics
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal, NamedTuple

import torch
from hydra.utils import instantiate
from rich.console import Console
from torch import Tensor, nn

from completesplat.benchmarks.measuring import WARM_UP, Row, Work, milliseconds, report
from completesplat.commands import quieten
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.trajectories import orbit
from completesplat.quantities import Natural, Positive
from completesplat.scene import SceneBatch
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.training.stage import Stage
from completesplat.training.steps import Training, autocast

VIEWS = 100


class Duration(NamedTuple):
    """Durations in ms of one kind of work: the paper's on an A100, and our aim on a newer GPU."""

    text: str
    paper_ms: float | None
    aim_ms: float | None


FIGURES = {
    "reconstruct": Duration("encode and reconstruct an image", 15.7, 5),  # Table 2, "Ours - AutoReconstructor"
    "sample": Duration("draw a sample", 2_700, 500),  # Table 2, "Ours - Diffusion single sample"
    "samples": Duration("draw all samples at once", 54_000, 2_000),  # Table 2, "20-best oracle"
    "render": Duration("render 100 views of a scene", 29.1, 5),  # Table 2; the paper does not say how many views
    "stage1_step": Duration("training step of stage 1", None, None),
    "stage2_step": Duration("training step of stage 2", 157, None),  # supplement: 1,100,000 steps in 2 days
}
# The paper's durations are shown beside ours only for the same work.
PAPERS_WORK = {"image_size": 128, "batch": 32, "samples": 20, "steps": 50}
PAPERS_CHANNELS = {"encoder": [128, 256, 512, 512], "denoiser": [320, 640, 1280, 1280]}


class ComputeMode(NamedTuple):
    """Precision of the networks and mode of `torch.compile`; None does not compile them."""

    name: str
    precision: str
    compile: Literal["default", "reduce-overhead"] | None = None  # the latter records CUDA graphs


COMPUTE_MODES = (
    ComputeMode("float32", "32-true"),
    ComputeMode("bfloat16", "bf16-mixed"),
    ComputeMode("bfloat16, compiled", "bf16-mixed", "default"),
    ComputeMode("bfloat16, CUDA graphs", "bf16-mixed", "reduce-overhead"),
)


def run(
    data: Mapping[str, object], stage1: Mapping[str, object], stage2: Mapping[str, object], steps: Positive,
    device: Literal["cuda", "cpu"], repeats: Positive, samples: Positive, compile: bool, training: bool, busy: Natural,
    channels: Mapping[str, Sequence[int]], seed: int, out: Path,
) -> None:  # fmt: skip
    """Measure with random weights, write `paper.json`, and print a table.

    `conf/bench_task/paper.yaml` explains the settings; `channels` are compared with the paper's.

    Raises:
        CompleteSplatError: there is no GPU.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise CompleteSplatError(
            "device=cuda: no GPU is available; measure with device=cpu, which takes minutes with "
            "autoreconstructor=tiny conditioning=learned denoiser=tiny"
        )
    ways = [way for way in COMPUTE_MODES if compile or way.compile is None]
    quieten()
    rows: list[Row] = []
    with TemporaryDirectory(prefix="bench_", dir=out) as folder, Console(stderr=True).status("building") as status:
        loaded: SceneDataModule = instantiate(data, root=f"{folder}/scenes", _convert_="all")
        loaded.prepare_data()
        scenes: SceneBatch = next(iter(loaded.train_dataloader())).to(torch.device(device))
        # One stage after the other, so that the memory of one is not counted for the other.
        for config in (stage1, stage2):
            for way in ways:
                status.update(f"timing {way.name}")
                torch.manual_seed(seed)
                module: Stage = instantiate(config, _convert_="all").to(device)
                rows += rows_of(module, scenes, way, samples, training, repeats, busy)
                del module
    work = {"image_size": loaded.image_size, "batch": loaded.batch_size, "samples": samples, "steps": steps}
    if is_as_in_the_paper(work, channels):
        rows = [row | {"paper_ms": figure.paper_ms, "aim_ms": figure.aim_ms} for figure, row in _with_figures(rows)]
    results = {"workload": {"device": device, **work, "repeats": repeats}, "rows": rows}
    title = "{image_size} x {image_size} pixels, {samples} samples in {steps} steps, training batches of {batch}"
    named = [row | {"name": figure.text} for figure, row in _with_figures(rows)]
    report(out / "paper.json", results, {title.format(**work): named}, device)


def _with_figures(rows: Sequence[Row]) -> list[tuple[Duration, Row]]:
    """Return each row with its figure; the ways of doing one kind of work stand next to each other."""
    return [(figure, row) for name, figure in FIGURES.items() for row in rows if row["name"] == name]


def is_as_in_the_paper(work: Mapping[str, int], channels: Mapping[str, Sequence[int]]) -> bool:
    """Return whether the paper's durations belong to the same work, so that they can stand beside ours."""
    return dict(work) == PAPERS_WORK and dict(channels) == PAPERS_CHANNELS


def rows_of(
    module: Stage, scenes: SceneBatch, way: ComputeMode, samples: int, training: bool, repeats: int, busy: int = 0
) -> list[Row]:
    """Return a row for each kind of work: median ms and, on a GPU, torch's peak memory in MB, weights included.

    If some work fails, for example because memory is short, its row has the reason instead. Optimizer steps are left
    out with CUDA graphs, because the two do not work together.
    """
    results: list[Row] = []
    compile_networks(networks(module), way)
    for name, work in works_of(module, scenes, way.precision, samples).items():
        if name.endswith("_step") and (not training or way.compile == "reduce-overhead"):
            continue
        results.append({"name": name, "way": way.name} | time_and_memory(work, repeats, module.device, busy))
        gc.collect()
    return results


def time_and_memory(work: Work, repeats: int, device: torch.device, busy: int = 0) -> Row:
    """Return the median time, alone and beside busy processes, and on a GPU the peak memory; or why the work failed."""
    try:
        for _ in range(WARM_UP):
            work()
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)
        row = {"ms": statistics.median(milliseconds(work) for _ in range(repeats))}
        if busy:
            with busy_processes(busy):
                row["busy_ms"] = statistics.median(milliseconds(work) for _ in range(repeats))
            row["times"] = row["busy_ms"] / row["ms"]
    except (RuntimeError, AssertionError) as error:  # torch's compiler raises both kinds, too
        first = (str(error).strip().splitlines() or [""])[0]
        return {"not_measured": f"{type(error).__name__}: {first}"}
    memory = {"memory_mb": torch.cuda.max_memory_allocated(device) / 1e6} if device.type == "cuda" else {}
    return {**row, **memory}


@contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Let other processes compute all the time; they end with the block, or with this process."""
    program = "import os\nparent = os.getppid()\nwhile os.getppid() == parent: pass"
    processes = [subprocess.Popen([sys.executable, "-c", program]) for _ in range(count)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def compile_networks(networks: list[nn.Module], way: ComputeMode) -> None:
    if way.compile is not None:
        torch.compiler.reset()
        for network in networks:
            network.compile(mode=way.compile)


def networks(module: Stage) -> list[nn.Module]:
    """Return the parts that can be compiled, because each is called as a whole."""
    if isinstance(module, LatentDiffusion):
        parts = module.completesplat
        frozen = parts.autoreconstructor
        return [frozen.encoder, frozen.reconstructor, parts.conditioning, parts.denoiser]
    assert isinstance(module, ReconstructionModule)
    return [module.model.get_submodule("encoder"), module.model.get_submodule("reconstructor")]


def works_of(module: Stage, scenes: SceneBatch, precision: str, samples: int) -> dict[str, Work]:
    """Return the work of a stage by name; inference uses the first scene, training uses all."""
    step = partial(Training(module, precision).step, scenes)

    @torch.no_grad()
    def draw(samples: int = 1) -> Gaussians:
        with autocast(module.device, precision):
            return module.eval().draw(scenes[:1], [0], samples)

    if isinstance(module, LatentDiffusion):
        return {"sample": draw, "samples": partial(draw, samples), "stage2_step": step}
    gaussians = draw().map(Tensor.float)
    camera = scenes.reference.cameras[0]
    pivot = gaussians.means[0].mean(0)
    cameras = orbit(camera, pivot, pivot.new_tensor([0.0, -1.0, 0.0]), VIEWS).map(lambda tensor: tensor[None])

    @torch.no_grad()
    def render() -> Tensor:
        return module.rasterizer(gaussians, cameras).color

    return {"reconstruct": draw, "render": render, "stage1_step": step}
