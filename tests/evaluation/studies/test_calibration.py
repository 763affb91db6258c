"""Calibration of samples whose distribution is known."""

import math
from dataclasses import dataclass

import imageio.v3 as imageio
import pytest
import torch

from completesplat.evaluation.studies.calibration import calibration_rows, energies, plot_calibration
from completesplat.evaluation.studies.samples import SampleRenderer
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.metrics.proper_scores import energy_score
from completesplat.scene import SceneBatch, Views

SIZE, SAMPLES = 32, 8


def drawn(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def scene(seed: int) -> SceneBatch:
    """A wall at depth 2 with normally distributed values in all views; the last target looks the other way."""
    poses = torch.eye(4).repeat(1, 4, 1, 1)
    poses[:, 3] *= torch.tensor([-1.0, 1, -1, 1])[:, None]
    cameras = Cameras(poses, pinhole(60, SIZE).repeat(1, 4, 1, 1), (SIZE, SIZE))
    depths = torch.full((1, 4, 1, SIZE, SIZE), 2.0)
    views = Views(drawn(1, 4, 3, SIZE, SIZE, seed=seed), cameras, torch.ones_like(depths), depths)
    visible, frame = torch.ones(1, 1, SIZE, SIZE), torch.zeros(1, dtype=torch.int64)
    return SceneBatch(views[:, 0], views[:, 1:], torch.tensor([[1.0, 4]]), visible, frame, (f"{seed}",))


@dataclass(frozen=True)
class Normal(SampleRenderer):
    """Samples from the truth's distribution, `scale` times as wide."""

    scale: float = 1.0

    def __call__(self, scene: SceneBatch, seed: int) -> torch.Tensor:
        return self.scale * drawn(self.samples, 4, 3, SIZE, SIZE, seed=1000 + seed)


def measured(scale: float, samples: int = SAMPLES):
    full, hidden = calibration_rows(Normal(None, None, 0.5, samples, 0, scale), [scene(0), scene(1)], lambda _: None)
    assert (full["region"], full["scenes"], hidden["region"], hidden["scenes"]) == ("full", 2, "hidden", 2)
    return full, hidden


@pytest.mark.parametrize("samples", [2, 5, 8])
def test_samples_of_the_true_distribution_are_calibrated(samples):
    for row in measured(1, samples):
        assert row["ranks"] == pytest.approx([1 / (samples + 1)] * (samples + 1), abs=0.02)
        assert (row["below_all"], row["above_all"]) == (row["ranks"][0], row["ranks"][-1])
        assert row["spread_over_error"] == pytest.approx(1, abs=0.04)
        assert row["spread"] == pytest.approx(math.sqrt(1 + 1 / samples), abs=0.04)
        assert len(row["bins"]) == 10
        # All values have the same variance. Bins chosen by the variance of the same samples would differ by chance.
        for spread, error in row["bins"] if samples > 3 else ():
            assert spread == pytest.approx(error, rel=0.1)


def test_samples_of_half_the_spread_are_overconfident():
    for row in measured(0.5):
        assert row["spread_over_error"] == pytest.approx(math.sqrt(0.25 * (SAMPLES + 1) / (SAMPLES + 0.25)), abs=0.02)
        lowest, *inner, highest = row["ranks"]
        assert min(lowest, highest) > 0.2 > 0.1 > max(inner)
        assert sorted(inner[:4], reverse=True) == inner[:4]
    wide, _ = measured(2)
    assert wide["spread_over_error"] > 1.5
    assert max(wide["below_all"], wide["above_all"]) < 0.05


def test_the_energy_score_does_not_depend_on_the_number_of_samples():
    truth, samples = drawn(3000, seed=0), drawn(6, 3000, seed=1)
    scores = energies(samples, truth)
    assert list(scores) == ["energy_2", "energy_4", "energy_6"]
    # Distances are sqrt(2) per value: for any number of samples sqrt(2) - sqrt(2) / 2.
    assert list(scores.values()) == pytest.approx([math.sqrt(0.5)] * 3, abs=0.03)
    assert energies(samples[:4], truth)["energy_4"] == scores["energy_4"] == energy_score(samples[:4], truth)


def test_samples_without_spread_have_a_figure(tmp_path):
    results = calibration_rows(Normal(None, None, 0.5, 2, 0, 0.0), [scene(0)], lambda _: None)
    assert [row["spread"] for row in results] == [0, 0]
    plot_calibration(results, tmp_path / "calibration.png", "title")
    assert imageio.imread(tmp_path / "calibration.png").ndim == 3
