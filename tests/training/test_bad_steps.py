"""Steps whose loss or gradients are not finite change nothing, and many in a row end the run."""

import subprocess
import sys

import pytest
import torch
from lightning.pytorch.demos.boring_classes import BoringModel
from lightning.pytorch.strategies import SingleDeviceStrategy
from scenes_for_training import quiet_trainer
from small_runs import Batches
from support import LIMIT, SMALL, strict_json

from completesplat.errors import DivergenceError
from completesplat.losses import WeightedSum
from completesplat.training.callbacks import BadSteps, ExponentialMovingAverage
from completesplat.training.checkpoints import CheckpointFiles, Checkpoints
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.training.stage import Stage

NAN = float("nan")
INFINITE = float("inf")
FAULTS = {
    "a loss that is NaN": lambda loss, weight: loss * NAN,
    "an infinite loss, whose gradients are finite": lambda loss, weight: loss + INFINITE,
    "one element of a gradient that is NaN": lambda loss, weight: loss + spoilt(weight, NAN),
    "one infinite element of a gradient": lambda loss, weight: loss + spoilt(weight, INFINITE),
    "finite gradients whose norm is not": lambda loss, weight: loss + 1e30 * weight.sum(),
}


def spoilt(weight: torch.Tensor, value: float) -> torch.Tensor:
    """Nothing, with a gradient that has one such element."""
    copy = weight[0, 0] * 1.0
    copy.register_hook(lambda gradient: gradient * value)
    return copy - copy.detach()


class Faulty(BoringModel):
    """A module that has a fault in the given batches and stores its weights after every batch."""

    def __init__(self, fault=None, batches=(), fused=False) -> None:
        super().__init__()
        self.fault = fault
        self.batches = batches
        self.fused = fused
        self.seen = []
        self.averages = []

    configure_gradient_clipping = Stage.configure_gradient_clipping  # Lightning's takes no fused optimizer
    gradient_norm = None

    def configure_optimizers(self):
        optimizer = torch.optim.AdamW(self.parameters(), lr=0.1, fused=self.fused)
        return [optimizer], [{"scheduler": torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.9), "interval": "step"}]

    def training_step(self, batch, index):
        loss = self.layer(batch).square().mean()
        self.log("train/mse", loss.detach())
        return self.fault(loss, self.layer.weight) if index in self.batches else loss

    def on_train_batch_end(self, *_):
        state = self.optimizers().state.get(self.layer.weight, {})
        self.seen.append([x.detach().clone() for x in (*self.parameters(), *state.values())])
        for average in (c for c in self.trainer.callbacks if isinstance(c, ExponentialMovingAverage)):
            self.averages.append([x.detach().clone() for x in average._average_model.module.parameters()])


def train(module, *callbacks, steps=12, accumulated=1, most=3, ckpt_path=None, **settings) -> BadSteps:
    torch.manual_seed(0)
    module.layer.reset_parameters()
    bad = BadSteps(most)
    settings |= {"accumulate_grad_batches": accumulated, "gradient_clip_val": 1.0, "plugins": [CheckpointFiles()]}
    settings["enable_checkpointing"] = any(isinstance(one, Checkpoints) for one in callbacks)
    trainer = quiet_trainer(max_steps=steps, callbacks=[bad, *callbacks], **settings)
    trainer.fit(module, Batches(), ckpt_path=ckpt_path, weights_only=True)
    return bad


def equal(one, other) -> bool:
    return len(one) == len(other) and all(torch.equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("fault", FAULTS)
def test_a_bad_step_changes_nothing_and_the_next_goes_on(fault, fused):
    module = Faulty(FAULTS[fault], (4, 5, 8), fused)
    bad = train(module, ExponentialMovingAverage(0.9), steps=12)
    assert (bad.total, bad.in_a_row) == (3, 0)
    changed = [not equal(one, other) for one, other in zip(module.seen[:-1], module.seen[1:], strict=True)]
    assert [batch for batch, different in enumerate(changed, start=1) if not different] == [4, 5, 8]
    assert all(x.isfinite().all() for x in module.seen[-1])
    assert module.trainer.global_step == 12
    assert module.lr_schedulers().last_epoch == 12
    average = module.averages[0]
    assert equal(average, module.seen[0][:2])
    for weights, averaged in zip(module.seen[1:], module.averages[1:], strict=True):
        average = [x.lerp(y, 0.1) for x, y in zip(average, weights[:2], strict=True)]
        torch.testing.assert_close(averaged, average)


class OnGpu(torch.Tensor):
    """Says that it is on a GPU, which nothing may read before it has arrived."""

    is_cuda = True
    arrived = True

    def __bool__(self) -> bool:
        assert OnGpu.arrived
        return self.item() != 0


class Arrival:
    """A stream, and an event on it."""

    def record_event(self) -> "Arrival":
        OnGpu.arrived = False
        return self

    def synchronize(self) -> None:
        OnGpu.arrived = True


def test_on_a_gpu_a_step_is_looked_at_in_the_next_until_one_was_bad(monkeypatch):
    looks = []
    reduce = SingleDeviceStrategy.reduce
    monkeypatch.setattr(SingleDeviceStrategy, "reduce", lambda *args, **kw: reduce(*args, **kw).as_subclass(OnGpu))
    monkeypatch.setattr("torch.cuda.current_stream", Arrival)
    monkeypatch.setattr(
        BadSteps, "_count", lambda bad, value, count=BadSteps._count: looks.append(value) or count(bad, value)
    )
    late, at_once = (Faulty(FAULTS["a loss that is NaN"], (4, 5, 8), fused=True) for _ in range(2))
    bad = train(late, ExponentialMovingAverage(0.9), steps=12)
    assert bad.total == 3
    assert looks == [False] * 4 + [True, True] + [False] * 2 + [True] + [False] * 3
    monkeypatch.undo()
    train(at_once, ExponentialMovingAverage(0.9), steps=12)
    assert all(equal(one, other) for one, other in zip(late.seen, at_once.seen, strict=True))


def test_a_run_without_bad_steps_is_as_it_would_be_without_the_callback(monkeypatch):
    watched = Faulty()
    free = Faulty()
    train(watched, ExponentialMovingAverage(0.9))
    monkeypatch.setattr(BadSteps, "on_before_optimizer_step", lambda *_: None)
    train(free, ExponentialMovingAverage(0.9))
    assert all(equal(one, other) for one, other in zip(watched.seen, free.seen, strict=True))


@pytest.mark.parametrize(("fault", "batch"), list(zip(FAULTS, (3, 4, 5, 3, 4), strict=True)))
def test_one_bad_batch_of_several_leaves_out_their_step(fault, batch):
    module = Faulty(FAULTS[fault], batches=(batch,))
    bad = train(module, ExponentialMovingAverage(0.9), steps=4, accumulated=3)
    assert bad.total == 1
    before = module.seen[2]
    after = module.seen[7]
    assert equal(before, after)
    assert not equal(after, module.seen[8])


def test_several_bad_steps_in_a_row_end_the_run_and_the_error_names_step_term_and_layer():
    module = Faulty(FAULTS["a loss that is NaN"], batches=(2, 3, 5, 6, 7, 8))
    with pytest.raises(
        DivergenceError, match=r"^step 7: 3 steps in a row .* gradients that of layer\.weight is the first"
    ):
        train(module)
    assert all(x.isfinite().all() for x in module.parameters())


@pytest.mark.parametrize("steps", [1, 5])
def test_a_shorter_run_also_ends_if_all_its_steps_were_bad(tmp_path, steps):
    module = Faulty(FAULTS["a loss that is NaN"], batches=range(5))
    with pytest.raises(DivergenceError, match=rf"^step {steps - 1}: {steps} steps in a row"):
        train(module, Checkpoints(str(tmp_path)), steps=steps, most=10)
    assert not list(tmp_path.iterdir())
    assert train(module, steps=6, most=10).total == 5


def test_a_run_whose_last_steps_were_bad_or_whose_weights_are_not_finite_has_no_checkpoint(tmp_path):
    with pytest.raises(DivergenceError, match=r"^step 5: 2 steps in a row"):
        train(Faulty(FAULTS["a loss that is NaN"], batches=(4, 5)), Checkpoints(str(tmp_path)), steps=6, most=10)
    assert not list(tmp_path.iterdir())

    with pytest.raises(DivergenceError, match=r"^step 5: 1 steps in a row"):
        train(Faulty(FAULTS["a loss that is NaN"], batches=(1, 3, 5)), Checkpoints(str(tmp_path)), steps=6, most=10)

    class Broken(Faulty):
        def optimizer_step(self, *arguments):
            super().optimizer_step(*arguments)
            if self.global_step == 5:
                self.layer.bias.data[0] = INFINITE

    with pytest.raises(DivergenceError, match=r"after 6 steps, layer\.bias is not finite"):
        train(Broken(), Checkpoints(str(tmp_path)), steps=6, most=10)
    assert not list(tmp_path.iterdir())


def test_the_count_goes_on_in_a_continued_run(tmp_path):
    def module() -> Faulty:
        return Faulty(FAULTS["a loss that is NaN"], batches=(5, 6))

    whole = module()
    first = module()
    second = module()
    assert train(whole, ExponentialMovingAverage(0.9), steps=5, accumulated=2).total == 2
    train(first, ExponentialMovingAverage(0.9), Checkpoints(str(tmp_path)), steps=3, accumulated=2)
    path = tmp_path / "last.ckpt"
    bad = train(second, ExponentialMovingAverage(0.9), steps=5, accumulated=2, ckpt_path=path)
    assert bad.total == 2
    assert equal(whole.seen[-1], second.seen[-1])


def test_no_checkpoint_of_weights_that_are_not_finite(tmp_path):
    """The update itself is too large: neither loss nor gradient was."""

    class TooFast(Faulty):
        def optimizer_step(self, *arguments):
            super().optimizer_step(*arguments)
            if self.global_step == 4:  # the fifth, which is not counted yet
                self.layer.bias.data[0] = INFINITE

    with pytest.raises(DivergenceError, match=r"step 5: layer\.bias is not finite; no checkpoint is written of it"):
        train(TooFast(), Checkpoints(str(tmp_path), every_n_train_steps=1), most=100)
    assert torch.load(tmp_path / "last.ckpt", weights_only=True)["global_step"] == 4


TWO_PROCESSES = """
import sys

sys.path += sys.argv[1:]

import torch

from test_bad_steps import FAULTS, Faulty, train


class OnOne(Faulty):
    def training_step(self, batch, index):
        loss = self.layer(batch).square().mean()
        return self.fault(loss, self.layer.weight) if index in self.batches and self.global_rank == 1 else loss


for name, fault in FAULTS.items():
    module = OnOne(fault, batches=(1, 2, 4))
    assert train(module, steps=6, devices=2, strategy="ddp").total == 3, name
    one, other = module.all_gather(module.layer.weight.detach())
    assert torch.equal(one, other) and one.isfinite().all(), name
"""


@pytest.mark.slow
def test_two_processes_leave_out_the_same_steps(tmp_path, request):
    program = tmp_path / "program.py"
    folders = request.path.parents[:2]
    program.write_text(TWO_PROCESSES)
    command = [sys.executable, str(program), *map(str, folders)]
    finished = subprocess.run(command, timeout=LIMIT, capture_output=True, text=True)
    assert finished.returncode == 0, finished.stderr


def fit(command, root, run, *settings):
    given = ["experiment=toy_var", f"data.root={root}", *SMALL, "callbacks.images=null", "test=false"]
    return command("fit", *given, "trainer.log_every_n_steps=1", *settings, f"out={run}")


def test_a_run_that_diverges_ends_with_one_line_and_keeps_its_checkpoint(command, toy_root, tmp_path, monkeypatch):
    step = ReconstructionModule.training_step

    def failing(self, scenes, index):
        loss = step(self, scenes, index)
        return loss * NAN if self.global_step >= 3 else loss

    monkeypatch.setattr(ReconstructionModule, "training_step", failing)
    settings = ["trainer.max_steps=8", "callbacks.checkpoint.every_n_train_steps=2", "trainer.limit_val_batches=0"]
    settings += ["callbacks.bad_steps.most_bad_steps=2"]
    finished = fit(command, toy_root, tmp_path / "run", *settings)
    assert finished.status == 1
    line = finished.err.splitlines()[-1]
    assert line.startswith("error: step 4: 2 steps in a row")
    assert "model." in line
    weights = torch.load(tmp_path / "run/checkpoints/last.ckpt", weights_only=True)["state_dict"]
    assert all(value.isfinite().all() for value in weights.values())
    assert "Traceback" not in finished.err


def test_a_run_with_one_bad_step_says_so_in_json_that_is_valid(command, toy_root, tmp_path, monkeypatch):
    """The last step is bad, so that its loss is among the results."""
    weighted = WeightedSum.__call__

    def failing(self, prediction, truth, step):
        total, terms = weighted(self, prediction, truth, step)
        return total * (NAN if step == 2 else 1.0), terms

    monkeypatch.setattr(WeightedSum, "__call__", failing)
    assert fit(command, toy_root, tmp_path / "run", "trainer.max_steps=3").status == 0
    result = strict_json(tmp_path / "run/metrics.json")
    assert result["train/bad_steps"] == 1
    assert result["train/loss"] is None
    assert "train/loss: nan" in result["not_finite"]
