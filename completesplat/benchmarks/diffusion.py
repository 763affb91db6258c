"""`completesplat bench diffusion`: time of stage 2, in pairs of ways to do the same work."""

import statistics
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import torch
from hydra.utils import instantiate
from rich.console import Console
from torch.utils.flop_counter import FlopCounterMode

from completesplat.benchmarks.measuring import WARM_UP, Row, Work, milliseconds, report
from completesplat.commands import quieten
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.packed.writing import prepare
from completesplat.diffusion.sampling import Sampler
from completesplat.errors import CompleteSplatError
from completesplat.generator import CompleteSplat
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.scene import CachedScene, SceneBatch
from completesplat.settings.schema import Positive
from completesplat.training.encoding import encode_training_set
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.steps import Training

GUIDANCE_WEIGHT = 0.5  # from the paper's settings for diverse samples
MANY_STEPS = 50  # the paper's
CACHED = "cached_vs_on_the_fly"


Comparison = tuple[tuple[str, Work], tuple[str, Work]]
"""Two ways of doing the same work, each with a label for tables; the first one should be faster."""


def run(
    data: Mapping[str, object], model: Mapping[str, object], few: Mapping[str, object],
    device: Literal["auto", "cpu", "cuda"], precision: Literal["32-true", "bf16-mixed"], repeats: Positive,
    samples: Positive, steps: Positive, only: Sequence[str] | None, seed: int, out: Path,
) -> None:  # fmt: skip
    """Compare pairs of ways with random weights, write `diffusion.json`, and print a table.

    Args:
        data, model: configs of the data module and of stage 2's module.
        few: config of a sampler with few steps.
        device: "auto" takes a GPU if there is one.
        precision: precision of training steps.
        repeats: number of timed calls of each way.
        samples: number of samples of one image, which are drawn in a batch and one by one, in `steps` steps.
        only: names of the comparisons to do; None does all.

    Raises:
        CompleteSplatError: the device or a comparison does not exist.
    """
    if device == "cuda" and not torch.cuda.is_available():
        raise CompleteSplatError("device=cuda: there is no GPU here; device=auto takes what there is")
    chosen = torch.device("cuda" if torch.cuda.is_available() and device != "cpu" else "cpu")
    quieten()
    rows: list[Row] = []
    with TemporaryDirectory(prefix="bench_diffusion_", dir=out) as folder:
        make_data = partial(instantiate, data, root=f"{folder}/scenes", _convert_="all")
        make_data().prepare_data()  # it shows its own progress bar
        torch.manual_seed(seed)
        module: LatentDiffusion = instantiate(model, _convert_="all").to(chosen)
        loaded: SceneDataModule = make_data()
        batch = loaded.batch_size
        sampling = sampling_comparisons(module.completesplat, few, samples, steps, batch)
        with Console(stderr=True).status("building") as status:
            for name in chosen_of([CACHED, *sampling], only):
                status.update(f"timing {name}")
                comparison = sampling.get(name)
                if comparison is None:
                    comparison = cached_vs_on_the_fly(module, precision, make_data, Path(folder) / "latents")
                rows.append({"name": name} | measured(comparison, repeats))
    workload = {"device": chosen.type, "precision": precision, "image_size": loaded.image_size, "batch": batch}
    title = f"{loaded.image_size} x {loaded.image_size} pixels, batch {batch}, training in {precision}"
    report(out / "diffusion.json", {"workload": workload, "rows": rows}, {title: rows}, chosen.type)


def chosen_of(names: Collection[str], only: Sequence[str] | None) -> list[str]:
    """Select names, or all.

    Raises:
        CompleteSplatError: a name does not exist.
    """
    for name in only or ():
        if name not in names:
            raise CompleteSplatError(f"only={name}: choose from {', '.join(names)}")
    return [name for name in names if only is None or name in only]


def measured(comparison: Comparison, repeats: int) -> Row:
    """Return medians in ms of both ways, which take turns, the speed-up of `a`, and TFLOP per call.

    The first two calls of each way are not timed. FLOPs are those that torch counts (products, convolutions).
    """
    (first, one), (second, other) = comparison
    works = {"a": one, "b": other}
    tflop, times = {}, {key: list[float]() for key in works}
    for key, work in works.items():
        with FlopCounterMode(display=False) as counter:
            work()
        tflop[f"{key}_tflop"] = counter.get_total_flops() / 1e12
    for _ in range(WARM_UP + repeats):
        for key, work in works.items():
            times[key].append(milliseconds(work))
    a, b = (statistics.median(times[key][WARM_UP:]) for key in works)
    return {"a": first, "b": second, "a_ms": a, "b_ms": b, "ratio": b / a, **tflop}


def cached_vs_on_the_fly(
    module: LatentDiffusion, precision: str, data: Callable[..., SceneDataModule], folder: Path
) -> Comparison:
    """Compare training steps from the latent cache and with encoding, both including the loading of batches.

    Args:
        data: makes the data module from the settings `latent_cache` and `root`; its scenes exist.
        folder: folder for the latents of the training set, which is packed beside it.
    """
    training, parts = Training(module, precision), module.completesplat
    images, packed = data(), folder.with_name("packed")
    prepare({"train": images.source("train")}, images.packed_settings(), packed, workers=1, progress=False)
    store = encode_training_set(
        parts.autoreconstructor,
        data(root=str(packed)),
        folder,
        conditioning=parts.conditioning if parts.conditioning.frozen else None,
        device=module.device,
        progress=False,
    )
    parts.set_latent_moments(store.mean, store.std)
    fill_cache(images)
    cached, fly = batches(data(latent_cache=str(folder))), batches(images)
    return (
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


def batches(data: SceneDataModule) -> Iterator[SceneBatch | CachedScene]:
    """Yield the training batches of one epoch after another."""
    loader = data.train_dataloader()
    for epoch in count():
        loader.sampler.set_epoch(epoch)  # type: ignore[union-attr]
        yield from loader


def sampling_comparisons(
    model: CompleteSplat, few: Mapping[str, object], samples: int, steps: int, batch: int
) -> dict[str, Comparison]:
    """Return the comparisons of drawing samples with a generator on its device.

    Args:
        few: config of a sampler with few steps.
        samples, steps: number of samples of one image, in a batch or one by one, and of their steps.
        batch: number of images, each with one sample, without or with guidance, and in few or many steps.
    """
    model.eval()
    usual, config = model.sampler, model.architecture["sampler"]
    model.replace_sampler(few)  # builds it for the noise schedule and prediction type of the model's denoiser
    quick: Sampler = model.sampler
    model.sampler, model.architecture["sampler"] = usual, config
    several = partial(_draw, model, usual, 1, steps=steps, samples=samples)
    draw = partial(_draw, model, usual, batch)
    return {
        f"batch_vs_one_by_one_k{samples}": (
            (f"{samples} samples at a time", several),
            ("one by one", partial(several, batch=1)),
        ),
        "unguided_vs_guided": (
            ("w = 0", draw),
            (f"w = {GUIDANCE_WEIGHT}", partial(draw, guidance_weight=GUIDANCE_WEIGHT)),
        ),
        f"few_steps_vs_{MANY_STEPS}": (
            (_label(quick, quick.steps), partial(_draw, model, quick, batch)),
            (_label(usual, MANY_STEPS), partial(draw, steps=MANY_STEPS)),
        ),
    }


def _draw(
    model: CompleteSplat, sampler: Sampler, images: int, samples: int = 1, steps: int | None = None,
    guidance_weight: float = 0.0, batch: int | None = None,
) -> None:  # fmt: skip
    """Draw scenes for images of noise, because the content of images does not change the work."""
    size, device = model.image_size, model.latent_std.device
    noise = torch.rand(images, 3, size, size, generator=torch.Generator().manual_seed(0)).to(device)
    camera = Cameras(torch.eye(4, device=device), pinhole(model.fov_degrees.item(), size).to(device), (size, size))
    cameras = camera.map(lambda tensor: tensor.expand(images, *tensor.shape))
    model.sampler = sampler
    ranges = model.depth_range.expand(images, 2)
    model.generate(noise, cameras, ranges, samples, None, guidance_weight, steps, batch=batch)


def _label(sampler: Sampler, steps: int) -> str:
    name = type(sampler.scheduler).__name__.removesuffix("Scheduler").removesuffix("Multistep")
    return f"{name}, {steps} step{'' if steps == 1 else 's'}"
