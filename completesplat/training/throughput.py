"""Speed of a run, its waiting for data, and its memory."""

import time
from pathlib import Path

import torch
from lightning import Callback, LightningModule, Trainer
from lightning.pytorch.profilers import Profiler

from completesplat.data.loading.distributed import mean_of_processes
from completesplat.scene import CachedScene, SceneBatch
from completesplat.training.stage import now

FETCHING = "[_TrainingEpochLoop].train_dataloader_next"
SAVING = "save_checkpoint"
STATUS = Path("/proc/self/status")


class Throughput(Callback):
    """Callback that logs speed and memory at the trainer's interval.

    `speed/scenes_per_second` (of all processes) and `speed/data_wait`, the share of the time in which training waited
    for data, cover the steps since the last row; for memory see `memory`. All are means over the processes. The clock
    stops during validation, while checkpoints are written, and from a row to the next batch. Drawing of images is
    therefore not counted if its interval is a multiple of the trainer's and this callback comes first.
    """

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        self.clock = DataClock(trainer.profiler)  # type: ignore[attr-defined]
        trainer.profiler = self.clock  # type: ignore[attr-defined]
        self._forget()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        trainer.profiler = self.clock.profiler  # type: ignore[attr-defined]

    def _forget(self) -> None:
        self.clock.waited, self.clock.saved, self.clock.begin = 0.0, 0.0, None
        self.scenes, self.paused = 0, 0.0

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.step = trainer.global_step

    def on_validation_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        self.pause = now()

    def on_validation_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.clock.begin is not None:
            self.paused += now() - self.pause

    def on_train_batch_end(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        outputs: object,
        batch: SceneBatch | CachedScene,
        batch_idx: int,
    ) -> None:
        self.scenes += len(batch.names)
        stepped, self.step = trainer.global_step != self.step, trainer.global_step
        interval = trainer.log_every_n_steps  # type: ignore[attr-defined]
        if not stepped or not interval or trainer.global_step % interval or self.clock.begin is None:
            return
        seconds = now() - self.clock.begin - self.paused - self.clock.saved
        values = {
            "speed/scenes_per_second": self.scenes * trainer.world_size / seconds,
            "speed/data_wait": self.clock.waited / seconds,
            **memory(pl_module.device),
        }
        tensors = {name: torch.tensor(value, device=pl_module.device) for name, value in values.items()}
        pl_module.log_dict(mean_of_processes(tensors), batch_size=len(batch.names))
        self._forget()


class DataClock(Profiler):
    """Profiler that times fetching batches and saving checkpoints, and passes every call on to another profiler."""

    def __init__(self, profiler: Profiler) -> None:
        super().__init__()
        self.profiler = profiler
        self.begin: float | None = None
        self.waited = self.saved = 0.0
        for name in ("setup", "describe", "teardown"):
            setattr(self, name, getattr(profiler, name))

    def start(self, action_name: str) -> None:
        """Start timing before an action of Lightning."""
        if action_name in (FETCHING, SAVING):
            self.since = time.perf_counter()
        if action_name == FETCHING and self.begin is None:
            self.begin = self.since
        self.profiler.start(action_name)

    def stop(self, action_name: str) -> None:
        """Stop timing after an action of Lightning."""
        self.profiler.stop(action_name)
        if action_name == FETCHING:
            self.waited += time.perf_counter() - self.since
        elif action_name == SAVING and self.begin is not None:
            self.saved += time.perf_counter() - self.since


def memory(device: torch.device) -> dict[str, float]:
    """Return in GiB: `memory/process_gb`, this process's memory (on Linux), and `memory/gpu_gb`, torch's maximum."""
    values = {}
    if STATUS.exists():
        lines = dict(line.split(":", 1) for line in STATUS.read_text().splitlines())
        values["memory/process_gb"] = int(lines["VmRSS"].split()[0]) / 2**20  # from KiB
    if device.type == "cuda":
        values["memory/gpu_gb"] = torch.cuda.max_memory_allocated(device) / 2**30
    return values
