"""Gaussians that no rasterizer should meet, but that training produces: nothing they do may spread."""

import pytest
import torch
from degenerate_gaussians import DRAWN, FLAT, NEVER_DRAWN, SIZE, camera, changed, healthy
from rasterizer_scenes import cotangents_for, render_with_gradients
from torch import Tensor

from completesplat.gaussians import Gaussians, concatenate
from completesplat.geometry.cameras import Cameras
from completesplat.rasterizers import Rasterizer
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.rasterizers.tiled import TiledRasterizer

CAMERA = ("world_to_camera", "intrinsics")


def render(
    rasterizer: Rasterizer, gaussians: Gaussians, dtype: torch.dtype, cameras: Cameras | None = None
) -> tuple[Tensor, dict[str, Tensor]]:
    """The images in one tensor and the gradients of a sum over them with random weights, cameras included."""
    cameras = camera() if cameras is None else cameras
    cotangents = [cotangent.to(dtype) for cotangent in cotangents_for(cameras, 1)]
    rendering, gradients = render_with_gradients(rasterizer, gaussians.to(dtype), cameras.to(dtype), cotangents)
    return torch.cat([rendering.color, rendering.depth, rendering.alpha], dim=2), gradients


@pytest.mark.parametrize("kind", NEVER_DRAWN)
def test_a_gaussian_that_cannot_be_drawn_is_as_good_as_absent(kind: str) -> None:
    rest = healthy(12)
    expected, expected_gradients = render(TiledRasterizer(), rest, torch.float32)
    images, gradients = render(TiledRasterizer(), concatenate([changed(NEVER_DRAWN[kind]), rest]), torch.float32)
    assert expected.any()
    assert torch.equal(images, expected)
    for name, without in expected_gradients.items():
        if name in CAMERA:
            assert torch.equal(gradients[name], without)
        else:
            assert not gradients[name][:, 0].any()
            assert torch.equal(gradients[name][:, 1:], without)


@pytest.mark.parametrize("kind", DRAWN)
def test_an_extreme_gaussian_is_drawn_as_by_the_float64_reference(kind: str) -> None:
    gaussians = concatenate([healthy(12), changed(DRAWN[kind])])
    images, gradients = render(TiledRasterizer(), gaussians, torch.float32)
    expected, expected_gradients = render(ReferenceRasterizer(), gaussians, torch.float64)
    without, _ = render(TiledRasterizer(), healthy(12), torch.float32)
    assert not torch.equal(images, without)
    assert ((images - expected).abs() <= 1e-5 * expected.abs().clamp(min=1)).all()
    for name, exact in expected_gradients.items():
        gradient = gradients[name]
        assert gradient.isfinite().all()
        for part in [...] if name in CAMERA else [(slice(None), slice(0, 12)), (slice(None), slice(12, 13))]:
            if part != ... and part[1].start == 12 and kind in FLAT and name == "quaternions":
                assert gradient[part].norm() <= 1e-4
            else:
                assert (gradient[part] - exact[part]).norm() <= 2e-4 * exact[part].norm(), name


def test_a_zero_quaternion_is_the_identity_and_has_no_gradient() -> None:
    zero, zero_gradients = render(TiledRasterizer(), changed({"quaternions": (0.0, 0.0, 0.0, 0.0)}), torch.float32)
    identity, _ = render(TiledRasterizer(), changed({"quaternions": (1.0, 0.0, 0.0, 0.0)}), torch.float32)
    assert torch.equal(zero, identity)
    assert not zero_gradients["quaternions"].any()
    assert zero_gradients["scales"].any()


@pytest.mark.parametrize("count", [0, 3])
def test_nothing_to_draw(count: int) -> None:
    gaussians = Gaussians(*(tensor[:, :count] for tensor in vars(healthy(3)).values()))
    gaussians = Gaussians(**vars(gaussians) | {"means": gaussians.means - 100})
    images, gradients = render(TiledRasterizer(), gaussians, torch.float32)
    assert images.shape == (1, 1, 5, *SIZE)
    assert not images.any()
    for name, tensor in vars(gaussians).items():
        assert gradients[name].shape == tensor.shape
    assert not any(gradient.any() for gradient in gradients.values())


@pytest.mark.parametrize("size", [(1, 1), (1, 18), (15, 1), (4, 4), (5, 7)])
def test_images_of_a_single_pixel_row_or_block(size: tuple[int, int]) -> None:
    height, width = size
    intrinsics = torch.tensor([[9.0, 0, width / 2], [0, 9.0, height / 2], [0, 0, 1]])
    cameras = Cameras(torch.eye(4)[None, None], intrinsics[None, None], size)
    assert_agrees_with_the_reference(healthy(12), cameras)


def test_all_at_one_depth_keep_their_order() -> None:
    gaussians = healthy(12)
    gaussians.means[..., 2] = 2.0
    assert_agrees_with_the_reference(gaussians, camera())
    backwards = gaussians.map(lambda tensor: tensor.flip(1))
    assert not torch.allclose(
        TiledRasterizer()(gaussians, camera()).color, TiledRasterizer()(backwards, camera()).color
    )


def test_a_hundred_thousand_on_one_pixel() -> None:
    """All of them faint, so that a pixel is not full before hundreds have been drawn."""
    one = changed({"opacities": 0.01, "scales": (0.001, 0.001, 0.001), "means": (0.0, 0.0, 2.0)})
    many = one.map(lambda tensor: tensor.expand(1, 100_000, *tensor.shape[2:]).clone())
    many.colors[:] = torch.rand(many.colors.shape, generator=torch.Generator().manual_seed(0))
    cameras = Cameras(torch.eye(4)[None, None], torch.tensor([[[[2.0, 0, 1.5], [0, 2.0, 1.5], [0, 0, 1]]]]), (3, 3))
    images, gradients = assert_agrees_with_the_reference(many, cameras)
    assert images[0, 0, 4, 1, 1] > 0.99
    assert gradients["opacities"].count_nonzero() > 500
    assert not gradients["opacities"][0, 50_000:].any()


def assert_agrees_with_the_reference(gaussians: Gaussians, cameras: Cameras) -> tuple[Tensor, dict[str, Tensor]]:
    images, gradients = render(TiledRasterizer(), gaussians, torch.float32, cameras)
    expected, expected_gradients = render(ReferenceRasterizer(), gaussians, torch.float64, cameras)
    assert expected.any()
    assert (images - expected).abs().max() <= 1e-5
    for name, exact in expected_gradients.items():
        assert gradients[name].isfinite().all()
        assert (gradients[name] - exact).norm() <= 1e-4 * exact.norm(), name
    return images, gradients
