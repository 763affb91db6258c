import csv

import pytest
import torch
from support import SMALL, some_gaussians

from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import Cameras
from completesplat.losses import Prediction, WeightedSum
from completesplat.scene import Views

IMAGES = torch.zeros(1, 1, 3, 4, 4)
PREDICTION = Prediction(IMAGES, some_gaussians(1), None)
CAMERAS = Cameras(torch.eye(4).expand(1, 1, 4, 4), torch.eye(3).expand(1, 1, 3, 3), (4, 4))
TRUTH = Views(IMAGES, CAMERAS, torch.ones(1, 1, 1, 4, 4))


class Constant:
    """A term that counts how often it is computed."""

    def __init__(self, value: float) -> None:
        self.value = value
        self.calls = 0

    def __call__(self, prediction: Prediction, truth: Views) -> torch.Tensor:
        self.calls += 1
        return torch.tensor(self.value)


@pytest.mark.parametrize(("step", "total", "names"), [(0, 0.5, {"a"}), (9, 0.5, {"a"}), (10, 6.5, {"a", "b"})])
def test_a_term_takes_part_from_its_start_step(step, total, names):
    late = Constant(3.0)
    terms = {"a": {"weight": 0.5, "term": Constant(1.0)}, "b": {"weight": 2.0, "term": late, "start_step": 10}}
    found, values = WeightedSum(terms)(PREDICTION, TRUTH, step)
    assert found.item() == pytest.approx(total)
    assert set(values) == names
    assert late.calls == ("b" in names)


@pytest.mark.parametrize(
    "terms",
    [
        {},
        {"a": None},
        {"a": {"weight": 0.0, "term": Constant(1.0)}},
        {"a": {"weight": 1.0, "term": Constant(1.0), "start_step": 1}},
    ],
    ids=["no terms", "a term taken away", "a term without weight", "a term that starts later"],
)
def test_a_sum_with_nothing_at_step_zero_is_refused(terms):
    with pytest.raises(CompleteSplatError, match="start_step=0"):
        WeightedSum(terms)


def test_training_counts_the_steps_of_the_optimizer(command, toy_root, tmp_path):
    settings = ["experiment=toy_var", f"data.root={toy_root}", *SMALL, "trainer.max_steps=3"]
    late = ["+loss.terms.ssim.start_step=2", "trainer.log_every_n_steps=1"]
    assert command("fit", *settings, *late, f"out={tmp_path / 'run'}").status == 0
    with open(tmp_path / "run" / "metrics.csv") as file:
        rows = [row for row in csv.DictReader(file) if row["train/mse"] and int(row["step"]) < 3]
    assert [(int(row["step"]), bool(row["train/ssim"])) for row in rows] == [(0, False), (1, False), (2, True)]
