"""Gradients of the reference rasterizer against finite differences, away from its discontinuities."""

import pytest
import torch
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, look_at
from completesplat.rasterizers import RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer, alphas_at, project_gaussians

CONSTANTS = RenderingConstants()
SIZE = (4, 5)
MARGIN = 1e-4  # a step of 1e-6 moves an alpha by less than this
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


def render(*values: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    gaussians, cameras = Gaussians(*values[:5]), Cameras(values[5], values[6], SIZE)
    rendering = ReferenceRasterizer()(gaussians[None], cameras[None, None])
    return rendering.color, rendering.depth, rendering.alpha


def discontinuities(scene: dict[str, Tensor]) -> tuple[float, Tensor, Tensor]:
    """The smallest distance to any jump or kink; the alphas before clamp and threshold, and the transmittances."""
    gaussians = Gaussians(*(scene[name] for name in INPUTS[:5]))
    camera = Cameras(scene["world_to_camera"], scene["intrinsics"], SIZE)
    centers, depths, covariances = project_gaussians(gaussians, camera, CONSTANTS)
    order = depths.argsort()
    rows, columns = torch.meshgrid(torch.arange(SIZE[0]), torch.arange(SIZE[1]), indexing="ij")
    pixels = torch.stack([columns, rows], dim=-1).flatten(0, 1).double() + 0.5
    free = RenderingConstants(min_alpha=0.0, max_alpha=2.0)
    alphas = alphas_at(pixels, centers, covariances, gaussians.opacities, free)[order]
    used = torch.where(alphas < CONSTANTS.min_alpha, 0, alphas.clamp(max=CONSTANTS.max_alpha))
    transmittances = torch.cumprod(1 - used, dim=0)
    extent, focal = torch.tensor([5.0, 4.0]), scene["intrinsics"].diagonal()[:2]
    beyond = 0.3 * extent / 2
    inside = torch.minimum(centers + beyond, extent + beyond - centers) / focal  # in units of the slope
    distances = [
        (alphas - CONSTANTS.min_alpha).abs().min(),
        (alphas - CONSTANTS.max_alpha).abs().min(),
        10 * (transmittances - CONSTANTS.min_transmittance).abs().min(),
        inside.abs().min(),
        depths.sort().values.diff().min(),
        depths.min() - CONSTANTS.near_plane,
    ]
    return min(d.item() for d in distances), alphas, transmittances


def test_the_soft_scene_is_smooth_and_has_contributions_on_both_sides_of_the_threshold() -> None:
    distance, alphas, transmittances = discontinuities(soft_scene())
    assert distance > MARGIN
    assert (alphas < CONSTANTS.min_alpha).any()
    assert (alphas > CONSTANTS.min_alpha).sum() > 20
    assert transmittances.min() > CONSTANTS.min_transmittance


def test_the_opaque_scene_clamps_and_stops_without_touching_either_limit() -> None:
    distance, alphas, transmittances = discontinuities(opaque_scene())
    assert distance > MARGIN
    assert (alphas > CONSTANTS.max_alpha).any()
    stopped = transmittances < CONSTANTS.min_transmittance
    assert stopped.any()
    assert not stopped.all(dim=1)[-1]


@pytest.mark.parametrize("name", INPUTS)
@pytest.mark.parametrize("make", [soft_scene, opaque_scene])
def test_gradients_agree_with_finite_differences(make, name: str) -> None:  # type: ignore[no-untyped-def]
    scene = make()

    def function(value: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return render(*(value if key == name else scene[key] for key in INPUTS))

    value = scene[name].clone().requires_grad_()
    assert torch.autograd.gradcheck(function, value, eps=1e-6, atol=1e-7, rtol=1e-5, fast_mode=False)
    (gradient,) = torch.autograd.grad(sum(out.sum() for out in function(value)), value)  # type: ignore[arg-type]
    assert gradient.abs().max() > 1e-4


def test_single_precision_gradients_agree_with_double() -> None:
    scene = soft_scene()
    gradients = []
    for dtype in (torch.float32, torch.float64):
        values = [value.to(dtype).requires_grad_() for value in scene.values()]
        generator = torch.Generator().manual_seed(0)
        outputs = render(*values)
        weights = [torch.rand(out.shape, generator=generator, dtype=torch.float64).to(dtype) for out in outputs]
        loss = sum((w * out).sum() for w, out in zip(weights, outputs, strict=True))
        gradients.append(torch.autograd.grad(loss, values))  # type: ignore[arg-type]
    for single, double in zip(*gradients, strict=True):
        assert (single.double() - double).norm() <= 1e-5 * double.norm()
