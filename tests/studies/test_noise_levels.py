"""Shares of the true mode for denoisers with known answers."""

import pytest
import torch
from diffusers import FlowMatchEulerDiscreteScheduler
from scenes_for_training import scene_batch
from torch import Tensor, nn

from completesplat.autoreconstructor.posterior import Posterior
from completesplat.data.hidden_modes import HiddenModeScenes
from completesplat.diffusion.sampling import Sampler
from completesplat.errors import CompleteSplatError, DataError
from completesplat.generator import CompleteSplat
from completesplat.scene import SceneBatch
from completesplat.studies import noise_levels
from completesplat.studies.noise_levels import LEVELS, noise_level_rows, scenes_in_all_modes

MODES, SHAPE, DISTANCE = 4, (2, 4, 4), 6.0
LATENTS = DISTANCE / 2**0.5 * torch.eye(MODES, 32).view(MODES, *SHAPE)  # all at this distance from one another


def exact(noisy: Tensor, time: float) -> Tensor:
    """Return the expected clean latents given the noisy ones."""
    distances = (noisy[:, None] - (1 - time) * LATENTS).square().flatten(2).sum(-1)
    return (-distances / (2 * time**2)).softmax(1) @ LATENTS.flatten(1)


def table(monkeypatch: pytest.MonkeyPatch, estimate) -> list[dict[str, float]]:
    """Return the rows of a denoiser whose clean latents are `estimate(noisy, time)`."""

    class Denoiser(nn.Module):
        def forward(self, noisy: Tensor, timestep: Tensor, condition: Tensor) -> Tensor:
            time = timestep[0].item() / 1000
            return (noisy - estimate(noisy, time).view_as(noisy)) / time

    model = CompleteSplat.__new__(CompleteSplat)
    nn.Module.__init__(model)
    model.denoiser, model.conditioning = Denoiser(), nn.Identity()
    model.sampler = Sampler(FlowMatchEulerDiscreteScheduler(num_train_timesteps=1000), steps=20)
    certain = Posterior(LATENTS, torch.full_like(LATENTS, -30.0))
    monkeypatch.setattr(noise_levels, "standardised", lambda model, versions: certain)
    return noise_level_rows(model, [scene_batch(), scene_batch()], draws=50, seed=0)


def test_an_exact_denoiser_has_the_best_share(monkeypatch):
    result = table(monkeypatch, exact)
    assert [row["denoiser_share"] for row in result] == pytest.approx([row["best_share"] for row in result], abs=1e-3)
    assert result[0]["best_share"] == pytest.approx(1, abs=1e-4)
    assert result[-1]["best_share"] == pytest.approx(0.25, abs=0.03)


def test_a_denoiser_that_blends_has_the_share_of_chance(monkeypatch):
    result = table(monkeypatch, lambda noisy, time: LATENTS.mean(0).expand_as(noisy))
    assert [row["denoiser_share"] for row in result] == pytest.approx([0.25] * len(LEVELS), abs=1e-3)


def test_timesteps_of_training_and_sampler_are_counted_once_each(monkeypatch):
    result = table(monkeypatch, exact)
    assert sum(row["training_share"] for row in result) == pytest.approx(1)
    assert sum(row["steps"] for row in result) == 20
    # The logistic of a standard normal lies below 0.5 in half of all draws.
    assert sum(row["training_share"] for row in result if row["level"] <= 0.5) == pytest.approx(0.5, abs=0.01)


class Scenes(HiddenModeScenes):
    """Four scenes, of which the second shows its hidden part."""

    def __init__(self) -> None:
        pass

    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> None:
        raise AssertionError("only scenes in all modes are wanted")

    def versions(self, index: int) -> SceneBatch:
        if index == 1:
            raise DataError("the reference view tells the patch's colour")
        return scene_batch()


def test_scenes_that_show_their_hidden_part_are_left_out():
    read = []
    assert len(scenes_in_all_modes(Scenes(), 2, lambda indices: (read.append(i) or i for i in indices))) == 2
    assert read[:3] == [0, 1, 2]
    with pytest.raises(CompleteSplatError, match="no test scene has a hidden part"):
        scenes_in_all_modes(Scenes(), 2, lambda indices: [1])
