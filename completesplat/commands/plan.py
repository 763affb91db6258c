"""`completesplat plan`: what a training takes on this machine, measured on a few of its steps."""

import copy
import math
import resource
import statistics
import sys
from collections.abc import Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import torch
from hydra.utils import get_class
from hydra.utils import instantiate as build
from lightning.pytorch.callbacks import WeightAveraging
from omegaconf import DictConfig, OmegaConf

from completesplat.commands import quieten
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.loading.distributed import batch_per_process
from completesplat.errors import CompleteSplatError
from completesplat.evaluation.provenance import machine
from completesplat.evaluation.scorer import synchronized_time
from completesplat.evaluation.table_writers import show
from completesplat.evaluation.tables import records_table
from completesplat.files import write_json
from completesplat.scene import Batch
from completesplat.settings.checks import check_image_size, check_optimizer, remove_start_weights
from completesplat.tensors import used_device
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.reconstruction import ReconstructionModule, ReconstructorOnly
from completesplat.training.stage import Stage
from completesplat.training.steps import Training, synthetic_batch

GB = 1e9
UNTIMED_STEPS = 2  # the first ones compile, and take memory that is kept


def run(config: DictConfig, out: Path) -> None:
    """Measure steps, write `plan.json`, and print its figures."""
    quieten()
    plan = measured_plan(config)
    write_json(out / "plan.json", {"machine": machine(), **plan})
    rows = [{"": name.replace("_", " "), "here": value} for name, value in plan.items()]
    show(records_table("completesplat plan", rows), width=120)
    print("A step is that of one device, without validation and without the exchange of gradients between devices.")


def measured_plan(config: DictConfig) -> dict[str, Any]:
    """Return the figures of a training.

    Raises:
        CompleteSplatError: a setting does not fit, or a step does not work.
    """
    check_image_size(config)
    check_optimizer(config.optimizer)
    data = training_data(config)
    steps = number_of_steps(config, data)
    training, seconds = measure(config, data)
    module = training.module
    weights = sum(tensor.nbytes for tensor in module.state_dict().values())
    checkpoint = weights + training.optimizer_bytes()
    if has_averages(config):
        checkpoint += weights
    whole = None if steps is None else timedelta(seconds=steps * seconds)
    return {
        "trained_parameters": sum(x.numel() for x in module.parameters() if x.requires_grad),
        "frozen_parameters": sum(x.numel() for x in module.parameters() if not x.requires_grad),
        "batches": "noise, because there are no data" if data is None else str(config.data.root),
        "scenes_a_step": config.data.batch_size,
        "seconds_a_step": seconds,
        "seconds_a_step_of_the_paper_on_an_A100": papers_seconds(config),
        "peak_memory_GB": peak_memory(module) / GB,
        "weights_GB": weights / GB,
        "checkpoint_GB": checkpoint / GB,
        "steps": steps,
        "days": None if whole is None else whole / timedelta(days=1),
        "would_end": None if whole is None else f"{datetime.now() + whole:%Y-%m-%d %H:%M}",
        "max_time": config.trainer.get("max_time"),
    }


def training_data(config: DictConfig) -> SceneDataModule | None:
    """Return the training's data.

    Returns:
        The data module, or None if there is no folder of data yet and no latent cache is given.
    """
    data = config.data
    root = None if OmegaConf.is_missing(data, "root") else str(data.root)
    there = root is not None and ("://" in root or Path(root).is_dir())
    if not there and data.latent_cache is None:
        return None
    module: SceneDataModule = build(data, _convert_="all")
    module.setup("fit")
    return module


def batch_of_device(config: DictConfig) -> int:
    """Return the scenes that a device takes at once. Devices that are no positive number count as one.

    Raises:
        CompleteSplatError: devices cannot share the batch.
    """
    devices = config.trainer.devices
    count = devices if isinstance(devices, int) and devices > 0 else 1
    count *= config.trainer.get("num_nodes", 1)
    return batch_per_process(config.data.batch_size, count, config.trainer.accumulate_grad_batches)


def measure(config: DictConfig, data: SceneDataModule | None) -> tuple[Training, float]:
    """Train a few steps from random weights.

    Returns:
        The training, and the median seconds of a step, its loading included.

    Raises:
        CompleteSplatError: the model has no steps of its own, or one of them fails, because memory is short, say.
    """
    batches = scene_batches(config, data)
    remove_start_weights(config.model)
    module: Stage = build(config.model, _convert_="all")
    if not isinstance(module, ReconstructionModule | LatentDiffusion) or isinstance(module, ReconstructorOnly):
        name = type(module).__name__
        message = "fits scenes, one by one: time `completesplat fit` with trainer.max_steps=N"
        raise CompleteSplatError(f"{name} {message}")
    module.to("cpu" if config.trainer.accelerator == "cpu" else used_device())
    training = Training(module, config.trainer.precision)
    averages = copy.deepcopy(module) if has_averages(config) else None  # takes memory, as in a training
    times = []
    for _ in range(UNTIMED_STEPS + config.timed_steps):
        start = synchronized_time()
        taken = [next(batches) for _ in range(config.trainer.accumulate_grad_batches)]
        try:
            training.step(*taken)
        except RuntimeError as error:
            message = " ".join(str(error).split())[:300]
            raise CompleteSplatError(f"a step fails: {type(error).__name__}: {message}") from error
        times.append(synchronized_time() - start)
    del averages
    return training, statistics.median(times[UNTIMED_STEPS:])


def scene_batches(config: DictConfig, data: SceneDataModule | None) -> Iterator[Batch]:
    """Yield batches of the training, again and again.

    Without data, the batches are noise of the same sizes.
    """
    batch = batch_of_device(config)
    if data is None:
        noise = synthetic_batch(config.data.image_size, batch, config.data.targets)
        while True:
            yield noise
    data.batch_size = batch
    loader = data.train_dataloader()
    while True:
        yield from loader


def number_of_steps(config: DictConfig, data: SceneDataModule | None) -> int | None:
    """Return the optimizer steps of the training.

    Returns:
        The number, or None if the training has no end, or ends after epochs of data that are not there.
    """
    limits = []
    epochs = config.trainer.get("max_epochs")
    if config.trainer.max_steps >= 0:
        limits.append(config.trainer.max_steps)
    if epochs is not None and epochs >= 0 and data is not None:
        scenes = len(data.source("train").names) * config.data.references_per_sequence
        limits.append(epochs * math.ceil(scenes / config.data.batch_size))
    return min(limits, default=None)


def has_averages(config: DictConfig) -> bool:
    """Return whether a callback averages the weights, which makes a copy of them."""
    callbacks = config.get("callbacks", {}).values()
    targets = [get_class(callback._target_) for callback in callbacks if callback is not None]
    return any(issubclass(target, WeightAveraging) for target in targets)


def papers_seconds(config: DictConfig) -> float | None:
    """Return the paper's seconds of a step on the same data set, if it states its days and steps."""
    seconds: float | None = OmegaConf.select(config, f"paper.{config.evaluation.data_set}.seconds_a_step")
    return seconds


def peak_memory(module: Stage) -> int:
    """Return the largest number of bytes that torch had on a GPU, or this process without one."""
    if module.device.type == "cuda":
        return torch.cuda.max_memory_allocated()
    unit = 1 if sys.platform == "darwin" else 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit
