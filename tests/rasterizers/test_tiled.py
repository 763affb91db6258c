"""The tiled rasterizer is the reference, faster: the same images and gradients on random scenes."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from rasterizer_scenes import CONSTANTS, OTHER_CONSTANTS, assert_agrees, cotangents_for, render_with_gradients, scenes

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.tiled import TiledRasterizer

SEEDS = [*range(28), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(28, 500))]


@pytest.mark.parametrize("seed", SEEDS)
def test_images_and_gradients_agree_with_the_float64_reference(seed: int) -> None:
    """On a scene of a size that depends on the seed; every other time with unusual constants."""
    sizes = [(13, 17), (16, 16), (9, 23), (31, 6), (1, 40), (24, 20), (7, 5)]
    constants = CONSTANTS if seed % 2 else OTHER_CONSTANTS
    batch, views = [(1, 2), (2, 3)][seed % 5 == 0]
    gaussians, cameras = scenes(seed, batch, views, sizes[seed % len(sizes)], constants)
    assert_agrees(TiledRasterizer(constants), constants, gaussians, cameras, seed)


@pytest.mark.parametrize("size", [(20, 300), (5, 517), (1, 1), (130, 3), (1, 18), (15, 1), (4, 4)])
def test_images_of_any_size(size: tuple[int, int]) -> None:
    gaussians, cameras = scenes(sum(size), 1, 1, size, CONSTANTS, count=12)
    assert_agrees(TiledRasterizer(), CONSTANTS, gaussians, cameras, 0)


def differentiable(gaussians: Gaussians) -> Gaussians:
    return gaussians.map(lambda tensor: tensor.detach().requires_grad_())


def test_each_image_alone_has_a_gradient() -> None:
    gaussians, cameras = scenes(3, 1, 2, (11, 14), CONSTANTS)
    cotangents = cotangents_for(cameras, 3)
    _, together = render_with_gradients(TiledRasterizer(), gaussians, cameras, cotangents)
    alone = []
    for name, cotangent in zip(("color", "depth", "alpha"), cotangents, strict=True):
        inputs = differentiable(gaussians)
        image = getattr(TiledRasterizer()(inputs, cameras), name)
        alone.append(torch.autograd.grad(image, list(vars(inputs).values()), cotangent))
    for total, *parts in zip([together[name] for name in vars(gaussians)], *alone, strict=True):
        assert all(part.any() for part in parts) or total.shape[-1] == 3  # colours enter the colour image only
        assert torch.allclose(sum(parts), total, rtol=1e-4, atol=1e-4 * total.abs().max().item())


def test_neighbours_with_equal_depth_in_float32_keep_their_order() -> None:
    """The rear Gaussian comes first in the list, so equal sort keys would leave it in front."""
    gaussians, _ = scenes(6, 1, 1, (9, 9), CONSTANTS, count=2)
    gaussians.means[0] = torch.tensor([[1.5e-8, 0.0, 2.5], [0.0, 0.0, 2.5]])
    pose = torch.tensor([[0.8, 0, -0.6, 1.5], [0, 1, 0, 0], [0.6, 0, 0.8, 0], [0, 0, 0, 1]])
    intrinsics = torch.tensor([[20.0, 0, 4.5], [0, 20.0, 4.5], [0, 0, 1]])
    cameras = Cameras(pose[None, None], intrinsics[None, None], (9, 9))
    depths = (gaussians.means[0].double() @ pose[2, :3].double()).tolist()
    assert depths[0] > depths[1]
    assert torch.tensor(depths)[0] == torch.tensor(depths)[1]
    assert_agrees(TiledRasterizer(), CONSTANTS, gaussians, cameras, 6)


def test_the_number_of_threads_changes_no_bit(set_threads: Callable[[int], None]) -> None:
    gaussians, cameras = scenes(5, 1, 1, (50, 70), CONSTANTS)
    results = []
    for number in (1, 2, 2, 3):
        set_threads(number)
        images, gradients = render_with_gradients(TiledRasterizer(), gaussians, cameras, cotangents_for(cameras, 5))
        results.append([*vars(images).values(), *gradients.values()])
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_two_renderings_at_once_do_not_share_memory() -> None:
    first, second = (scenes(seed, 1, 2, (12, 12), CONSTANTS) for seed in (7, 8))
    cotangents = cotangents_for(first[1], 7)
    _, expected = render_with_gradients(TiledRasterizer(), *first, cotangents)
    inputs = differentiable(first[0])
    pending = vars(TiledRasterizer()(inputs, first[1])).values()
    render_with_gradients(TiledRasterizer(), *second, cotangents)
    gradients = torch.autograd.grad(list(pending), list(vars(inputs).values()), cotangents)
    assert all(torch.equal(a, b) for a, b in zip(gradients, [expected[x] for x in vars(inputs)], strict=True))


def test_more_views_than_are_held_at_once_without_gradients() -> None:
    """The inputs are not contiguous either."""
    gaussians, cameras = scenes(9, 2, 6, (6, 7), CONSTANTS, count=10)
    strided = gaussians.map(lambda tensor: torch.stack([tensor, tensor], dim=-1)[..., 0])
    assert not strided.means.is_contiguous()
    with torch.no_grad():
        together = TiledRasterizer()(strided, cameras).color
    for b, v in np.ndindex(2, 6):
        alone = TiledRasterizer()(gaussians[b : b + 1], cameras[b : b + 1, v : v + 1])
        assert torch.equal(together[b, v], alone.color[0, 0])


def test_an_input_that_changes_before_the_backward_pass_is_an_error() -> None:
    gaussians, cameras = scenes(12, 1, 1, (8, 9), CONSTANTS)
    inputs = differentiable(gaussians)
    color = TiledRasterizer()(inputs, cameras).color
    with torch.no_grad():
        inputs.scales.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        color.sum().backward()


def test_refusals() -> None:
    gaussians, cameras = scenes(13, 1, 1, (8, 9), CONSTANTS)
    twice = cameras.map(lambda tensor: tensor.repeat(2, 1, 1, 1))
    for inputs, message in [
        ((gaussians.to(torch.float64), cameras), "means is float64"),
        ((gaussians, cameras.to("meta")), "on meta"),
        ((gaussians, twice), r"means should have the shape \[2, 60, 3\], not \[1, 60, 3\]"),
    ]:
        with pytest.raises(CompleteSplatError, match=message):
            TiledRasterizer()(*inputs)
    for name in ("world_to_camera", "intrinsics"):
        following = replace(cameras, **{name: getattr(cameras, name).clone().requires_grad_()})
        with pytest.raises(CompleteSplatError, match="no gradient to the cameras"):
            TiledRasterizer()(gaussians, following)
        with torch.no_grad():
            assert TiledRasterizer()(gaussians, following).alpha.any()
    for name in ("blur", "near_plane"):
        with pytest.raises(CompleteSplatError, match=name):
            TiledRasterizer(RenderingConstants(**{name: -1.0}))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_tensors_are_drawn_on_the_cpu() -> None:
    gaussians, cameras = scenes(2, 1, 2, (11, 14), CONSTANTS)
    cotangents = cotangents_for(cameras, 2)
    expected, expected_gradients = render_with_gradients(TiledRasterizer(), gaussians, cameras, cotangents)
    moved = [tensor.cuda() for tensor in cotangents]
    rendering, gradients = render_with_gradients(TiledRasterizer(), gaussians.to("cuda"), cameras.to("cuda"), moved)
    assert rendering.color.is_cuda
    assert torch.equal(rendering.color.cpu(), expected.color)
    assert all(torch.equal(gradients[name].cpu(), expected) for name, expected in expected_gradients.items())
