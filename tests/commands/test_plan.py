"""`completesplat plan`: what a training takes here, measured on a few of its steps."""

import pytest
import torch
from support import NETWORKS, SMALL, compose_config, strict_json

from completesplat.commands import plan
from completesplat.commands.plan import measured_plan
from completesplat.errors import CompleteSplatError
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.settings.help import defaults
from completesplat.training.optimization import constant
from completesplat.training.stage import Stage
from completesplat.training.steps import Training, synthetic_batch

STAGE2 = ["experiment=toy_diffusion", "data.image_size=32", "data.batch_size=2", "timed_steps=1", *NETWORKS]


def test_figures_are_printed_and_written(command, tmp_path):
    finished = command.succeeds("plan", *STAGE2, f"data.root={tmp_path / 'absent'}", f"out={tmp_path / 'out'}")
    figures = strict_json(tmp_path / "out/plan.json")
    assert figures["batches"].startswith("noise")
    assert figures["seconds_a_step"] > 0
    assert figures["days"] == pytest.approx(figures["steps"] * figures["seconds_a_step"] / 86400)
    assert figures["steps"] == 4000
    assert all(name.replace("_", " ") in finished.out for name in figures if name != "machine")


@pytest.mark.slow
def test_sizes_are_those_of_the_files_that_a_run_writes(command, toy_root, tmp_path):
    small = [setting for setting in SMALL if setting not in NETWORKS]  # archives of few bytes are mostly their index
    settings = ["experiment=toy_var", "optimizer=adam", *small, "callbacks=ema", f"data.root={toy_root}"]
    command.succeeds("fit", *settings, "callbacks.images=null", "test=false", f"out={tmp_path}")
    files = {"weights_GB": "weights/*.safetensors", "checkpoint_GB": "checkpoints/last.ckpt"}
    figures = measured_plan(compose_config("plan", *settings, "timed_steps=1"))
    for figure, pattern in files.items():
        size = sum(path.stat().st_size for path in tmp_path.glob(pattern))
        assert figures[figure] * 1e9 == pytest.approx(size, rel=0.1), figure


def test_steps_read_the_data_that_are_there_and_epochs_are_theirs(toy_root, tmp_path):
    settings = ["experiment=toy_var", *SMALL, "timed_steps=1", "trainer.max_steps=-1", "+trainer.max_epochs=3"]
    there = measured_plan(compose_config("plan", *settings, f"data.root={toy_root}", "data.references_per_sequence=4"))
    sequences = len(list((toy_root / "toy_objects").glob("*/images"))) or 1
    assert there["batches"] == str(toy_root)
    assert 0 < there["steps"] <= 3 * 4 * sequences / 2
    assert there["steps"] % 3 == 0
    absent = measured_plan(compose_config("plan", *settings, f"data.root={tmp_path / 'absent'}"))
    assert (absent["steps"], absent["days"], absent["would_end"]) == (None, None, None)


@pytest.mark.parametrize(("experiment", "days", "steps"), [("var_stage1", 6, 322_000), ("diffusion", 2, 1_100_000)])
def test_the_papers_step_stands_beside_that_of_its_experiments(experiment, days, steps):
    config = compose_config("plan", f"experiment=paper_{experiment}")
    assert plan.papers_seconds(config) == pytest.approx(days * 86400 / steps, rel=0.01)
    assert plan.papers_seconds(compose_config("plan", "experiment=toy_var")) is None


def test_a_step_that_fails_is_refused_in_one_line(monkeypatch):
    def fail(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory.\nTried to allocate")

    monkeypatch.setattr(Training, "step", fail)
    with pytest.raises(CompleteSplatError) as caught:
        measured_plan(compose_config("plan", *STAGE2, "data.root=absent"))
    assert str(caught.value) == "a step fails: OutOfMemoryError: CUDA out of memory. Tried to allocate"


class MeanColour(Stage):
    """A stage with one layer on the mean colour of the reference image."""

    def __init__(self) -> None:
        super().__init__(ReferenceRasterizer(), torch.optim.SGD, constant)
        self.layer = torch.nn.Linear(3, 1)
        torch.nn.init.ones_(self.layer.weight)

    def training_step(self, scenes, index):
        return self.layer(scenes.reference.images.mean((2, 3))).square().mean()


def test_halves_of_a_batch_give_the_gradient_of_the_whole():
    scenes = synthetic_batch(8, 2, 1)
    gradients = []
    for batches in ([scenes], [scenes[:1], scenes[1:]]):
        torch.manual_seed(0)
        module = MeanColour()
        Training(module, "32-true").step(*batches)
        gradients.append(module.layer.weight.grad)
    assert gradients[0].abs().min() > 0
    torch.testing.assert_close(*gradients)


def test_it_takes_what_fit_takes():
    assert defaults("plan")[1] == defaults("fit")[1]
