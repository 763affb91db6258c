"""Splatter Images made of Gaussians give these Gaussians back."""

from dataclasses import replace

import pytest
import torch

from completesplat.baselines.preoptimized import project_to_splatter_image
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.geometry.rotations import normalize_quaternion
from completesplat.splatter_image import CHANNELS, Parameterization, SplatterImage

HEIGHT = 4
WIDTH = 4
BATCH = 2
DEPTH_RANGE = torch.tensor([[1.0, 3.0], [0.5, 6.0]])
# The world is elsewhere: only the intrinsics matter.
ELSEWHERE = torch.tensor([[0.0, 1, 0, 5], [-1, 0, 0, 1], [0, 0, 1, -9], [0, 0, 0, 1]])
CAMERAS = Cameras(ELSEWHERE.expand(BATCH, 4, 4), pinhole(60.0, WIDTH).expand(BATCH, 3, 3), (HEIGHT, WIDTH))
ONE = CAMERAS[:1]
RANGE = DEPTH_RANGE[:1]


def at(points: list[tuple[float, float, float]], opacities: list[float]) -> Gaussians:
    """Gaussians of one scene, at (column, row, depth), with different looks."""
    pixels = torch.tensor([points])
    focal = ONE.intrinsics[0, 0, 0]
    means = torch.cat([(pixels[..., :2] - WIDTH / 2) / focal * pixels[..., 2:], pixels[..., 2:]], dim=-1)
    draws = torch.Generator().manual_seed(0)
    rotations, scales, colors = (torch.rand(1, len(points), n, generator=draws) for n in (4, 3, 3))
    return Gaussians(means, normalize_quaternion(rotations * 2 - 1), 0.01 + scales, torch.tensor([opacities]), colors)


def assert_equal(result: Gaussians, expected: Gaussians) -> None:
    torch.testing.assert_close(vars(result), vars(expected), atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("layer_depths", ["independent", "incremental"])
def test_a_splatter_image_comes_back(layer_depths):
    parameterization = Parameterization(layers=1, layer_depths=layer_depths)
    raw = torch.randn(BATCH, 1, CHANNELS, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0))
    raw[:, :, 1:4] *= 0.01  # offsets that leave every Gaussian in its pixel
    raw[:, :, 5:8] -= 3
    gaussians = SplatterImage(raw, parameterization).gaussians(CAMERAS, DEPTH_RANGE)
    # In another order, it is the place that counts.
    shuffled = gaussians[:, torch.randperm(gaussians.count, generator=torch.Generator().manual_seed(1))]
    image, empty = project_to_splatter_image(shuffled, CAMERAS, DEPTH_RANGE, parameterization)
    assert not empty.any()
    assert_equal(image.gaussians(CAMERAS, DEPTH_RANGE), gaussians)


@pytest.mark.parametrize("layer_depths", ["independent", "incremental"])
@pytest.mark.parametrize("layers", [1, 3])
def test_of_several_in_a_pixel_the_most_opaque_stay(layers, layer_depths):
    # The most opaque lies behind, the last beyond the depth range: the offset makes up for both.
    gaussians = at([(1.2, 2.9, 1.1), (1.5, 2.5, 2.0), (1.7, 2.1, 2.5), (1.5, 2.2, 9.0)], [0.2, 0.3, 0.9, 0.6])
    parameterization = Parameterization(layers=layers, layer_depths=layer_depths)
    image, empty = project_to_splatter_image(gaussians, ONE, RANGE, parameterization)
    result = image.gaussians(ONE, RANGE)
    pixel = torch.arange(layers) * HEIGHT * WIDTH + 2 * WIDTH + 1
    assert_equal(result[:, pixel], gaussians[:, torch.tensor([2, 3, 1])[:layers]])
    assert (result.opacities > 1e-12).sum() == layers
    assert empty.sum() == HEIGHT * WIDTH - 1
    assert not empty[0, 2, 1]


def test_what_the_camera_does_not_see_fills_no_pixel():
    behind = (2.5, 2.5, -2.0)
    left = (-0.01, 1.0, 2.0)
    below = (1.0, HEIGHT + 0.01, 2.0)
    invisible = (0.5, 0.5, 2.0)
    gaussians = at([behind, left, below, invisible], [0.9, 0.9, 0.9, 0.0039])
    image, empty = project_to_splatter_image(gaussians, ONE, RANGE, Parameterization())
    assert empty.all()
    assert (image.gaussians(ONE, RANGE).opacities < 1e-12).all()
    corner = replace(gaussians, opacities=torch.tensor([[0.9, 0.9, 0.9, 0.004]]))
    assert not project_to_splatter_image(corner, ONE, RANGE, Parameterization())[1][0, 0, 0]


def test_scenes_of_a_batch_stay_apart():
    one = at([(0.5, 0.5, 2.0)], [1.0])
    other = at([(2.5, 1.5, 1.5)], [0.4])
    both = Gaussians(*(torch.cat(pair) for pair in zip(vars(one).values(), vars(other).values(), strict=True)))
    image, empty = project_to_splatter_image(both, CAMERAS, DEPTH_RANGE, Parameterization(layers=1))
    assert image.raw.isfinite().all()  # for full opacity too
    result = image.gaussians(CAMERAS, DEPTH_RANGE)
    assert_equal(result[:1, :1], one)
    assert_equal(result[1:, [WIDTH + 2]], other)
    assert empty.sum(dim=(1, 2)).tolist() == [HEIGHT * WIDTH - 1] * 2
