import pytest
import torch

from completesplat.diffusion.guidance import guided_noise
from completesplat.errors import CompleteSplatError

LATENT = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0))
FEATURES = torch.randn(2, 3, 8, 8, generator=torch.Generator().manual_seed(1))
STEP = torch.tensor([5, 7])


class Counting:
    """A denoiser that depends on all of its inputs and counts its calls and samples."""

    def __init__(self) -> None:
        self.calls = self.samples = 0

    def __call__(self, latent, timestep, conditioning):
        self.calls, self.samples = self.calls + 1, self.samples + len(latent)
        return latent * 2 + conditioning.sum(1, keepdim=True) + timestep.view(-1, 1, 1, 1)


def predicted(features):
    return Counting()(LATENT, STEP, features)


def test_at_either_end_it_is_one_prediction_in_one_call_and_linear_between():
    conditioned = predicted(FEATURES)
    free = predicted(torch.zeros_like(FEATURES))
    for weight, expected in ((0.0, conditioned), (1.0, free)):
        denoise = Counting()
        torch.testing.assert_close(guided_noise(denoise, LATENT, STEP, FEATURES, weight), expected)
        assert (denoise.calls, denoise.samples) == (1, 2)
    guided = guided_noise(Counting(), LATENT, STEP, FEATURES, 0.2)
    torch.testing.assert_close(guided, torch.lerp(free, conditioned, 0.8))  # one minus the weight: the customary scale


@pytest.mark.parametrize("weight", [-0.1, 7.5, float("nan")])
def test_a_weight_outside_of_0_to_1_is_refused(weight):
    denoise = Counting()
    with pytest.raises(CompleteSplatError, match=f"guidance_weight={weight:g}: must lie between 0 and 1"):
        guided_noise(denoise, LATENT, STEP, FEATURES, weight)
    assert denoise.calls == 0
