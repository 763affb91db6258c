from dataclasses import replace

import pytest
import torch
from support import some_gaussians

from completesplat.export.cleaning import widened
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer

SIZE = 32
CAMERA = Cameras(torch.eye(4), pinhole(40.0, SIZE), (SIZE, SIZE))
WITHOUT_BLUR = ReferenceRasterizer(replace(RenderingConstants(), blur=1e-6))


def on_the_axis(scales: list[float], depth: float) -> Gaussians:
    one = some_gaussians(1)[0][:1]
    return replace(
        one,
        means=torch.tensor([[0.0, 0.0, depth]]),
        scales=torch.tensor([scales]),
        quaternions=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
    )


@pytest.mark.parametrize("depth", [0.7, 3.0])
@pytest.mark.parametrize("scales", [[1e-4, 1e-4, 1e-4], [0.05, 0.002, 0.01]])
def test_a_picture_without_blur_is_the_one_that_training_saw_with_it(scales, depth):
    gaussians = on_the_axis(scales, depth)
    seen = ReferenceRasterizer()(gaussians[None], CAMERA[None, None]).over(0.5)
    drawn = WITHOUT_BLUR(widened(gaussians, CAMERA)[None], CAMERA[None, None]).over(0.5)
    assert (seen - 0.5).abs().max() > 0.01
    assert torch.allclose(seen, drawn, atol=2e-4)


def test_nothing_but_the_size_changes_and_it_only_grows():
    gaussians = some_gaussians(1)[0]
    gaussians = replace(gaussians, means=gaussians.means + torch.tensor([0.0, 0.0, 2.0]))
    wide = widened(gaussians, CAMERA)
    assert (wide.scales > gaussians.scales).all()
    for name in ("means", "quaternions", "opacities", "colors"):
        assert torch.equal(getattr(wide, name), getattr(gaussians, name))
