"""`completesplat plan`: what a training takes, computed before it starts."""

import copy
import json
import logging
import math
import os
import statistics
import time
from collections.abc import Iterable, Mapping
from functools import partial
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import torch
from hydra.experimental.callback import Callback
from hydra.utils import get_class
from hydra.utils import instantiate as build
from lightning.pytorch.callbacks import WeightAveraging
from omegaconf import DictConfig, OmegaConf

from completesplat.data.loading.data_module import MOST_WORKERS
from completesplat.data.loading.distributed import batch_per_process
from completesplat.data.validation.processes import usable_cores
from completesplat.errors import CompleteSplatError, DataError
from completesplat.evaluation.scorer import synchronized_time
from completesplat.evaluation.tables import Table, records_table, show
from completesplat.files import write_json
from completesplat.scene import Batch, SceneBatch
from completesplat.settings.checks import check_image_size, check_optimizer, each_part, remove_start_weights
from completesplat.settings.options import did_you_mean
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.stage import Stage
from completesplat.training.step_counts import Operation, StepCounts, count_step, with_latents
from completesplat.training.steps import MEBIBYTE, Training, peak_megabytes, synthetic_batch

logger = logging.getLogger(__name__)
HERE = "this"
MOST_TIMED = 1e9  # bytes that a timed step may take on a CPU
UNTIMED_STEPS = 2
TIMED_STEPS = 5
TIMED_BATCHES = 5
BYTES = 1e9
DAY = 24 * 3600
REMARKS = (
    "An operation takes the longest of its FLOPs, its reads and writes, and its start; the rasterizer a time for each "
    "Gaussian and view. Not counted: exchange of gradients between GPUs, images drawn during training, the test.",
)
PAPER = "The paper's step (6 and 2 days for its stages, on one A100) took {:.1f} times as long."
MUCH = 1.2  # from which factor on something is left
LEFT = (
    "What is left may be views that are rendered one after the other, images decoded at full size in every step, "
    "float32, or more views of a scene: the paper states none of them, nor whether its days include validation."
)
ASSUMED = (
    *("gpu", "devices", "share", "bandwidth_share", "operation_us", "gaussian_ns", "checkpoint_rate"),
    *("price", "currency", "usable", "pixel_bytes", "loading_rate"),
)
ADDED = ("steps", "days", "gpu_hours", "price")


class Speeds(NamedTuple):
    """FLOPs and bytes of a second; seconds of the shortest operation, and of a Gaussian in a view, in both passes."""

    flops: float
    bandwidth: float
    start: float
    drawing: float


def run(config: DictConfig, out: Path) -> None:
    plan = plan_of(config)
    write_json(out / "plan.json", plan)
    show(plan_table({"plan": plan}), width=160)
    print("Assumptions:", " ".join(f"{key}={value}" for key, value in plan["assumptions"].items()))
    for line in plan["remarks"]:
        print(line)


class Total(Callback):
    """Hydra callback that prints the plans of a sweep side by side, with a total, after the last job."""

    def on_multirun_end(self, config: Any, **kwargs: object) -> None:
        """Print the table of all `plan.json` in the sweep's folder, in the order of the jobs."""
        folder = Path(config.hydra.sweep.dir)
        paths = {path: path.parent.relative_to(folder).as_posix() for path in folder.glob("*/**/plan.json")}
        ordered = sorted(paths, key=lambda path: path.stat().st_mtime)
        plans = {paths[path].removeprefix("experiment-"): json.loads(path.read_text()) for path in ordered}
        if plans:
            show(plan_table(plans), width=60 + 30 * len(plans))


def plan_table(plans: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return a table with a column for each plan; several have a total, as for the stages of one recipe."""
    rows: list[dict[str, object]] = []
    plans = {name: {**plan, **written_parts(plan)} for name, plan in plans.items()}
    first = next(iter(plans.values()))
    labels = {key: key.replace("_", " ") for key in first if key not in ("assumptions", "remarks", "parts")}
    if "price" in labels:
        labels["price"] += f", {first['assumptions']['currency']}"
    for key, label in labels.items():
        rows.append({"": label, **{name.replace("_", " "): plan[key] for name, plan in plans.items()}})
        if len(plans) > 1:
            rows[-1]["total"] = sum(plan[key] for plan in plans.values()) if key in ADDED else None
    return records_table("completesplat plan", rows)


def written_parts(plan: Mapping[str, Any]) -> dict[str, str]:
    """Return the parts of a plan's time as text: ms a step, and the share."""
    parts = plan.get("parts", {})
    texts = {name: "not counted" if x is None else f"{x * 1e3:.3g}" for name, x in parts.items()}
    total = sum(filter(None, parts.values()))
    return {f"{name}, ms a step": f"{texts[name]} ({(x or 0) / total:.0%})" for name, x in parts.items()}


def plan_of(config: DictConfig) -> dict[str, Any]:
    """Return a training's figures, `assumptions` and `remarks`; raise CompleteSplatError if a setting does not fit."""
    check_image_size(config)
    check_optimizer(config.optimizer)
    if config.gpu != HERE and config.gpu not in config.gpus:
        names = [*config.gpus, HERE]
        raise CompleteSplatError(f"gpu={config.gpu}: there are {', '.join(names)}{did_you_mean(config.gpu, names)}")
    data = config.data
    accumulated = config.trainer.accumulate_grad_batches
    batch = batch_per_process(data.batch_size, config.devices, accumulated)
    there = sequences_there(data)
    sequences = there or data.get("scenes", config.sequences)
    frames = data.get("frames", config.frames)
    steps = steps_of(config, sequences)
    counts = count_work(config, batch)
    limit = memory_limit(config)
    flops = counts.flops * config.devices
    measured = None
    fits = counts.peak <= limit
    if config.gpu == HERE:
        seconds, measured = measure_steps(config, counts, batch)
        step = {"steps as timed here": seconds * accumulated}
    else:
        speeds = speeds_of_gpu(config)
        drawing = counts.drawn * counts.accumulated * speeds.drawing
        step = {**seconds_of(counts.operations, speeds), "rasterizer": drawing}
    seconds = sum(step.values())
    loading = loading_seconds(config) if there else None
    parts = {**step, **parts_beside_steps(config, counts, batch, seconds, loading)}
    total = sum(filter(None, parts.values()))
    views = 1 if data.latent_cache is not None else 1 + data.targets
    rate = data.batch_size * views / seconds
    processes = math.ceil(rate / config.loading_rate if loading is None else data.batch_size / seconds * loading)
    hours = steps * total * config.devices / 3600
    images = sequences * frames
    stored = None if counts.latent_bytes is None else counts.latent_bytes * images / BYTES
    paper = OmegaConf.select(config, f"paper.{config.evaluation.data_set}.seconds_a_step")
    remarks = [*([] if fits else advice(config, counts, batch, limit)), *REMARKS]
    if paper is not None:
        remarks += [PAPER.format(paper / total), *([LEFT] if paper > MUCH * total else [])]
    assumed = {key: config[key] for key in ASSUMED}
    return {
        **{"trained_parameters": counts.trained, "frozen_parameters": counts.frozen, "flops_of_a_step": flops},
        **{"operations_of_a_step": len(counts.operations)},
        **{"bytes_of_a_step": sum(operation.bytes for operation in counts.operations)},
        **{f"{kind.replace(' ', '_')}_GB": size / BYTES for kind, size in counts.memory.items()},
        **{"memory_GB": counts.peak / BYTES, "memory_measured_GB": measured, "usable_GB": limit / BYTES, "fits": fits},
        **{"seconds_a_step": seconds, "images_a_second": rate, "loading_processes": processes},
        **{"prepared_data_GB": images * data.image_size**2 * config.pixel_bytes / BYTES, "latents_GB": stored},
        **{"steps": steps, "days": steps * total / DAY, "gpu_hours": hours, "price": hours * config.price},
        **{"paper_seconds_a_step": paper, "parts": parts},
        "assumptions": {**assumed, "sequences": sequences, "frames": frames, "precision": precision(config)},
        "remarks": remarks,
    }


def speeds_of_gpu(config: DictConfig) -> Speeds:
    """Return the speeds of a GPU of the table; it draws Gaussians in proportion to its FLOPs in float32."""
    gpu = config.gpus[config.gpu]
    table = config.gpus
    flops = gpu["float32" if precision(config).startswith("32") else "bfloat16"] * 1e12 * config.share
    drawing = config.gaussian_ns * 1e-9 * table.h200.float32 / gpu.float32
    return Speeds(flops, gpu.bandwidth * 1e12 * config.bandwidth_share, config.operation_us * 1e-6, drawing)


def seconds_of(operations: Iterable[Operation], speeds: Speeds) -> dict[str, float]:
    """Return the seconds of operations one after the other, each counted where it takes the longest."""
    parts = {"matrix products": 0.0, "reads and writes": 0.0, "starts of operations": 0.0}
    for flops, size in operations:
        times = dict(zip(parts, (flops / speeds.flops, size / speeds.bandwidth, speeds.start), strict=True))
        longest = max(times, key=lambda name: times[name])
        parts[longest] += times[longest]
    return parts


def parts_beside_steps(
    config: DictConfig, counts: StepCounts, batch: int, seconds: float, loading: float | None
) -> dict[str, float | None]:
    """Return the seconds of a step's share of waiting for data, of validation and of checkpoints; None: not counted.

    A validation is taken to need a step's forward pass for its scenes, and one for each step of the sampler. Forward
    passes take their share of a step's FLOPs. A checkpoint holds the weights, the optimizer's state and averages.

    Args:
        batch: scenes of a batch of this process.
        seconds: of a step.
        loading: seconds in which one process loads a scene; None: unknown.
    """
    data = config.data
    trainer = config.trainer
    checkpoint = config.get("callbacks", {}).get("checkpoint") or {}
    workers = min(MOST_WORKERS, usable_cores()) if data.workers is None else data.workers
    load = None if loading is None else loading * data.batch_size / config.devices / max(workers, 1)
    waiting = load if load is None or workers == 0 else max(0.0, load - seconds)

    forward = seconds * sum(operation.flops for operation in counts.forward) * counts.accumulated / counts.flops
    passes = config.sampler.steps if "completesplat" in config.model else 1
    every = trainer.val_check_interval
    batches = trainer.limit_val_batches
    validation = None
    if isinstance(every, int) and isinstance(batches, int):  # else shares of an epoch, or without an end
        validation = passes * forward * batches * data.evaluation_batch_size / (batch * every)

    size = sum(counts.memory[kind] for kind in ("weights", "optimizer", "averages"))
    by_steps = checkpoint.get("every_n_train_steps")
    by_time = checkpoint.get("every_minutes")
    often = (1 / by_steps if by_steps else 0.0) + (seconds / (60 * by_time) if by_time else 0.0)
    writing = size / (config.checkpoint_rate * BYTES) * often
    return {"waiting for data": waiting, "validation": validation, "checkpoints": writing}


def sequences_there(data: DictConfig) -> int | None:
    """Return the number of training sequences in `data.root`; None, with a warning, if there are none to read yet."""
    if OmegaConf.is_missing(data, "root") or not Path(data.root).is_dir():
        return None
    try:
        return len(build(data, _convert_="all").source("train").names)
    except DataError as error:
        logger.warning("%s; the plan is made as if there were no data", error)
        return None


def loading_seconds(config: DictConfig) -> float | None:
    """Return the seconds in which one process loads a scene on this machine, or None if there are no latents yet."""
    latents = config.data.get("latent_cache")
    if latents is not None and not Path(latents).is_dir():
        return None
    data = build({**config.data, "workers": 0}, _convert_="all")
    data.setup("fit")
    batches = iter(data.train_dataloader())
    next(batches)  # opens files and compiles
    times = [time.perf_counter(), *(time.perf_counter() for _ in islice(batches, TIMED_BATCHES))]
    seconds = [end - start for start, end in pairwise(times)]
    return statistics.median(seconds) / data.batch_size if seconds else None


def precision(config: DictConfig) -> str:
    """Return Lightning's name of the training's precision; the default is what the GPU supports, not this machine."""
    chosen = str(config.trainer.precision)
    unresolved: Any = OmegaConf.to_container(config.trainer)
    default = str(unresolved["precision"]).startswith("${best_precision")
    return "bf16-mixed" if config.gpu != HERE and (default or chosen.startswith("16")) else chosen


def steps_of(config: DictConfig, sequences: int) -> int:
    """Return the optimizer steps of the training; raise CompleteSplatError if it has no end."""
    trainer = config.trainer
    data = config.data
    epochs = trainer.get("max_epochs")
    limits = [] if trainer.max_steps < 0 else [trainer.max_steps]
    if epochs is not None and epochs >= 0:
        limits.append(epochs * math.ceil(sequences * data.references_per_sequence / data.batch_size))
    if not limits:
        raise CompleteSplatError("the training has no end: give trainer.max_steps=N or trainer.max_epochs=N")
    return int(min(limits))


def without_weights(config: DictConfig) -> DictConfig:
    """Return a copy of a config whose module is built without reading weights and without compiling."""
    config = copy.deepcopy(config)
    OmegaConf.set_struct(config, False)
    remove_start_weights(config.model)
    config.model.update({key: False for key in ("compile", "channels_last") if key in config.model})
    for entry in filter(None, config.loss.terms.values()):
        for _, kind in each_part(entry.get("term")):
            if twin := getattr(kind, "untrained", None):
                entry.term = {"_target_": f"{twin.__module__}.{twin.__name__}"}
    return config


def count_work(config: DictConfig, batch: int, **changes: Any) -> StepCounts:
    """Return the counts of a process that takes `batch` scenes at a time."""
    copied = without_weights(config)
    gpu = config.gpu != HERE or torch.cuda.is_available()
    copied.rasterizer = {"_target_": "completesplat.training.step_counts.MemoryOnlyRasterizer", "gpu": gpu}
    for key, value in changes.items():
        OmegaConf.update(copied, key, value)
    callbacks = config.get("callbacks", {}).values()
    targets = [get_class(callback._target_) for callback in callbacks if callback is not None]
    averaged = any(issubclass(target, WeightAveraging) for target in targets)
    data = config.data
    make = partial(build, copied.model, _convert_="all")
    sizes = (data.image_size, batch, data.targets, precision(config), config.trainer.accumulate_grad_batches)
    counts = count_step(make, *sizes, data.latent_cache is not None, gpu)
    weights = counts.memory["weights"] if averaged else 0
    more = {"averages": weights, "copies for ddp": counts.memory["gradients"] if config.devices > 1 else 0}
    update = [*counts.update, Operation(0, 3 * weights)]  # weights and averages are read, averages are written
    return counts._replace(update=update, memory={**counts.memory, **more})


def memory_limit(config: DictConfig) -> float:
    """Return the bytes that a process can use."""
    if config.gpu != HERE:
        return float(config.gpus[config.gpu].memory * BYTES * config.usable)
    if torch.cuda.is_available():
        return float(torch.cuda.get_device_properties(0).total_memory * config.usable)
    return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") * config.usable)


def parts_of(counts: StepCounts) -> tuple[int, int]:
    """Return the bytes that do not depend on the batch, and those that grow with it."""
    grows = sum(counts.memory[kind] for kind in ("batch", "activations", "intermediate results"))
    return counts.peak - grows, grows


def advice(config: DictConfig, counts: StepCounts, batch: int, limit: float) -> list[str]:
    """Return the settings with which a step fits into the memory: those that leave the training the same."""
    key = f"{'denoiser' if 'completesplat' in config.model else 'autoreconstructor'}.gradient_checkpointing"
    ways = [("", counts)]
    if OmegaConf.select(config, key) is False:
        ways.append((f"{key}=true", count_work(config, batch, **{key: True})))
    lines = []
    for settings, step_counts in ways:
        fixed, grows = parts_of(step_counts)
        least = next((k for k in range(1, batch + 1) if batch % k == 0 and fixed + grows / k <= limit), None)
        if least is not None:
            times = least * config.trainer.accumulate_grad_batches
            more = f"trainer.accumulate_grad_batches={times}" if least > 1 else ""
            size = f"{(fixed + grows / least) / BYTES:.3g} GB"
            lines.append(f"It fits with {' '.join(filter(None, [settings, more]))}: {size}.")
    reason = f"weights, gradients, optimizer and averages alone take {parts_of(counts)[0] / BYTES:.3g} GB"
    return lines or [f"No setting here makes it fit: {reason}."]


def measure_steps(config: DictConfig, counts: StepCounts, batch: int) -> tuple[float, float | None]:
    """Return the median seconds of real steps on this machine with `batch` scenes, and their peak in GB, if known.

    On a CPU, steps with fewer scenes are timed, and their memory not measured, if a whole batch takes more than 1 GB.

    Raises:
        CompleteSplatError: a step with one scene takes too much memory.
    """
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    limit = memory_limit(config) if device.type == "cuda" else MOST_TIMED
    fixed, grows = parts_of(counts)
    scenes = next((n for n in range(batch, 0, -1) if batch % n == 0 and fixed + grows * n / batch <= limit), None)
    if scenes is None:
        message = f"a step with one scene takes {(fixed + grows / batch) / BYTES:.3g} GB, at most {limit / BYTES:.3g}"
        raise CompleteSplatError(f"gpu={HERE}: {message} GB are timed; give a GPU by name")
    copied = without_weights(config)
    copied.rasterizer._target_ = "completesplat.rasterizers.selection.auto"
    module: Stage = build(copied.model, _convert_="all").to(device)
    inputs: Batch = synthetic_batch(config.data.image_size, scenes, config.data.targets).to(device)
    if isinstance(module, LatentDiffusion) and isinstance(inputs, SceneBatch) and config.data.latent_cache is not None:
        inputs = with_latents(module, inputs)
    training = Training(module, precision(config))
    seconds = []

    def step() -> None:
        start = synchronized_time()
        training.step(inputs)
        seconds.append(synchronized_time() - start)

    for _ in range(UNTIMED_STEPS + TIMED_STEPS):
        step()
    growth = peak_megabytes(step, device)
    peak = None if growth is None or scenes < batch else (fixed + growth * MEBIBYTE) / BYTES
    return statistics.median(seconds[UNTIMED_STEPS:-1]) * batch / scenes, peak
