"""Training callbacks: seeds, skipped steps, figures of the optimizer, averaged weights, the progress bar, speed."""

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import RichProgressBar, WeightAveraging
from rich import get_console
from rich.progress import TaskID
from torch import Tensor
from torch.optim import Optimizer

from completesplat.data.loading.distributed import gather_values, mean_of_processes
from completesplat.errors import DivergenceError
from completesplat.evaluation.records import BAD_STEPS
from completesplat.quantities import Positive, Share
from completesplat.scene import Batch
from completesplat.training.stage import Stage
from completesplat.weights.checkpoint_reading import not_finite

IN_PROGRESS_BAR = ("train/loss", "train/psnr", BAD_STEPS)
STATUS = Path("/proc/self/status")

logger = logging.getLogger(__name__)


class StepSeeds(Callback):
    """Callback that seeds torch's global generators before every training batch.

    Random numbers then depend on (seed, epoch, batch, process) alone, also in a run that is resumed within an epoch.
    """

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        torch.manual_seed(step_seed(self.seed, trainer.current_epoch, batch_idx, trainer.global_rank))


def step_seed(*place: int) -> int:
    """Return a 64-bit seed that differs from, and is unrelated to, those of other places (NumPy's `SeedSequence`)."""
    return int(np.random.SeedSequence(place).generate_state(1, np.uint64)[0])


class BadSteps(Callback):
    """Callback that skips optimizer steps whose loss, or norm of all gradients, is not finite.

    A skipped step does not change weights or moments. It counts as a step of the run, so the schedule,
    averages and the order of the data continue. All processes skip the same steps. Progress bar and loggers get the
    number of skipped steps as `train/bad_steps`. With 16-mixed, it includes the first ones, which find the loss scale.

    Fused optimizers skip steps on the device. On a GPU, whether a step was bad is then read in the next one.

    Args:
        most_bad_steps: `DivergenceError` ends the run after this many skipped steps in a row. At the end, before a
            checkpoint is written, it does so if the last two steps were skipped, or the last one and half of all, if
            weights are not finite, or if they are so large that a prediction for the last batch is not.
    """

    def __init__(self, most_bad_steps: Positive = 10) -> None:
        self.most_bad_steps = most_bad_steps
        self.total = 0
        self.in_a_row = 0
        self.losses: list[Tensor] = []
        self.last: tuple[Tensor, torch.cuda.Event] | None = None  # whether the last step was bad, on its way here
        self.divergence = "all steps had a loss or gradients that are not finite"
        self.batch: object = None  # of the last step

    def state_dict(self) -> dict[str, int]:
        self._count_last()
        return {"total": self.total, "in_a_row": self.in_a_row}

    def load_state_dict(self, state_dict: dict[str, int]) -> None:
        self.total = state_dict["total"]
        self.in_a_row = state_dict["in_a_row"]

    def on_before_backward(self, trainer: Trainer, pl_module: LightningModule, loss: Tensor) -> None:
        self.losses.append(loss.detach())  # several losses if gradients are accumulated

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        gradients = [p.grad for p in pl_module.parameters() if p.grad is not None]
        norm = torch.nn.utils.get_total_norm(gradients).to(pl_module.device)
        if isinstance(pl_module, Stage):
            pl_module.gradient_norm = norm
        finite = torch.stack([*self.losses, norm]).isfinite().all()
        self.losses = []
        # Processes have different losses, but the same gradients.
        bad = trainer.strategy.reduce((~finite).float(), reduce_op="sum").clamp(max=1)
        self._count_last()
        fused = bool(optimizer.defaults.get("fused"))
        if fused:
            optimizer.found_inf = bad  # type: ignore[attr-defined]  # the protocol of `torch.amp.GradScaler`
        if fused and bad.is_cuda and not self.in_a_row and self.most_bad_steps > 1:
            copied = bad.to("cpu", non_blocking=True)
            self.last = (copied, torch.cuda.current_stream().record_event())
        elif self._count(bool(bad)):
            self.divergence = _divergence(trainer, pl_module, self.in_a_row)
            if self.in_a_row >= self.most_bad_steps:
                raise DivergenceError(self.divergence)
            for parameter in pl_module.parameters():
                parameter.grad = None  # optimizers skip these parameters
        pl_module.log(BAD_STEPS, torch.tensor(float(self.total)), batch_size=1)

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: object, batch_idx: int
    ) -> None:
        self.batch = batch

    def _count(self, bad: bool) -> bool:
        self.total += bad
        self.in_a_row = (self.in_a_row + 1) * bad
        return bad

    def _count_last(self) -> None:
        if self.last is not None:
            bad, computed = self.last
            self.last = None
            computed.synchronize()
            self._count(bool(bad))

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Raise DivergenceError if the weights cannot be trusted, before a checkpoint of them is written."""
        self._count_last()
        half_were_bad = 2 * self.total >= trainer.global_step
        if self.in_a_row > 1 or (self.in_a_row == 1 and half_were_bad):
            raise DivergenceError(self.divergence)
        name = not_finite(pl_module.state_dict())
        if name is not None:
            raise DivergenceError(f"after {trainer.global_step} steps, {name} is not finite; lower optimizer.lr")
        if not isinstance(pl_module, Stage) or not isinstance(self.batch, Batch):
            return
        pl_module.eval()
        with trainer.precision_plugin.val_step_context():
            finite = pl_module.predicts_finite(self.batch)
        self.batch = None
        if not all(gather_values(finite)):
            advice = "the last steps were too large; lower optimizer.lr"
            raise DivergenceError(f"after {trainer.global_step} steps, predictions are not finite: {advice}")


class OptimizerFigures(Callback):
    """Callback that logs the learning rate and the norm of all gradients before they are clipped, of logged steps.

    The rate is that of the optimizer's first group of weights.
    """

    def on_before_optimizer_step(self, trainer: Trainer, pl_module: LightningModule, optimizer: Optimizer) -> None:
        norm = pl_module.gradient_norm if isinstance(pl_module, Stage) else None  # by `BadSteps`
        if norm is None:
            gradients = [p.grad for p in pl_module.parameters() if p.grad is not None]
            norm = torch.nn.utils.get_total_norm(gradients)
        rate = torch.tensor(float(optimizer.param_groups[0]["lr"]))
        pl_module.log_dict({"train/learning_rate": rate, "train/gradient_norm": norm}, batch_size=1)


def _divergence(trainer: Trainer, module: LightningModule, steps: int) -> str:
    """Describe a bad step: its number, and the loss term and first layer that are not finite in any process."""
    terms: list[str] = []
    for name, value in trainer.callback_metrics.items():
        if name.startswith("train/") and not value.isfinite():
            terms.append(f"{name.removeprefix('train/')} is {value.item()}")
    terms.sort(key=lambda term: term.startswith("loss "))  # the sum says less than its terms
    layers: list[str] = []
    for name, parameter in module.named_parameters():
        if parameter.grad is not None and not parameter.grad.isfinite().all():
            layers.append(name)
    all_terms = [term for process_terms in gather_values(terms) for term in process_terms]
    all_layers = [layer for process_layers in gather_values(layers) for layer in process_layers]
    term = f"loss term {all_terms[0]}" if all_terms else "the last losses are finite"
    layer = f"that of {all_layers[0]} is the first" if all_layers else "their norm is too large"
    return (
        f"step {trainer.global_step}: {steps} steps in a row had a loss or gradients that are not finite: {term}; "
        f"of the gradients {layer}; lower optimizer.lr, or start again from an earlier checkpoint with another seed"
    )


class ExponentialMovingAverage(WeightAveraging):
    """Average of the weights over the steps, which checkpoints, validation and the end of training use.

    Lightning's own `EMAWeightAveraging` computes decay * a + (1 - decay) * b, which lets frozen weights and measured
    buffers drift by rounding. Linear interpolation leaves them exactly as they are. The paper states no `decay`.
    Lightning also keeps the average on the CPU, because it makes it before the model moves to a GPU.
    """

    def __init__(self, decay: Share) -> None:
        super().__init__()
        self.decay = decay

    def on_fit_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        assert self._average_model is not None
        self._average_model.to(pl_module.device)

    @contextmanager
    def in_place(self, module: LightningModule) -> Iterator[None]:
        """Replace the weights by the average, as in validation."""
        self._swap_models(module)
        try:
            yield
        finally:
            self._swap_models(module)

    @torch.no_grad()
    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, *_: object) -> None:
        """Update the average after an optimizer step. (Torch's own way waits for the GPU twice.)"""
        if trainer.global_step == self._latest_update_step:
            return
        average = self._average_model
        assert average is not None
        share = 1 - self.decay if self._latest_update_step else 1.0
        torch._foreach_lerp_(_floating_tensors(average.module), _floating_tensors(pl_module), share)
        average.n_averaged += 1
        self._latest_update_step = trainer.global_step

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Wait for `on_fit_end`, because the checkpoint that is written now must also hold the weights themselves."""

    def on_fit_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_train_end(trainer, pl_module)


def _floating_tensors(module: torch.nn.Module) -> list[Tensor]:
    """Return a module's parameters and buffers of floating-point numbers."""
    return [tensor for tensor in (*module.parameters(), *module.buffers()) if tensor.is_floating_point()]


class Progress(RichProgressBar):
    """Lightning's progress bar over the optimizer steps of the whole run, so that it shows the run's remaining time.

    Without a terminal, it logs a line after every validation.
    """

    updated_at = 0.0

    @property
    def total_train_batches(self) -> int | float:
        """Return the steps of the run, or the batches of an epoch if the run has no number of steps."""
        steps = self.trainer.max_steps
        return steps if steps > 0 else super().total_train_batches

    def on_train_epoch_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if trainer.max_steps <= 0 or self.train_progress_bar_id is None:
            super().on_train_epoch_start(trainer, pl_module)

    def _update(self, progress_bar_id: TaskID | None, current: int, visible: bool = True, hard: bool = False) -> None:
        whole_run = progress_bar_id is not None and progress_bar_id == self.train_progress_bar_id
        if whole_run and self.trainer.max_steps > 0:
            current = self.trainer.global_step
        super()._update(progress_bar_id, current, visible, hard)

    def _update_metrics(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Show figures at most once a second, because reading them waits for the GPU."""
        now = time.perf_counter()
        if now - self.updated_at >= 1:
            self.updated_at = now
            super()._update_metrics(trainer, pl_module)

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        metrics: dict[str, Any] = {}
        if trainer.max_steps <= 0:  # otherwise the bar itself counts the steps
            metrics["step"] = trainer.global_step
        metrics.update(super().get_metrics(trainer, pl_module))
        for name in IN_PROGRESS_BAR:
            if name in trainer.callback_metrics:
                metrics[name] = trainer.callback_metrics[name].item()
        metrics.pop("v_num", None)
        if not metrics.get(BAD_STEPS):
            metrics.pop(BAD_STEPS, None)
        return metrics

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        super().on_validation_end(trainer, pl_module)
        if get_console().is_terminal or not trainer.is_global_zero:
            return
        figures: list[str] = []
        for name, value in trainer.callback_metrics.items():
            if name == "train/loss" or name.startswith("val/"):
                figures.append(f"{name} {value:.4g}")
        steps = f"{trainer.global_step}/{trainer.max_steps}" if trainer.max_steps > 0 else f"{trainer.global_step}"
        logger.info("step %s: %s", steps, ", ".join(figures))

    def _get_train_description(self, current_epoch: int) -> str:
        return "Training" if self.trainer.max_steps > 0 else f"Epoch {current_epoch}"


class Throughput(Callback):
    """Callback that logs speed and memory at the trainer's interval.

    A row has `speed/scenes_per_second` of all processes, `speed/data_wait`, the share of the time in which training
    waited for data, and the values of `memory`; all are means over the processes. Speeds come from the mean times of a
    batch and of waiting for one since the last row. Validation, batches before which a checkpoint is written, and what
    happens between a row and the next batch are left out. There is no `data_wait` if a row has a single batch.

    Lightning's `ThroughputMonitor` does not measure waiting, and makes every batch wait for the GPU.
    """

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.step = trainer.global_step
        self._forget()

    def _forget(self) -> None:
        self.ended: float | None = None
        self.waits: list[float] = []
        self.batches: list[float] = []
        self.scenes = 0

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: object, batch_idx: int) -> None:
        self.started: float | None = time.perf_counter()
        if self.ended is not None:
            self.waits.append(self.started - self.ended)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: object) -> None:
        self.started = None

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.ended = None

    def on_train_batch_end(
        self, trainer: Trainer, pl_module: LightningModule, outputs: object, batch: Batch, batch_idx: int
    ) -> None:
        self.ended = time.perf_counter()
        if self.started is not None:
            self.batches.append(self.ended - self.started)
            self.scenes += len(batch.names)
        stepped = trainer.global_step != self.step
        self.step = trainer.global_step
        interval = trainer.log_every_n_steps  # type: ignore[attr-defined]
        if not stepped or not interval or trainer.global_step % interval or not self.batches:
            return
        wait = mean(self.waits) if self.waits else 0.0
        seconds = mean(self.batches) + wait
        values = memory(pl_module.device)
        values["speed/scenes_per_second"] = self.scenes / len(self.batches) * trainer.world_size / seconds
        if self.waits:
            values["speed/data_wait"] = wait / seconds
        tensors = {name: torch.tensor(value, device=pl_module.device) for name, value in values.items()}
        pl_module.log_dict(mean_of_processes(tensors), batch_size=len(batch.names))
        self._forget()


def memory(device: torch.device) -> dict[str, float]:
    """Return `memory/process_gb` of this process (on Linux) and `memory/gpu_gb`, torch's peak, both in GiB."""
    values = {}
    if STATUS.exists():
        lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines())
        values["memory/process_gb"] = int(lines["VmRSS"].split()[0]) / 2**20  # from KiB
    if device.type == "cuda":
        values["memory/gpu_gb"] = torch.cuda.max_memory_allocated(device) / 2**30
    return values
