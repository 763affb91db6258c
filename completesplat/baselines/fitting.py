"""Optimisation of 3D Gaussians for single scenes from posed views (Kerbl et al. 2023, "3D Gaussian Splatting").

`fit_gaussians` keeps the number of Gaussians; `densification` adds and moves them. Gaussians start from random pixels
at random depths, or from points, where a data set has them.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

import torch
from jaxtyping import Float
from torch import Tensor

from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import pixel_centers, project, unproject
from completesplat.geometry.harmonics import SH_C0
from completesplat.losses import Prediction, WeightedSum
from completesplat.quantities import Positive, Range
from completesplat.rasterizers import Rasterizer
from completesplat.scene import Views

# 3DGS's learning rates for 30,000 steps (graphdeco-inria/gaussian-splatting, `arguments/__init__.py`).
POSITION_RATE = 1.6e-4
"""First learning rate of the positions, for a scene whose extent is 1."""
POSITION_DECAY = 0.01
"""Factor by which the positions' rate decays exponentially over all steps."""
RATES = {"log_scales": 5e-3, "quaternions": 1e-3, "logits": 5e-2, "harmonics": 2.5e-3}
"""Learning rates of the other parameters, which are constant."""

NEIGHBOURS = 3
Translucent = Annotated[float, Range(0.01, 0.99)]  # 0 and 1 have no finite logits
Count = Annotated[int, Range(NEIGHBOURS + 1, 10**7)]  # of Gaussians; 3DGS's largest scenes have six million


@dataclass(frozen=True)
class FittingSettings:
    """Settings of per-scene fitting.

    Attributes:
        count: number of Gaussians of a scene.
        steps: Adam steps, over which the positions' rate decays.
        views: random views in each step, the same for all scenes of a batch.
        opacity: initial opacity of all Gaussians (0.1 in 3DGS).
        position_rate, other_rates: factors on 3DGS's learning rates, which are meant for 30,000 steps.
    """

    count: Count = 4000
    steps: Positive = 300
    views: Positive = 2
    opacity: Translucent = 0.1
    position_rate: float = 30.0
    other_rates: float = 4.0


@dataclass(frozen=True)
class RawGaussians:
    """Optimised parameters: Gaussians before activation, with colours as coefficients of the zeroth harmonic."""

    means: Float[Tensor, "batch gaussian 3"]
    log_scales: Float[Tensor, "batch gaussian 3"]
    quaternions: Float[Tensor, "batch gaussian 4"]
    logits: Float[Tensor, "batch gaussian"]
    harmonics: Float[Tensor, "batch gaussian 3"]

    def gaussians(self) -> Gaussians:
        """Apply 3DGS's activations to raw values, whose quaternions may have any length."""
        colors = (0.5 + SH_C0 * self.harmonics).clamp(min=0)
        return Gaussians(self.means, self.quaternions, self.log_scales.exp(), self.logits.sigmoid(), colors)


def initial_gaussians(
    views: Views, depth_range: Float[Tensor, "batch 2"], count: int, opacity: float, generator: torch.Generator
) -> RawGaussians:
    """Return isotropic Gaussians on the rays of random pixels, each with its pixel's colour and footprint.

    Depths along each view's optical axis are uniform in the depth range, in scene units. The generator is on the CPU.
    """
    batch, number = views.images.shape[:2]
    height, width = views.cameras.image_size
    device = views.images.device
    scene = torch.arange(batch, device=device)[:, None]
    view = torch.randint(number, (batch, count), generator=generator).to(device)
    pixel = torch.randint(height * width, (batch, count), generator=generator).to(device)
    share = torch.rand(batch, count, generator=generator).to(device)
    depth = depth_range[:, :1] + (depth_range[:, 1:] - depth_range[:, :1]) * share
    cameras = views.cameras[scene, view]  # one camera for each Gaussian
    centers = pixel_centers(height, width, device).flatten(0, 1)[pixel]
    footprint = depth / cameras.intrinsics[..., 0, 0]
    means = unproject(cameras, centers[:, :, None], depth[..., None]).squeeze(-2)
    return _isotropic(means, footprint, views.images.flatten(-2)[scene, view, :, pixel], opacity)


def gaussians_at_points(points: Float[Tensor, "gaussian 3"], views: Views, opacity: float) -> RawGaussians:
    """Return Gaussians [1 gaussian] as large as the mean distance to the `NEIGHBOURS` nearest points (3DGS).

    Colours are means over the views [view] that contain the point, whether it is seen or hidden there.
    """
    parts = torch.split(points, 500)
    exact = "donot_use_mm_for_euclid_dist"  # the default cancels far from the origin
    distances = (torch.cdist(part, points, compute_mode=exact) for part in parts)
    nearest = [part.topk(NEIGHBOURS + 1, largest=False).values[:, 1:] for part in distances]
    pixels, depth = project(views.cameras, points.expand(len(views.images), -1, -1))
    grid = 2 * pixels / pixels.new_tensor(views.cameras.image_size[::-1]) - 1
    inside = ((depth > 0) & (grid.abs() < 1).all(-1))[..., None]
    sampled = torch.nn.functional.grid_sample(views.images, grid[:, None], align_corners=False)[:, :, 0].mT
    colors = (sampled.where(inside, 0).sum(0) + 1e-3 * 0.5) / (inside.sum(0) + 1e-3)
    return _isotropic(points[None], torch.cat(nearest).mean(-1).clamp(min=1e-6)[None], colors[None], opacity)


def _isotropic(
    means: Float[Tensor, "batch gaussian 3"],
    sizes: Float[Tensor, "batch gaussian"],
    colors: Float[Tensor, "batch gaussian 3"],
    opacity: float,
) -> RawGaussians:
    """Return Gaussians whose standard deviation is `sizes` in all directions, with one opacity for all."""
    return RawGaussians(
        means=means,
        log_scales=sizes.log()[..., None].repeat(1, 1, 3),
        quaternions=torch.tensor([1.0, 0, 0, 0], device=means.device).repeat(*sizes.shape, 1),
        logits=torch.full_like(sizes, opacity).logit(),
        harmonics=(colors - 0.5) / SH_C0,
    )


def fit_gaussians(
    views: Views,
    depth_range: Float[Tensor, "batch 2"],
    rasterizer: Rasterizer,
    background: float,
    loss: WeightedSum,
    settings: FittingSettings,
    generator: torch.Generator,
) -> Gaussians:
    """Optimise Gaussians for all scenes of a batch at once, so that their renderings match the views.

    This also works where autograd is off, as in `torch.inference_mode()`. The Gaussians are in the views' world frame.
    The generator, on the CPU, determines the initial Gaussians and the views of each step.
    """
    with torch.inference_mode(False), torch.enable_grad():
        raw = initial_gaussians(views, depth_range, settings.count, settings.opacity, generator)
        parameters = {name: tensor.requires_grad_() for name, tensor in vars(raw).items()}
        optimizer = adam(parameters, depth_range, settings.position_rate, settings.other_rates, settings.other_rates)
        positions = optimizer.param_groups[0]
        decay = POSITION_DECAY ** (1 / max(settings.steps, 1))
        for step in range(settings.steps):
            chosen = torch.randperm(views.images.shape[1], generator=generator)[: settings.views]
            # Indexing copies the views, so autograd can use them even if they were made in inference mode.
            truth = views[:, chosen.to(views.images.device)]
            gaussians = raw.gaussians()
            images = rasterizer(gaussians, truth.cameras).over(background)
            total, _ = loss(Prediction(images, gaussians, None), truth, step)
            optimizer.zero_grad()
            torch.autograd.backward(total)
            optimizer.step()
            positions["lr"] *= decay
        return raw.gaussians().detach()


def adam(
    raw: Mapping[str, Tensor],
    depth_ranges: Float[Tensor, "_ 2"],
    position_factor: float,
    opacity_factor: float,
    other_factor: float,
) -> torch.optim.Adam:
    """Return Adam for tensors of `RawGaussians` by name, the positions first, with factors on 3DGS's rates.

    Its epsilon is 3DGS's (`gaussian_model.py`), which is small compared with a Gaussian's gradients.
    """
    # Half of the mean depth range: the spread of the initial Gaussians (3DGS uses the spread of the cameras).
    extent = (0.5 * (depth_ranges[:, 1] - depth_ranges[:, 0])).mean().item()
    groups = [{"params": [raw["means"]], "lr": position_factor * POSITION_RATE * extent}]
    for name, rate in RATES.items():
        factor = opacity_factor if name == "logits" else other_factor
        groups.append({"params": [raw[name]], "lr": factor * rate})
    return torch.optim.Adam(groups, eps=1e-15)
