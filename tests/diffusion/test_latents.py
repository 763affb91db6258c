import pytest
import torch

from completesplat.diffusion.latents import measure_scale


def test_scale_gives_unit_standard_deviation():
    torch.manual_seed(0)
    images = [torch.randn(n, 3, 4, 4) * 3 + 1 for n in (2, 5, 1)]
    scale = measure_scale(lambda image: image, images)
    everything = torch.cat(images)
    assert (everything * scale).std(correction=0).item() == pytest.approx(1, abs=1e-5)


@pytest.mark.parametrize("images", [[], [torch.ones(2, 3, 4, 4)]])
def test_latents_without_variation_are_refused(images):
    with pytest.raises(ValueError, match="do not vary"):
        measure_scale(lambda image: image, images)
