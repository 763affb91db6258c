"""The tiled rasterizer is the reference, faster: the same images and gradients on random scenes."""

import pytest
import torch
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, look_at
from completesplat.rasterizers import Rasterizer, Rendering, RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer, project_gaussians, visible_in_depth_order
from completesplat.rasterizers.tiled import TiledRasterizer

BAND, STOP_BAND, DEPTH_BAND = 1e-5, 1e-4, 1e-6
OTHER_CONSTANTS = RenderingConstants(
    blur=0.1, near_plane=1.6, max_alpha=0.9, min_alpha=0.02, min_transmittance=0.05, frustum_margin=0.05
)


def draw_scene(generator: torch.Generator, batch: int, views: int, size: tuple[int, int], count: int) -> tuple:
    """Thin and round Gaussians of all opacities about the origin, seen from cameras on a sphere."""

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator)

    gaussians = Gaussians(
        means=uniform(-0.9, 0.9, batch, count, 3),
        quaternions=torch.randn(batch, count, 4, generator=generator),
        scales=uniform(-4.5, -0.7, batch, count, 3).exp(),
        opacities=uniform(0.02, 1.0, batch, count),
        colors=uniform(0.0, 1.0, batch, count, 3),
    )
    eyes = torch.nn.functional.normalize(torch.randn(batch, views, 3, generator=generator), dim=-1) * 2.2
    matrices = look_at(eyes, uniform(-0.2, 0.2, batch, views, 3), torch.tensor([0.1, -1.0, 0.2]))
    height, width = size
    intrinsics = torch.eye(3).repeat(batch, views, 1, 1)
    intrinsics[..., 0, 0] = uniform(0.8, 1.4, batch, views) * width
    intrinsics[..., 1, 1] = uniform(0.8, 1.4, batch, views) * height
    intrinsics[..., 0, 2] = uniform(0.4, 0.6, batch, views) * width
    intrinsics[..., 1, 2] = uniform(0.4, 0.6, batch, views) * height
    return gaussians, Cameras(matrices, intrinsics, size)


def keeps_clear_of_the_steps(gaussians: Gaussians, cameras: Cameras, constants: RenderingConstants) -> bool:
    """Whether no decision (thresholds, stop, order, culling) is so close that float32 could decide otherwise."""
    for b in range(gaussians.means.shape[0]):
        for v in range(cameras.intrinsics.shape[1]):
            scene, camera = gaussians[b].to(torch.float64), cameras[b, v].to(torch.float64)
            visible, order = visible_in_depth_order(scene, camera, constants)
            scene = scene[visible][order]
            centers, depths, covariances = project_gaussians(scene, camera, constants)
            height, width = camera.image_size
            x, y = torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy")
            offsets = torch.stack([x, y], -1).double().flatten(0, 1) - centers[:, None]
            sigma = 0.5 * (offsets @ torch.linalg.inv(covariances) * offsets).sum(-1)
            alpha = scene.opacities[:, None] * torch.exp(-sigma)
            drawn = torch.where(alpha >= constants.min_alpha, alpha.clamp(max=constants.max_alpha), 0)
            behind = torch.cumprod(1 - drawn, dim=0)
            steps = [
                (alpha / constants.min_alpha, BAND),
                (alpha / constants.max_alpha, BAND),
                (behind / constants.min_transmittance, STOP_BAND),
                (depths[1:] / depths[:-1], DEPTH_BAND),
                (depths / constants.near_plane, DEPTH_BAND),
            ]
            if any(bool(((ratio - 1).abs() < band).any()) for ratio, band in steps):
                return False
    return True


def scenes(
    seed: int, batch: int, views: int, size: tuple[int, int], constants: RenderingConstants, count: int = 60
) -> tuple[Gaussians, Cameras]:
    """The first draw of this seed that keeps clear of the steps."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(50):
        gaussians, cameras = draw_scene(generator, batch, views, size, count)
        if keeps_clear_of_the_steps(gaussians, cameras, constants):
            return gaussians, cameras
    raise AssertionError("no draw keeps clear of the steps")


def render_with_gradients(
    rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras, cotangents: list[Tensor]
) -> tuple[Rendering, list[Tensor]]:
    gaussians = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    rendering = rasterizer(gaussians, cameras)
    images = [rendering.color, rendering.depth, rendering.alpha]
    return rendering.detach(), list(torch.autograd.grad(images, list(vars(gaussians).values()), cotangents))


def cotangents_for(cameras: Cameras, seed: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shape = cameras.intrinsics.shape[:2]
    return [torch.randn(*shape, channels, *cameras.image_size, generator=generator) for channels in (3, 1, 1)]


def assert_agrees(gaussians: Gaussians, cameras: Cameras, constants: RenderingConstants, seed: int) -> None:
    cotangents = cotangents_for(cameras, seed)
    found, gradients = render_with_gradients(TiledRasterizer(constants), gaussians, cameras, cotangents)
    doubles = [tensor.double() for tensor in cotangents]
    gaussians, cameras = gaussians.to(torch.float64), cameras.to(torch.float64)
    exact, exact_gradients = render_with_gradients(ReferenceRasterizer(constants), gaussians, cameras, doubles)
    for name in ("color", "depth", "alpha"):
        assert (getattr(found, name) - getattr(exact, name)).abs().max() <= 1e-5, name
    for name, gradient, expected in zip(vars(gaussians), gradients, exact_gradients, strict=True):
        assert (gradient - expected).norm() <= 1e-4 * expected.norm(), name


def shapes() -> list[tuple[int, tuple[int, int]]]:
    sizes = [(13, 17), (16, 16), (9, 23), (31, 6), (1, 40)]
    return list(enumerate(sizes * 4))


@pytest.mark.parametrize(("seed", "size"), shapes())
def test_images_and_gradients_agree_with_the_float64_reference(seed: int, size: tuple[int, int]) -> None:
    constants = RenderingConstants() if seed < 10 else OTHER_CONSTANTS
    gaussians, cameras = scenes(seed, 2, 3, size, constants)
    assert_agrees(gaussians, cameras, constants, seed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(100, 300))
def test_two_hundred_more_scenes(seed: int) -> None:
    constants = RenderingConstants() if seed % 2 else OTHER_CONSTANTS
    gaussians, cameras = scenes(seed, 1, 2, (10 + seed % 17, 8 + seed % 23), constants)
    assert_agrees(gaussians, cameras, constants, seed)


@pytest.mark.parametrize("size", [(20, 300), (5, 517), (1, 1), (130, 3)])
def test_images_of_any_size(size: tuple[int, int]) -> None:
    constants = RenderingConstants()
    gaussians, cameras = scenes(sum(size), 1, 1, size, constants, count=12)
    assert_agrees(gaussians, cameras, constants, 0)


def test_each_image_alone_has_a_gradient() -> None:
    gaussians, cameras = scenes(3, 1, 2, (11, 14), RenderingConstants())
    cotangents = cotangents_for(cameras, 3)
    _, together = render_with_gradients(TiledRasterizer(), gaussians, cameras, cotangents)
    alone = []
    for name, cotangent in zip(("color", "depth", "alpha"), cotangents, strict=True):
        inputs = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
        image = getattr(TiledRasterizer()(inputs, cameras), name)
        alone.append(torch.autograd.grad(image, list(vars(inputs).values()), cotangent))
    for total, *parts in zip(together, *alone, strict=True):
        assert all(part.any() for part in parts) or total.shape[-1] == 3  # colours enter the colour image only
        assert torch.allclose(sum(parts), total, rtol=1e-4, atol=1e-4 * total.abs().max().item())


def test_the_number_of_threads_changes_no_bit() -> None:
    gaussians, cameras = scenes(5, 1, 1, (50, 70), RenderingConstants())
    cotangents = cotangents_for(cameras, 5)
    threads = torch.get_num_threads()
    results = []
    try:
        for number in (1, 2, 2, 3):
            torch.set_num_threads(number)
            rendering, gradients = render_with_gradients(TiledRasterizer(), gaussians, cameras, cotangents)
            results.append([rendering.color, rendering.depth, rendering.alpha, *gradients])
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
    assert all(torch.equal(a, b) for a, b in zip(gradients, expected, strict=True))


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
    with pytest.raises(CompleteSplatError, match="reference rasterizer"):
        TiledRasterizer()(gaussians, cameras.map(lambda tensor: tensor.requires_grad_()))
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
    assert all(torch.equal(a.cpu(), b) for a, b in zip(gradients, expected_gradients, strict=True))
