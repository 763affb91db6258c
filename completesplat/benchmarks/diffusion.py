"""`completesplat bench diffusion`: time of stage 2, in pairs of ways to do the same work."""

import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Literal

import torch
from hydra.utils import instantiate
from rich.console import Console
from torch import nn
from torch.optim import Optimizer
from torch.utils.flop_counter import FlopCounterMode

from completesplat.benchmarks.compiling import NotMeasured, compiled_within
from completesplat.benchmarks.printing import device_of, print_results
from completesplat.commands import quieten
from completesplat.commands.protocol import write_json
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.packed.writing import prepare
from completesplat.diffusion.sampling import Sampler
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.generator import CompleteSplat
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.results.machine import machine
from completesplat.results.tables import Column, table
from completesplat.settings.schema import Positive, Range
from completesplat.training.encoding import encode_training_set
from completesplat.training.stage import Stage

WARM_UP = 2

Work = Callable[[], object]


@dataclass(frozen=True)
class Comparison:
    """Two ways of doing the same work, each with a label for tables; the first one should be faster.

    `counted`: whether to count their floating-point operations, which a compiled network hides.
    """

    name: str
    a: tuple[str, Work]
    b: tuple[str, Work]
    counted: bool = True


def run(
    data: Mapping[str, Any],
    model: Mapping[str, Any],
    few: Mapping[str, Any],
    device: Literal["auto", "cpu", "cuda"],
    precision: Literal["32-true", "bf16-mixed"],
    repeats: Positive,
    samples: Positive,
    steps: Positive,
    compile_limit: Annotated[float, Range(0)],
    only: Sequence[str] | None,
    seed: int,
    out: Path,
) -> None:
    """Compare pairs of ways with random weights, write `diffusion.json`, and print a table.

    Args:
        data, model: configs of the data module and of stage 2's module.
        few: config of a sampler with few steps.
        device: "auto" takes a GPU if there is one.
        precision: precision of training steps.
        repeats: number of timed calls of each way.
        samples: number of samples of one image, which are drawn in a batch and one by one, in `steps` steps.
        compile_limit: seconds that `torch.compile` may take; 0 skips it.
        only: names of the comparisons to do; None does all.

    Raises:
        CompleteSplatError: the device or a comparison does not exist.
    """
    chosen = chosen_device(device)
    quieten()
    with TemporaryDirectory(prefix="bench_diffusion_", dir=out) as folder:
        make_data = partial(instantiate, data, root=f"{folder}/scenes", _convert_="all")
        make_data().prepare_data()  # it shows its own progress bar
        torch.manual_seed(seed)
        module = instantiate(model, _convert_="all").to(chosen)
        generator, batch = module.completesplat, data["batch_size"]
        training = Training(module, precision)
        drawn = comparisons(generator, few, samples, steps, batch)
        prepared: dict[str, Callable[[], Comparison]] = {
            "cached_vs_on_the_fly": lambda: cached_vs_on_the_fly(training, make_data, Path(folder) / "latents"),
            **{comparison.name: partial(_same, comparison) for comparison in drawn},
            "compiled_vs_eager": lambda: compiled_vs_eager(generator, batch, precision, compile_limit),
            "drawn_compiled_vs_eager": lambda: drawn_compiled_vs_eager(generator, samples, steps, compile_limit),
        }
        rows, not_measured = _measured_in_turn(chosen_of(prepared, only), repeats, chosen)
    workload = {"device": chosen.type, "precision": precision, "image_size": data["image_size"], "batch": batch}
    results = {"machine": machine(), "workload": workload, "rows": rows, "not_measured": not_measured}
    write_json(out / "diffusion.json", results)
    show(results)


def chosen_device(device: str) -> torch.device:
    """Return the device for the option `device`.

    Raises:
        CompleteSplatError: "cuda" without a GPU.
    """
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise CompleteSplatError("device=cuda: there is no GPU here; device=auto takes what there is")
    return torch.device("cuda" if available and device != "cpu" else "cpu")


def chosen_of(
    prepared: Mapping[str, Callable[[], Comparison]], only: Sequence[str] | None
) -> Mapping[str, Callable[[], Comparison]]:
    """Select comparisons by name, or all.

    Raises:
        CompleteSplatError: a name does not exist.
    """
    for name in only or ():
        if name not in prepared:
            raise CompleteSplatError(f"only={name}: choose from {', '.join(prepared)}")
    return {name: prepare for name, prepare in prepared.items() if only is None or name in only}


def _measured_in_turn(
    prepared: Mapping[str, Callable[[], Comparison]], repeats: int, device: torch.device
) -> tuple[list[dict[str, Any]], dict[str, str]]:
    """Prepare and measure one comparison after another; return their rows, and reasons for missing rows by name."""
    rows, not_measured = [], {}
    with Console(stderr=True).status("building") as status:
        for name, prepare in prepared.items():
            status.update(f"timing {name}")
            try:
                rows.append(measured(prepare(), repeats, device))
            except NotMeasured as reason:
                not_measured[name] = str(reason)
    return rows, not_measured


def _same(comparison: Comparison) -> Comparison:
    return comparison


def measured(comparison: Comparison, repeats: int, device: torch.device) -> dict[str, Any]:
    """Return a row: medians in ms of both ways, which take turns, the speed-up of `a`, and TFLOP per call.

    The first two calls of each way are not timed. FLOPs are those that torch counts (products, convolutions).
    """
    ways = {"a": comparison.a, "b": comparison.b}
    tflop = {}
    for key, (_, work) in ways.items() if comparison.counted else ():
        with FlopCounterMode(display=False) as counter:
            work()
        tflop[f"{key}_tflop"] = counter.get_total_flops() / 1e12
    times: dict[str, list[float]] = {key: [] for key in ways}
    for _ in range(WARM_UP + repeats):
        for key, (_, work) in ways.items():
            times[key].append(milliseconds(work, device))
    medians = {f"{key}_ms": statistics.median(taken[WARM_UP:]) for key, taken in times.items()}
    texts = {key: text for key, (text, _) in ways.items()}
    return {"name": comparison.name, **texts, **medians, "ratio": medians["b_ms"] / medians["a_ms"], **tflop}


def milliseconds(work: Work, device: torch.device) -> float:
    """Return the time of one call, until the device has finished it."""
    wait = torch.cuda.synchronize if device.type == "cuda" else _nothing
    wait()
    start = time.perf_counter()
    work()
    wait()
    return (time.perf_counter() - start) * 1e3


def _nothing() -> None: ...


MAXIMAL_NORM = 1.0  # of gradients, as in conf/trainer


class Training:
    """Optimizer steps of either stage as in a run, without its logging; `module` is on its device.

    `precision` is in Lightning's notation: "bf16-mixed" computes the networks in bfloat16.
    """

    def __init__(self, module: Stage, precision: str) -> None:
        self.module: Any = module.train()
        self.precision = precision
        for logs in ("log_loss", "log_step"):  # there is no trainer to log with
            setattr(module, logs, lambda *_, **__: None)
        self.optimizer: Optimizer = module.optimizer([p for p in module.parameters() if p.requires_grad])

    def step(self, batch: Any) -> None:
        """Do one optimizer step on a batch of scenes or of their latents."""
        module = self.module
        with autocast(module.device, self.precision):
            loss = module.training_step(batch.to(module.device), 0)
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), MAXIMAL_NORM)
        self.optimizer.step()


def autocast(device: torch.device, precision: str) -> torch.autocast:
    """Return the context in which Lightning computes with this precision."""
    return torch.autocast(device.type, torch.bfloat16, enabled=precision.startswith("bf16"))


def cached_vs_on_the_fly(training: Training, data: Callable[..., SceneDataModule], folder: Path) -> Comparison:
    """Compare training steps from the latent cache and with encoding, both including the loading of batches.

    Args:
        data: makes the data module from the settings `latent_cache` and `root`; its scenes exist.
        folder: folder for the latents of the training set, which is packed beside it.
    """
    parts = training.module.completesplat
    pictures, packed = data(), folder.with_name("packed")
    prepare({"train": pictures.source("train")}, pictures.packed_settings(), packed, workers=1, progress=False)
    store = encode_training_set(
        parts.autoreconstructor,
        data(root=str(packed)),
        folder,
        conditioning=parts.conditioning if parts.conditioning.frozen else None,
        device=training.module.device,
        progress=False,
    )
    parts.set_latent_moments(store.mean, store.std)
    parts.train()
    fill_cache(pictures)
    cached, fly = batches(data(latent_cache=str(folder))), batches(pictures)
    return Comparison(
        "cached_vs_on_the_fly",
        ("step from the latent cache", lambda: training.step(next(cached))),
        ("encoding on the fly", lambda: training.step(next(fly))),
    )


def fill_cache(data: SceneDataModule) -> None:
    """Read all training images, so that `data.cache` holds what it does after the first epochs of a run."""
    store = data.store("train")
    for name in store.names:
        sequence = store.source.read(name)
        for view in range(len(sequence.frames)):
            store.image(sequence, view)


def batches(data: SceneDataModule) -> Iterator[Any]:
    """Yield the training batches of one epoch after another."""
    loader = data.train_dataloader()
    epoch = 0
    while True:
        loader.sampler.set_epoch(epoch)  # type: ignore[union-attr]
        yield from loader
        epoch += 1


GUIDANCE_WEIGHT = 0.5  # from the paper's settings for diverse samples
MANY_STEPS = 50  # the paper's


def comparisons(model: CompleteSplat, few: Mapping[str, Any], samples: int, steps: int, batch: int) -> list[Comparison]:
    """Return the comparisons of drawing samples with a generator on its device.

    Args:
        few: config of a sampler with few steps.
        samples, steps: number of samples of one image, in a batch or one by one, and of their steps.
        batch: number of images, each with one sample, without or with guidance, and in few or many steps.
    """
    model.eval()
    usual, quick = model.sampler, _built(model, few)
    several = partial(_draw, model, usual, 1, steps=steps, samples=samples)
    draw = partial(_draw, model, usual, batch)
    return [
        Comparison(
            f"batch_vs_one_by_one_k{samples}",
            (f"{samples} samples at a time", several),
            ("one by one", partial(several, batch=1)),
        ),
        Comparison(
            "unguided_vs_guided",
            ("w = 0", draw),
            (f"w = {GUIDANCE_WEIGHT}", partial(draw, guidance_weight=GUIDANCE_WEIGHT)),
        ),
        Comparison(
            f"few_steps_vs_{MANY_STEPS}",
            (_named(quick, quick.steps), partial(_draw, model, quick, batch)),
            (_named(usual, MANY_STEPS), partial(draw, steps=MANY_STEPS)),
        ),
    ]


def _built(model: CompleteSplat, sampler: Mapping[str, Any]) -> Sampler:
    """Build the sampler of a config for the noise schedule and prediction type of the model's denoiser."""
    usual, config = model.sampler, model.architecture["sampler"]
    model.replace_sampler(sampler)
    built: Sampler = model.sampler
    model.sampler, model.architecture["sampler"] = usual, config
    return built


def _draw(model: CompleteSplat, sampler: Sampler, pictures: int, **settings: Any) -> Gaussians:
    """Draw scenes for images of noise, because the content of images does not change the work."""
    size, device = model.image_size, model.latent_std.device
    images = torch.rand(pictures, 3, size, size, generator=torch.Generator().manual_seed(0)).to(device)
    camera = Cameras(torch.eye(4, device=device), pinhole(model.fov_degrees.item(), size).to(device), (size, size))
    cameras = camera.map(lambda tensor: tensor.expand(pictures, *tensor.shape))
    model.sampler = sampler
    return model.generate(images, cameras, model.depth_range.expand(pictures, 2), **settings)


def _named(sampler: Sampler, steps: int) -> str:
    name = type(sampler.scheduler).__name__.removesuffix("Scheduler").removesuffix("Multistep")
    return f"{name}, {steps} step{'' if steps == 1 else 's'}"


def compiled_vs_eager(model: CompleteSplat, batch: int, precision: str, limit: float) -> Comparison:
    """Compile the denoiser, and compare its forward and backward pass on noise, as in a training step.

    Raises:
        NotMeasured: compiling fails or takes more than `limit` seconds (see `compiled_within`).
    """
    denoiser, device = model.denoiser, model.latent_std.device
    with torch.no_grad():
        conditioning = model.conditioning(torch.rand(batch, 3, model.image_size, model.image_size, device=device))
    latent = torch.randn(batch, denoiser.latent_channels, *conditioning.shape[-2:], device=device)
    timestep = torch.arange(batch, device=device)

    def work(network: Callable[..., Any]) -> None:
        with autocast(device, precision):
            loss = network(latent, timestep, conditioning).square().mean()
        loss.backward()
        denoiser.zero_grad()

    denoiser.train()
    compiled = compiled_within(limit, denoiser, work)
    return Comparison(
        "compiled_vs_eager",
        ("denoiser compiled, both passes", lambda: work(compiled)),
        ("as it is", lambda: work(denoiser)),
        counted=False,
    )


def drawn_compiled_vs_eager(model: CompleteSplat, samples: int, steps: int, limit: float) -> Comparison:
    """Compile the denoiser, on a GPU into CUDA graphs, and compare a batch of samples (see `compiled_vs_eager`)."""
    denoiser, graphs = model.eval().denoiser, model.latent_std.device.type == "cuda"

    def work(network: nn.Module) -> None:
        model.denoiser = network
        try:
            _draw(model, model.sampler, 1, steps=steps, samples=samples)
        finally:
            model.denoiser = denoiser

    compiled = compiled_within(limit, denoiser, work, **({"mode": "reduce-overhead"} if graphs else {}))
    way = "CUDA graphs" if graphs else "denoiser compiled"
    return Comparison(
        "drawn_compiled_vs_eager",
        (f"{samples} samples, {way}", lambda: work(compiled)),
        ("as it is", lambda: work(denoiser)),
        counted=False,
    )


COMPARED: list[Column] = [
    ("a", "a", ""),
    ("b", "b", ""),
    ("a\nms", "a_ms", ",.1f"),
    ("b\nms", "b_ms", ",.1f"),
    ("times\nfaster", "ratio", ",.2f"),
    ("a\nTFLOP", "a_tflop", ",.4f"),
    ("b\nTFLOP", "b_tflop", ",.4f"),
]


def show(results: dict[str, Any]) -> None:
    """Print all parts of the results."""
    work = results["workload"]
    size = work["image_size"]
    title = f"{size} x {size} pixels, batch {work['batch']}, training in {work['precision']}"
    print_results(results, device_of(results), [table(title, COMPARED, results["rows"])])
