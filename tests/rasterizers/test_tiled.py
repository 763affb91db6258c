"""The tiled rasterizer is the reference, faster: the same images and gradients on random scenes."""

from dataclasses import replace

import pytest
import torch
from rasterizer_scenes import OTHER_CONSTANTS, assert_agrees, cotangents_for, render_with_gradients, scenes

from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.tiled import TiledRasterizer

SEEDS = [*range(50), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(50, 500))]


@pytest.mark.parametrize("seed", SEEDS)
def test_images_and_gradients_agree_with_the_float64_reference(seed: int) -> None:
    """On a scene of a size that depends on the seed; every other time with unusual constants."""
    sizes = [(13, 17), (16, 16), (9, 23), (31, 6), (1, 40), (24, 20), (7, 5)]
    constants = RenderingConstants() if seed % 2 else OTHER_CONSTANTS
    batch, views = [(1, 2), (2, 3)][seed % 5 == 0]
    gaussians, cameras = scenes(seed, batch, views, sizes[seed % len(sizes)], constants)
    assert_agrees(TiledRasterizer(constants), constants, gaussians, cameras, seed)


@pytest.mark.parametrize("size", [(20, 300), (5, 517), (1, 1), (130, 3), (1, 18), (15, 1), (4, 4)])
def test_images_of_any_size(size: tuple[int, int]) -> None:
    constants = RenderingConstants()
    gaussians, cameras = scenes(sum(size), 1, 1, size, constants, count=12)
    assert_agrees(TiledRasterizer(constants), constants, gaussians, cameras, 0)


def test_each_image_alone_has_a_gradient() -> None:
    gaussians, cameras = scenes(3, 1, 2, (11, 14), RenderingConstants())
    cotangents = cotangents_for(cameras, 3)
    _, together = render_with_gradients(TiledRasterizer(), gaussians, cameras, cotangents)
    alone = []
    for name, cotangent in zip(("color", "depth", "alpha"), cotangents, strict=True):
        inputs = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
        image = getattr(TiledRasterizer()(inputs, cameras), name)
        alone.append(torch.autograd.grad(image, list(vars(inputs).values()), cotangent))
    for total, *parts in zip([together[name] for name in vars(gaussians)], *alone, strict=True):
        assert all(part.any() for part in parts) or total.shape[-1] == 3  # colours enter the colour image only
        assert torch.allclose(sum(parts), total, rtol=1e-4, atol=1e-4 * total.abs().max().item())


def test_cameras_alone_can_be_differentiated() -> None:
    """Without a gradient to any Gaussian, and with principal points and poses that put Gaussians at all limits."""
    gaussians, cameras = scenes(4, 1, 2, (11, 14), OTHER_CONSTANTS)
    cotangents = cotangents_for(cameras, 4)
    _, expected = render_with_gradients(TiledRasterizer(OTHER_CONSTANTS), gaussians, cameras, cotangents)
    for name in ("world_to_camera", "intrinsics"):
        one = replace(cameras, **{name: getattr(cameras, name).clone().requires_grad_()})
        rendering = TiledRasterizer(OTHER_CONSTANTS)(gaussians, one)
        images = [rendering.color, rendering.depth, rendering.alpha]
        (gradient,) = torch.autograd.grad(images, getattr(one, name), cotangents)
        assert torch.equal(gradient, expected[name])
        assert gradient.any()


def test_neighbours_in_depth_that_are_one_in_float32_keep_their_order() -> None:
    """As in any large scene. The one behind comes first, so that equal keys would leave it in front."""
    gaussians, _ = scenes(6, 1, 1, (9, 9), RenderingConstants(), count=2)
    gaussians.means[0] = torch.tensor([[1.5e-8, 0.0, 2.5], [0.0, 0.0, 2.5]])
    pose = torch.tensor([[0.8, 0, -0.6, 1.5], [0, 1, 0, 0], [0.6, 0, 0.8, 0], [0, 0, 0, 1]])
    intrinsics = torch.tensor([[20.0, 0, 4.5], [0, 20.0, 4.5], [0, 0, 1]])
    cameras = Cameras(pose[None, None], intrinsics[None, None], (9, 9))
    depths = (gaussians.means[0].double() @ pose[2, :3].double()).tolist()
    assert depths[0] > depths[1]
    assert torch.tensor(depths)[0] == torch.tensor(depths)[1]
    assert_agrees(TiledRasterizer(), RenderingConstants(), gaussians, cameras, 6)


def test_the_number_of_threads_changes_no_bit() -> None:
    gaussians, cameras = scenes(5, 1, 1, (50, 70), RenderingConstants())
    cotangents = cotangents_for(cameras, 5)
    threads = torch.get_num_threads()
    results = []
    try:
        for number in (1, 2, 2, 3):
            torch.set_num_threads(number)
            rendering, gradients = render_with_gradients(TiledRasterizer(), gaussians, cameras, cotangents)
            results.append([rendering.color, rendering.depth, rendering.alpha, *gradients.values()])
    finally:
        torch.set_num_threads(threads)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


def test_two_renderings_at_once_do_not_share_memory() -> None:
    first, second = (scenes(seed, 1, 2, (12, 12), RenderingConstants()) for seed in (7, 8))
    cotangents = cotangents_for(first[1], 7)
    _, expected = render_with_gradients(TiledRasterizer(), *first, cotangents)
    inputs = first[0].map(lambda tensor: tensor.detach().requires_grad_())
    pending = TiledRasterizer()(inputs, first[1])
    render_with_gradients(TiledRasterizer(), *second, cotangents)
    gradients = torch.autograd.grad(
        [pending.color, pending.depth, pending.alpha], list(vars(inputs).values()), cotangents
    )
    assert all(torch.equal(a, b) for a, b in zip(gradients, [expected[x] for x in vars(inputs)], strict=True))


def test_more_views_than_are_held_at_once_without_gradients() -> None:
    gaussians, cameras = scenes(9, 2, 6, (6, 7), RenderingConstants(), count=10)
    with torch.no_grad():
        together = TiledRasterizer()(gaussians, cameras).color
    one_by_one = [
        TiledRasterizer()(gaussians[b : b + 1], cameras[b : b + 1, v : v + 1]).color[0, 0]
        for b in range(2)
        for v in range(6)
    ]
    assert torch.equal(together.flatten(0, 1), torch.stack(one_by_one))


def test_inputs_need_not_be_contiguous() -> None:
    gaussians, cameras = scenes(11, 2, 2, (8, 9), RenderingConstants())
    strided = gaussians.map(lambda tensor: torch.stack([tensor, tensor], dim=-1)[..., 0])
    assert not strided.means.is_contiguous()
    assert torch.equal(TiledRasterizer()(strided, cameras).color, TiledRasterizer()(gaussians, cameras).color)


def test_an_input_that_changes_before_the_backward_pass_is_noticed() -> None:
    gaussians, cameras = scenes(12, 1, 1, (8, 9), RenderingConstants())
    inputs = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    color = TiledRasterizer()(inputs, cameras).color
    with torch.no_grad():
        inputs.scales.mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        color.sum().backward()


def test_refusals() -> None:
    gaussians, cameras = scenes(13, 1, 1, (8, 9), RenderingConstants())
    with pytest.raises(CompleteSplatError, match="means is float64"):
        TiledRasterizer()(gaussians.to(torch.float64), cameras)
    with pytest.raises(CompleteSplatError, match="on meta"):
        TiledRasterizer()(gaussians, cameras.to("meta"))
    with pytest.raises(CompleteSplatError, match=r"means should have the shape \[2, 60, 3\], not \[1, 60, 3\]"):
        TiledRasterizer()(gaussians, cameras.map(lambda tensor: tensor.repeat(2, 1, 1, 1)))
    with pytest.raises(CompleteSplatError, match="blur"):
        TiledRasterizer(RenderingConstants(blur=0.0))
    with pytest.raises(CompleteSplatError, match="near_plane"):
        TiledRasterizer(RenderingConstants(near_plane=-1.0))


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_cuda_tensors_are_drawn_on_the_cpu() -> None:
    gaussians, cameras = scenes(2, 1, 2, (11, 14), RenderingConstants())
    cotangents = cotangents_for(cameras, 2)
    expected, expected_gradients = render_with_gradients(TiledRasterizer(), gaussians, cameras, cotangents)
    moved = [tensor.cuda() for tensor in cotangents]
    found, gradients = render_with_gradients(TiledRasterizer(), gaussians.to("cuda"), cameras.to("cuda"), moved)
    assert found.color.is_cuda
    assert torch.equal(found.color.cpu(), expected.color)
    assert all(torch.equal(gradients[name].cpu(), expected) for name, expected in expected_gradients.items())
