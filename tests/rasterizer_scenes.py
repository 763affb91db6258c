"""Random scenes on which rasterizers are compared, and the comparison."""

import torch
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, look_at
from completesplat.rasterizers import Rasterizer, Rendering, RenderingConstants
from completesplat.rasterizers.reference import ReferenceRasterizer, project_gaussians, visible_by_depth

# A scene keeps this far from the steps of the function, relative to where they are: alpha from its threshold and its
# clamp; the transmittance from the stop (it is a product of many factors); depths from each other and the near plane.
BAND, STOP_BAND, DEPTH_BAND = 1e-5, 1e-4, 1e-6
OTHER_CONSTANTS = RenderingConstants(
    blur=0.1, near_plane=1.6, max_alpha=0.9, min_alpha=0.02, min_transmittance=0.05, frustum_margin=0.05
)


CONSTANTS = RenderingConstants()


def f64(*values: object) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def render(gaussians: Gaussians, camera: Cameras, constants: RenderingConstants = CONSTANTS) -> Rendering:
    """One scene, one view, by the reference."""
    return ReferenceRasterizer(constants)(gaussians[None], camera[None, None])


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
    for row, column, low, high in ((0, 0, 0.8, 1.4), (1, 1, 0.8, 1.4), (0, 2, 0.4, 0.6), (1, 2, 0.4, 0.6)):
        intrinsics[..., row, column] = uniform(low, high, batch, views) * (width, height)[row]
    return gaussians, Cameras(matrices, intrinsics, size)


def keeps_clear_of_the_steps(gaussians: Gaussians, cameras: Cameras, constants: RenderingConstants) -> bool:
    """Return whether no decision (thresholds, stop, order, culling) is so close that float32 could decide otherwise."""
    for b in range(gaussians.means.shape[0]):
        for v in range(cameras.intrinsics.shape[1]):
            scene, camera = gaussians[b].to(torch.float64), cameras[b, v].to(torch.float64)
            visible, order = visible_by_depth(scene, camera, constants)
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
    rasterizer: Rasterizer, gaussians: Gaussians, cameras: Cameras, cotangents: list[Tensor],
    followed: tuple[str, ...] = (),
) -> tuple[Rendering, dict[str, Tensor]]:  # fmt: skip
    """The images, and gradients under these cotangents: of the Gaussians and the `followed` tensors of the cameras."""
    gaussians = gaussians.map(lambda tensor: tensor.detach().requires_grad_())
    cameras = cameras.map(lambda tensor: tensor.detach())
    for name in followed:
        getattr(cameras, name).requires_grad_()
    inputs = vars(gaussians) | {name: getattr(cameras, name) for name in followed}
    rendering = rasterizer(gaussians, cameras)
    # In one sum: an image of nothing but constants has no gradient of its own.
    total = sum((image * c).sum() for image, c in zip(vars(rendering).values(), cotangents, strict=True))
    gradients = torch.autograd.grad(total, list(inputs.values()))
    return rendering.detach(), dict(zip(inputs, gradients, strict=True))


def cotangents_for(cameras: Cameras, seed: int) -> list[Tensor]:
    generator = torch.Generator().manual_seed(seed)
    shape = cameras.intrinsics.shape[:2]
    return [torch.randn(*shape, channels, *cameras.image_size, generator=generator) for channels in (3, 1, 1)]


def assert_agrees(
    rasterizer: Rasterizer, constants: RenderingConstants, gaussians: Gaussians, cameras: Cameras, seed: int,
    image: float = 1e-5, gradient: float = 1e-4, followed: tuple[str, ...] = (),
) -> None:  # fmt: skip
    """Compare with the float64 reference, under random cotangents.

    Args:
        image: largest error of the images, absolute, and of each image as a whole, relative in L2.
        gradient: largest relative L2 error of a gradient.
        followed: tensors of the cameras whose gradients are compared, too.
    """
    cotangents = cotangents_for(cameras, seed)
    rendering, gradients = render_with_gradients(rasterizer, gaussians, cameras, cotangents, followed)
    doubles = [tensor.double() for tensor in cotangents]
    gaussians, cameras = gaussians.to(torch.float64), cameras.to(torch.float64)
    exact, exact_gradients = render_with_gradients(
        ReferenceRasterizer(constants), gaussians, cameras, doubles, followed
    )
    for name, expected in vars(exact).items():
        difference = getattr(rendering, name) - expected
        assert difference.abs().max() <= image, name
        assert difference.norm() <= image * expected.norm(), name
    for name, expected in exact_gradients.items():
        assert (gradients[name] - expected).norm() <= gradient * expected.norm(), name
