"""Gradients of the reference rasterizer against finite differences, away from its discontinuities."""

import pytest
import torch
from rasterizer_scenes import CONSTANTS, assert_agrees, scenes
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, look_at
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer, alphas_at, project_gaussians

SIZE = (4, 5)
INPUTS = ("means", "quaternions", "scales", "opacities", "colors", "world_to_camera", "intrinsics")


def soft_scene() -> dict[str, Tensor]:
    """Overlapping, half transparent Gaussians: neither the clamp nor the stop is active."""
    generator = torch.Generator().manual_seed(23)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    eye, up = torch.tensor([[0.3, -0.2, -2.5], [0.1, -1.0, 0.2]], dtype=torch.float64)
    return {
        "means": rand(4, 3) - 0.5,
        "quaternions": rand(4, 4) * 2 - 1,
        "scales": 0.1 + 0.3 * rand(4, 3),
        "opacities": 0.3 + 0.5 * rand(4),
        "colors": rand(4, 3),
        "world_to_camera": look_at(eye, torch.zeros_like(eye), up),
        "intrinsics": torch.tensor([[4.0, 0, 2.7], [0, 5.0, 1.8], [0, 0, 1]], dtype=torch.float64),
    }


def opaque_scene() -> dict[str, Tensor]:
    """Two large, nearly opaque Gaussians in front of the others: clamped alphas, and pixels that stop early."""
    scene = soft_scene()
    scene["opacities"] = torch.tensor([1.0, 0.97, 0.6, 0.5], dtype=torch.float64)
    scene["scales"] = scene["scales"] * torch.tensor([12.0, 8.0, 1, 1], dtype=torch.float64)[:, None]
    depths = torch.tensor([-0.5, -0.3, 0.0, 0.2], dtype=torch.float64)
    scene["means"] = torch.cat([0.4 * scene["means"][:, :2], depths[:, None]], dim=1)
    return scene


def combinations(*values: Tensor) -> Tensor:
    """Return 6 random sums of all pixels, which have all the derivatives of the images and far fewer rows."""
    gaussians = Gaussians(*values[:5])
    cameras = Cameras(values[5], values[6], SIZE)
    rendering = ReferenceRasterizer()(gaussians[None], cameras[None, None])
    pixels = torch.cat([image.flatten() for image in vars(rendering).values()])
    weights = torch.randn(6, len(pixels), generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return weights @ pixels


def alphas_of(scene: dict[str, Tensor]) -> Tensor:
    """Return alphas before clamp and threshold, from front to back."""
    gaussians = Gaussians(*(scene[name] for name in INPUTS[:5]))
    camera = Cameras(*map(scene.get, INPUTS[5:]), SIZE)
    centers, depths, covariances = project_gaussians(gaussians, camera, CONSTANTS)
    rows, columns = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    pixels = torch.stack([columns, rows], dim=-1).flatten(0, 1).double() + 0.5
    free = RenderingConstants(min_alpha=0.0, max_alpha=2.0)
    return alphas_at(pixels, centers, covariances, gaussians.opacities, free)[depths.argsort()]


def test_the_soft_scene_skips_and_the_opaque_one_clamps_and_stops() -> None:
    """No alpha is so close to a limit that finite differences would cross it."""
    soft = alphas_of(soft_scene())
    opaque = alphas_of(opaque_scene())
    assert (soft < CONSTANTS.min_alpha).any()
    assert (soft > CONSTANTS.min_alpha).sum() > 20
    assert (soft < CONSTANTS.max_alpha).all()
    assert (opaque > CONSTANTS.max_alpha).any()
    left = torch.cumprod(1 - opaque.clamp(max=CONSTANTS.max_alpha), dim=0)[-1]
    assert left.min() < CONSTANTS.min_transmittance < left.max()


def test_single_precision_gradients_agree_with_double() -> None:
    assert_agrees(ReferenceRasterizer(), CONSTANTS, *scenes(0, 1, 1, (9, 13), CONSTANTS), 0, followed=INPUTS[5:])


@pytest.mark.parametrize("make", [soft_scene, opaque_scene])
def test_gradients_agree_with_finite_differences(make) -> None:
    scene = make()
    values = [scene[name].requires_grad_() for name in INPUTS]
    assert torch.autograd.gradcheck(combinations, values, eps=1e-6, atol=1e-7, rtol=1e-5, fast_mode=False)
    gradients = torch.autograd.grad(combinations(*values).sum(), values)
    assert all(gradient.abs().max() > 1e-4 for gradient in gradients)
