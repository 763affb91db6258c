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


@pytest.mark.parametrize(("weight", "features"), [(0.0, FEATURES), (1.0, torch.zeros_like(FEATURES))])
def test_at_either_end_it_is_one_prediction_in_one_call(weight, features):
    denoise = Counting()
    torch.testing.assert_close(guided_noise(denoise, LATENT, STEP, FEATURES, weight), predicted(features))
    assert (denoise.calls, denoise.samples) == (1, 2)


@pytest.mark.parametrize("weight", [0.2, 0.5])
def test_between_it_is_linear_and_the_customary_scale_is_one_minus_the_weight(weight):
    guided = guided_noise(Counting(), LATENT, STEP, FEATURES, weight)
    customary = torch.lerp(predicted(torch.zeros_like(FEATURES)), predicted(FEATURES), 1 - weight)
    torch.testing.assert_close(guided, customary)


@pytest.mark.parametrize("weight", [-0.1, 7.5, float("nan")])
def test_a_weight_outside_of_0_to_1_is_refused(weight):
    denoise = Counting()
    with pytest.raises(CompleteSplatError, match=f"guidance_weight={weight:g}: must lie between 0 and 1"):
        guided_noise(denoise, LATENT, STEP, FEATURES, weight)
    assert denoise.calls == 0
