"""Gaussians that files can hold, and that viewers draw without gaps."""

from dataclasses import replace

import pytest
import torch
from support import some_gaussians

from completesplat.errors import CompleteSplatError
from completesplat.export.cleaning import cleaned, storable, with_screen_space_dilation
from completesplat.gaussians import merge_gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer

SIZE = 32
CAMERA = Cameras(torch.eye(4), pinhole(40.0, SIZE), (SIZE, SIZE))
WITHOUT_BLUR = ReferenceRasterizer(replace(RenderingConstants(), blur=1e-6))


@pytest.fixture
def whole():
    """Six Gaussians, each in a place of its own."""
    return replace(merge_gaussians([some_gaussians(1)[0]] * 3), means=torch.arange(18.0).view(6, 3))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("quaternions", float("nan")),
        ("opacities", -float("inf")),
        ("means", 1e30),  # its square is beyond float32
        ("scales", 0.0),
        ("scales", 1e-60),  # nothing is left of it in float32
    ],
)
def test_broken_gaussians_are_removed_and_counted(caplog, whole, field, value):
    whole = whole.to(torch.float64)
    damaged = getattr(whole, field).clone()
    damaged.view(6, -1)[[1, 4], -1] = value
    broken = replace(whole, **{field: damaged})
    assert storable(broken).tolist() == [True, False, True, True, False, True]
    assert torch.equal(cleaned(broken, "photo.jpg: sample 0").means, broken.means[[0, 2, 3, 5]])
    assert caplog.messages == ["photo.jpg: sample 0: left out 2 of 6 Gaussians (not finite, or no extent)"]


def test_a_set_without_a_fault_stays_and_one_of_nothing_else_is_refused(caplog, whole):
    assert cleaned(whole, "x") is whole
    assert cleaned(whole[:0], "x").count == 0
    assert caplog.messages == []
    with pytest.raises(CompleteSplatError, match=r"photo: all 6 Gaussians are broken"):
        cleaned(replace(whole, opacities=whole.opacities * torch.nan), "photo")


@pytest.mark.parametrize("depth", [0.7, 3.0])
@pytest.mark.parametrize("scales", [[1e-4, 1e-4, 1e-4], [0.05, 0.002, 0.01]])
def test_an_image_without_blur_equals_the_one_with_blur_in_training(scales, depth):
    there = {"means": torch.tensor([[0, 0, depth]]), "scales": torch.tensor([scales])}
    gaussians = replace(some_gaussians(1)[0][:1], **there)
    dilated = with_screen_space_dilation(gaussians, CAMERA)
    seen = ReferenceRasterizer()(gaussians[None], CAMERA[None, None]).over(0.5)
    drawn = WITHOUT_BLUR(dilated[None], CAMERA[None, None]).over(0.5)
    assert (seen - 0.5).abs().max() > 0.01
    assert torch.allclose(seen, drawn, atol=2e-4)
    assert (dilated.scales > gaussians.scales).all()
    for name in ("means", "quaternions", "opacities", "colors"):
        assert torch.equal(getattr(dilated, name), getattr(gaussians, name))
