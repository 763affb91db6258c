"""What training does around its steps: random numbers, speed and memory."""

import itertools
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import pytest
import torch
from lightning import Callback
from lightning.pytorch.demos.boring_classes import BoringModel
from lightning.pytorch.loggers.logger import Logger
from scenes_for_training import quiet_trainer, scene_batch
from torch.utils.data import DataLoader

from completesplat.training import callbacks
from completesplat.training.callbacks import ExponentialMovingAverage, Progress, StepSeeds, Throughput, memory


class Clock:
    """Stands still but for what naps on it."""

    def __init__(self) -> None:
        self.seconds = 100.0

    def __call__(self) -> float:
        return self.seconds

    def nap(self, seconds: float) -> None:
        self.seconds += seconds


@pytest.fixture
def clock(monkeypatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(callbacks, "time", SimpleNamespace(perf_counter=made))
    return made


class Sleeper(BoringModel):
    def __init__(self, clock: Clock, training: float = 0, validation: float = 0) -> None:
        super().__init__()
        self.clock, self.naps = clock, (training, validation)

    def training_step(self, batch, index):
        self.clock.nap(self.naps[0])
        return super().training_step(torch.ones(1, 32), index)

    def validation_step(self, batch, index):
        self.clock.nap(self.naps[1])


class SlowSaver(Callback):
    """Writes a checkpoint before the third batch of each four, as `Checkpoints` does, in ten seconds."""

    def on_train_batch_start(self, trainer, pl_module, batch, index) -> None:
        if index % 4 == 2:
            trainer.save_checkpoint(Path(trainer.default_root_dir) / "last.ckpt")
            pl_module.clock.nap(10)


def speeds(module: Sleeper, nap: float = 0, others: tuple[Callback, ...] = (), **options) -> list[dict[str, float]]:
    """Return the logged rows of one epoch of eight batches of two scenes. Loading a batch takes `nap` seconds."""
    memory = MagicMock(spec=Logger)
    settings = {"logger": memory, "callbacks": [Throughput(), *others], "num_sanity_val_steps": 0}
    trainer = quiet_trainer(max_epochs=1, **settings, **{"log_every_n_steps": 2, **options})
    batches = DataLoader(range(8), collate_fn=lambda _: module.clock.nap(nap) or scene_batch())
    trainer.fit(module, batches, DataLoader(range(8)) if "val_check_interval" in options else None)
    rows = [call.kwargs["metrics"] | {"step": call.kwargs["step"]} for call in memory.log_metrics.call_args_list]
    return [row for row in rows if "speed/scenes_per_second" in row]


SAVING = {"others": (SlowSaver(),), "log_every_n_steps": 4}
# Seconds of a batch's training, validation and loading, settings, steps of the rows, scenes a second, share of waiting.
SPEEDS = {
    "waiting for data is measured": ((3, 0, 1), {}, [1, 3, 5, 7], 2 / 4, 1 / 4),
    "validation between two rows is not counted": ((1, 5, 0), {"val_check_interval": 2}, [1, 3, 5, 7], 2, 0),
    "validation in the midst of a row is not counted": ((1, 5, 0), {"val_check_interval": 1}, [1, 3, 5, 7], 2, None),
    "writing checkpoints is not counted": ((1, 0, 0), SAVING, [3, 7], 2, 0),
    "a row of one batch has no wait": ((2, 0, 1), {"log_every_n_steps": 1}, range(8), 1, None),
    "accumulated batches are counted once": ((1, 0, 0), {"accumulate_grad_batches": 2}, [1, 3], 2, 0),
}


@pytest.mark.parametrize("fact", SPEEDS)
def test_speeds(clock, tmp_path, fact):
    (training, validation, loading), settings, steps, speed, waiting = SPEEDS[fact]
    rows = speeds(Sleeper(clock, training, validation), loading, default_root_dir=tmp_path, **settings)
    assert [row["step"] for row in rows] == list(steps)
    assert [row["speed/scenes_per_second"] for row in rows] == [pytest.approx(speed)] * len(rows)
    assert {row.get("speed/data_wait") for row in rows} == {waiting}
    assert (tmp_path / "last.ckpt").is_file() == ("others" in settings)


def test_memory_is_that_of_a_process_with_torch(clock):
    before = memory(torch.device("cpu"))
    assert speeds(Sleeper(clock, training=1))[-1].keys() > before.keys() == {"memory/process_gb"}
    ballast = torch.ones(2**27)  # half a GiB
    assert memory(torch.device("cpu"))["memory/process_gb"] - before["memory/process_gb"] == pytest.approx(0.5, abs=0.2)
    del ballast


class Drawer(BoringModel):
    """A module that draws a random number in every step, after `others` further draws."""

    def __init__(self, others: int = 0) -> None:
        super().__init__()
        self.others = others
        self.drawn = []

    def on_train_batch_end(self, *_) -> None:
        torch.rand(self.others)

    def training_step(self, batch, index):
        self.drawn.append(torch.rand(()).item())
        return super().training_step(torch.ones(1, 32), index)


def drawn(seed: int, others: int = 0) -> list[float]:
    """Return the numbers of three epochs of four batches; two batches share an optimizer step."""
    module = Drawer(others)
    trainer = quiet_trainer(max_epochs=3, accumulate_grad_batches=2, callbacks=[StepSeeds(seed)])
    trainer.fit(module, DataLoader(range(4), generator=torch.Generator()))
    return module.drawn


def test_every_batch_draws_its_own_numbers_whatever_else_is_drawn():
    first = drawn(0)
    again = drawn(0, others=5)
    other_seed = drawn(1)
    assert first == again
    assert len({*first, *other_seed}) == 2 * 12
    seeds = {callbacks.step_seed(*place) for place in itertools.product(range(3), repeat=4)}
    assert len(seeds) == 3**4
    assert all(0 <= seed < 2**64 for seed in seeds)


class Watched(Callback):
    """Notes what the bar shows after each batch."""

    def __init__(self, bar: Progress) -> None:
        self.bar = bar
        self.shown = []

    def on_train_batch_end(self, trainer, pl_module, *_) -> None:
        task = self.bar.train_progress_bar
        figures = self.bar.get_metrics(trainer, pl_module)
        assert "step" not in figures  # the bar's own numbers, which are never a second old
        self.shown.append((task.description, task.completed, task.total, round(figures["train/loss"], 4)))


class Telling(BoringModel):
    def training_step(self, batch, index):
        self.log("train/loss", 0.5 * index)
        return super().training_step(batch, index)


def test_the_bar_is_the_whole_runs_and_shows_the_first_steps_loss():
    bar = Progress()
    watched = Watched(bar)
    settings = {"max_steps": 5, "max_epochs": -1, "val_check_interval": 4, "check_val_every_n_epoch": None}
    settings |= {"accumulate_grad_batches": 2, "limit_val_batches": 1, "num_sanity_val_steps": 0}
    trainer = quiet_trainer(**settings, callbacks=[bar, watched], enable_progress_bar=True)
    trainer.fit(Telling(), DataLoader(torch.zeros(4, 32)), DataLoader(torch.zeros(4, 32)))
    steps = [0, 1, 1, 2, 2, 3, 3, 4, 4, 5]  # of two batches each, two in an epoch
    assert watched.shown == [("Training", s, 5, 0.5 * (i % 4)) for i, s in enumerate(steps)]


def test_figures_are_read_once_a_second_because_that_waits_for_a_gpu(clock, monkeypatch):
    read = []
    monkeypatch.setattr(Progress, "get_metrics", lambda *_: read.append(clock()) or {})
    trainer = quiet_trainer(max_epochs=1, callbacks=[Progress()], enable_progress_bar=True, limit_val_batches=0)
    trainer.fit(Sleeper(clock, training=0.4), DataLoader(range(8)))
    assert read == pytest.approx([100.4, 101.6, 102.8])


def test_averages_move_to_the_gpu_with_the_module():
    """Lightning makes them before, on the CPU."""
    average = ExponentialMovingAverage(0.9)
    trainer = quiet_trainer()
    average.setup(trainer, BoringModel(), "fit")
    average.on_fit_start(trainer, BoringModel().to("meta"))
    assert {x.device.type for x in average._average_model.state_dict().values()} == {"meta"}
