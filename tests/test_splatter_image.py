import math

import pytest
import torch
from torch import nn

from completesplat.geometry.cameras import Cameras, pinhole, project
from completesplat.splatter_image import CHANNELS, GROUPS, Parameterization, SplatterImage, initialize_head

SIZE = 6
CAMERA = Cameras(torch.eye(4)[None], pinhole(50.0, SIZE)[None], (SIZE, SIZE))
RANGE = torch.tensor([[1.0, 5.0]])


def image_of(layers: int = 2, depths: str = "independent", **raw: torch.Tensor | float) -> SplatterImage:
    """A Splatter Image whose groups have the given raw values, and the head's bias elsewhere."""
    parts = [
        torch.as_tensor(raw.get(name, group.bias), dtype=torch.float32).expand(1, layers, group.channels, SIZE, SIZE)
        for name, group in GROUPS.items()
    ]
    return SplatterImage(torch.cat(parts, dim=2), Parameterization(layers, depths))


def test_fifteen_channels_in_the_papers_order():
    assert CHANNELS == 15
    assert [(name, group.channels) for name, group in GROUPS.items()] == [
        ("depth", 1), ("offset", 3), ("opacity", 1), ("scale", 3), ("rotation", 4), ("color", 3),
    ]  # fmt: skip


def test_closed_forms_at_the_heads_bias():
    gaussians = image_of().gaussians(CAMERA, RANGE)
    assert gaussians.count == 2 * SIZE * SIZE
    torch.testing.assert_close(gaussians.means[..., 2], torch.full((1, 72), 3.0))
    torch.testing.assert_close(gaussians.opacities, torch.full((1, 72), 1 / (1 + math.exp(2))))
    torch.testing.assert_close(gaussians.scales, torch.full((1, 72, 3), 0.02))
    torch.testing.assert_close(gaussians.colors, torch.full((1, 72, 3), 0.5))
    torch.testing.assert_close(gaussians.quaternions, torch.tensor([1.0, 0, 0, 0]).expand(1, 72, 4))


def test_each_gaussian_projects_onto_its_own_pixel():
    pixels, depth = project(CAMERA, image_of(depth=0.7).gaussians(CAMERA, RANGE).means)
    rows, columns = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    expected = torch.stack([columns, rows], -1).reshape(-1, 2).repeat(2, 1)
    torch.testing.assert_close(pixels[0], expected)
    torch.testing.assert_close(depth, torch.full((1, 72), 1 + 4 / (1 + math.exp(-0.7))))


def test_offset_is_linear_and_in_the_camera_frame():
    offset = torch.tensor([0.3, -0.2, 0.1])
    moved = image_of(offset=offset.view(1, 1, 3, 1, 1)).gaussians(CAMERA, RANGE).means
    torch.testing.assert_close(moved - image_of().gaussians(CAMERA, RANGE).means, offset.expand(1, 72, 3))


def test_color_is_the_zeroth_harmonic_cut_at_black():
    raw = torch.tensor([1.0, -5.0, 0.0]).view(1, 1, 3, 1, 1)
    color = image_of(color=raw).gaussians(CAMERA, RANGE).colors[0, 0]
    torch.testing.assert_close(color, torch.tensor([0.5 + 1 / (2 * math.sqrt(math.pi)), 0.0, 0.5]))


@pytest.mark.parametrize(("raw", "expected"), [(-100.0, 1e-4), (100.0, 2.0), (0.0, 1.0)])
def test_scale_is_exponential_within_its_range(raw, expected):
    torch.testing.assert_close(
        image_of(scale=raw).gaussians(CAMERA, RANGE).scales[0, 0], torch.full((3,), expected), rtol=1e-5, atol=0
    )


def test_scale_keeps_its_gradient_inside_the_range():
    image = image_of(scale=-3.0)
    raw = image.raw.clone().requires_grad_()
    SplatterImage(raw, image.parameterization).gaussians(CAMERA, RANGE).scales.log().sum().backward()
    torch.testing.assert_close(raw.grad[:, :, 5:8], torch.ones(1, 2, 3, SIZE, SIZE))


def test_incremental_layers_lie_behind_each_other():
    raw = torch.linspace(-3, 2, 3).view(1, 3, 1, 1, 1)
    depth = image_of(3, "incremental", depth=raw).gaussians(CAMERA, RANGE).means[..., 2].reshape(3, -1)
    torch.testing.assert_close(depth[0], torch.full((36,), 1 + 4 / (1 + math.exp(3))))
    torch.testing.assert_close(depth[1] - depth[0], torch.full((36,), math.exp(-0.5)))
    torch.testing.assert_close(depth[2] - depth[1], torch.full((36,), math.exp(2.0)))


def test_independent_layers_share_no_depth():
    raw = torch.tensor([1.0, -1.0]).view(1, 2, 1, 1, 1)
    depth = image_of(depth=raw).gaussians(CAMERA, RANGE).means[..., 2].reshape(2, -1)
    assert (depth[1] < depth[0]).all()


def test_zero_rotation_is_the_identity_with_a_finite_gradient():
    image = image_of(rotation=0.0)
    raw = image.raw.clone().requires_grad_()
    gaussians = SplatterImage(raw, image.parameterization).gaussians(CAMERA, RANGE)
    gaussians.covariances().sum().backward()
    torch.testing.assert_close(gaussians.quaternions[0, 0], torch.tensor([1.0, 0, 0, 0]))
    assert raw.grad.isfinite().all()


def test_head_initialization_by_group():
    torch.manual_seed(0)
    settings = Parameterization(layers=2)
    head = nn.Conv2d(64, settings.channels, 3)
    initialize_head(head, settings)
    row = 0
    for _ in range(2):
        for group in GROUPS.values():
            weights, bias = head.weight[row : row + group.channels], head.bias[row : row + group.channels]
            bound = group.gain * math.sqrt(6 / (64 * 9 + group.channels * 9))
            assert weights.abs().max() <= bound
            assert weights.abs().max() > 0.95 * bound
            assert (bias == group.bias).all()
            row += group.channels
    assert row == settings.channels
