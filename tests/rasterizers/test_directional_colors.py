"""Colours that depend on the direction, drawn by every backend."""

import pytest
import torch
from rasterizer_scenes import CONSTANTS, scenes
from support import round_gaussians

from completesplat.gaussians import DirectionalGaussians
from completesplat.geometry.cameras import Cameras, look_at, pinhole
from completesplat.geometry.rotations import quaternion_to_matrix
from completesplat.rasterizers import Rasterizer
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.tiled import TiledRasterizer


def directional(seed: int, degree: int = 1) -> tuple[DirectionalGaussians, Cameras]:
    gaussians, cameras = scenes(seed, 2, 3, (14, 17), CONSTANTS, count=12)
    count = (degree + 1) ** 2 - 1
    values = 0.3 * torch.randn(2, gaussians.count, count, 3, generator=torch.Generator().manual_seed(seed))
    return DirectionalGaussians(**vars(gaussians), harmonics=values), cameras


@pytest.mark.parametrize("rasterizer", [ReferenceRasterizer(), TiledRasterizer()])
def test_opposite_sides_of_a_gaussian_have_opposite_slopes(rasterizer: Rasterizer) -> None:
    """Degree 1: the colour along d is the mean plus a linear function of d, which has opposite values from behind."""
    slope = torch.tensor([0.1, -0.2, 0.3])
    first = (3 / (4 * torch.pi)) ** 0.5
    harmonics = torch.zeros(1, 1, 3, 3)
    harmonics[0, 0, 1] = slope / first  # times z
    gaussian = DirectionalGaussians(**vars(round_gaussians(torch.zeros(1, 1, 3), 0.3, 0.99, 0.5)), harmonics=harmonics)
    eyes = torch.tensor([[0.0, 0, -3], [0, 0, 3], [3, 0, 0]])
    poses = look_at(eyes, torch.zeros(3), torch.tensor([0.0, -1, 0]))
    rendering = rasterizer(gaussian, Cameras(poses[None], pinhole(30, 9).expand(1, 3, 3, 3), (9, 9)))
    color = (rendering.color / rendering.alpha)[0, :, :, 4, 4]
    expected = 0.5 + torch.tensor([1.0, -1, 0])[:, None] * slope
    torch.testing.assert_close(color, expected, atol=1e-4, rtol=0)


@pytest.mark.parametrize("degree", [1, 2])
def test_tiled_images_and_gradients_are_the_references(degree: int) -> None:
    gaussians, cameras = directional(5, degree)
    gradients = []
    for rasterizer in (ReferenceRasterizer(), TiledRasterizer()):
        inputs = gaussians.map(lambda tensor: tensor.clone().requires_grad_())
        rendering = rasterizer(inputs, cameras)
        loss = (rendering.color * torch.linspace(0, 1, 17)).sum() + rendering.depth.sum() * 0.1
        gradients.append((rendering.color, *torch.autograd.grad(loss, list(vars(inputs).values()))))
    for one, other in zip(*gradients, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-3 * one.abs().max().item())
    assert gradients[0][-1].abs().max() > 0


@pytest.mark.parametrize("degree", [1, 2])
def test_a_moved_scene_looks_the_same_from_moved_cameras(degree: int) -> None:
    gaussians, cameras = directional(2, degree)
    motion = torch.eye(4).repeat(2, 1, 1)
    motion[:, :3, :3] = quaternion_to_matrix(torch.tensor([[0.3, -0.5, 0.7, 0.2], [0.9, 0.1, 0.3, -0.4]]))
    motion[:, :3, 3] = torch.tensor([[0.3, -1.0, 0.5], [2.0, 0.4, 0.1]])
    poses = cameras.world_to_camera @ torch.linalg.inv(motion)[:, None]
    moved = Cameras(poses, cameras.intrinsics, cameras.image_size)
    still, turned = (
        ReferenceRasterizer()(g, c).color for g, c in ((gaussians, cameras), (gaussians.transform(motion), moved))
    )
    torch.testing.assert_close(turned, still, atol=2e-3, rtol=0)
    assert not torch.allclose(ReferenceRasterizer()(gaussians, moved).color, still, atol=2e-2)


@pytest.mark.parametrize("name", ["means", "harmonics"])
def test_broken_gaussians_are_not_drawn_and_leave_the_others_gradients_whole(name: str) -> None:
    gaussians, cameras = directional(3)
    broken = gaussians.map(torch.clone)
    getattr(broken, name)[0, 0] = float("nan")
    without = gaussians.map(lambda tensor: tensor[:1, 1:].clone().requires_grad_())
    results = []
    for inputs in (broken.map(lambda tensor: tensor[:1].clone().requires_grad_()), without):
        color = TiledRasterizer()(inputs, cameras[:1]).color
        color.square().sum().backward()
        results.append((color, inputs.colors.grad, inputs.means.grad))
    (color, colors, means), (expected, other_colors, other_means) = results
    torch.testing.assert_close(color, expected)
    torch.testing.assert_close(colors[:, 1:], other_colors)
    torch.testing.assert_close(means[:, 1:], other_means)
    assert colors[:, 0].eq(0).all()
