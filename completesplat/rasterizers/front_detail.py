"""Detail of a photo in the front of a scene: Gaussians are split where the photo shows more than they can."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from completesplat.gaussians import Gaussians, merge_gaussians
from completesplat.geometry.cameras import Cameras, crop_resize, transform_points
from completesplat.geometry.rotations import quaternion_to_matrix
from completesplat.rasterizers import Rasterizer, RenderingConstants
from completesplat.rasterizers.front_fitting import ENOUGH, Pace, fit_front
from completesplat.tensors import TensorDataclass

APART = 0.7
"""Distance of the parts of a Gaussian from its centre along each of two axes, in standard deviations of the whole."""
SMALLER = math.sqrt(1 - APART**2)  # scale of the parts, which together have the variance of the whole
PLACES = ((-APART, -APART), (-APART, APART), (APART, -APART), (APART, APART))
SMALLEST_SPLIT = 0.5  # standard deviation in pixels, below which nothing is split
SMALLEST_ERROR = 1e-3  # squared error of a Gaussian's pixels, in all, below which it is not split
PARTS_PER_PIXEL = 0.5  # Gaussians that splits may add for each pixel of the photo
ROUNDS = 8  # of fitting after each split but the last
LAST_ROUNDS = 12
# Opacities change little, because what lets the photo's view shine through is wrong from the side. Parts are small, so
# that they may grow.
PACE = Pace(warm_up=3, rates={"colors": 0.15, "opacities": 0.15, "scales": 0.18}, only_falling=())
ENTRIES = 256  # of the table of opacities


@dataclass(frozen=True)
class FrontTarget(TensorDataclass):
    """An image that a front is fitted to, with its camera, both in a batch of one.

    Attributes:
        visible: 0 where the image is not to be fitted.
    """

    camera: Cameras
    image: Float[Tensor, "1 3 height width"]
    visible: Float[Tensor, "1 1 height width"] | None = None


def front_targets(
    camera: Cameras,
    image_at: Callable[[int], Float[Tensor, "3 _ _"]],
    size: int,
    visible: Float[Tensor, "1 1 height width"] | None = None,
    own_at: Callable[[int], Float[Tensor, "1 _ _"] | None] = lambda side: None,
) -> list[FrontTarget]:
    """Return a photo's images whose sides grow to `size`, each at most twofold, from the side of a camera's image on.

    Args:
        camera: of the smallest image, which is not returned.
        image_at: returns the photo at a size.
        visible: mask of the smallest image.
        own_at: returns a further mask at a size, or None.
    """
    least = camera.image_size[0]
    count = math.ceil(math.log2(size / least))
    targets = []
    for number in range(1, count + 1):
        side = round(least * (size / least) ** (number / count))
        mask = None if visible is None else _enlarged_mask(visible, side)
        own = own_at(side)
        if own is not None:
            mask = own[None].to(camera.intrinsics) * (1 if mask is None else mask)
        image = image_at(side)[None].to(camera.intrinsics)
        targets.append(FrontTarget(crop_resize(camera, 0, 0, least, side), image, mask))
    return targets


def _enlarged_mask(visible: Float[Tensor, "1 1 height width"], side: int) -> Float[Tensor, "1 1 _ _"]:
    """Enlarge a mask whose hidden part first grows by a pixel, because the masks' pixels are not those of the image."""
    hidden = functional.max_pool2d(1 - visible, 3, stride=1, padding=1)
    return functional.interpolate(1 - hidden, (side, side), mode="nearest")


def fit_detail(
    gaussians: Gaussians, camera: Cameras, targets: Sequence[FrontTarget], rasterizer: Rasterizer, background: float
) -> Gaussians:
    """Give a scene's front the detail of a photo, by turns splitting Gaussians and fitting the front (`fit_front`).

    The result looks right from the camera of the last target, with its blur: what is hidden is enlarged by as much as
    the rasterizer enlarged it in the smaller image of `camera`.

    Args:
        gaussians: a batch of one.
        camera: camera with the size of the image that they look right at.
        targets: see `front_targets`.
    """
    most = gaussians.count
    for target in targets:
        gaussians = seen_larger(gaussians, camera, target.camera)
        camera = target.camera
        most += int(PARTS_PER_PIXEL * target.image.shape[-1] * target.image.shape[-2] * 3 / 4)
        scene = gaussians[0]
        chosen = worth_splitting(gaussians, target, rasterizer, background, (most - scene.count) // (len(PLACES) - 1))
        if not chosen.any():  # fitting would only make large Gaussians grow, which shows from the sides
            continue
        gaussians = split(scene, chosen, camera[0]).repeated(1)
        rounds = LAST_ROUNDS if target is targets[-1] else ROUNDS
        gaussians = fit_front(gaussians, camera, target.image, rasterizer, rounds, background, target.visible, PACE)
    return gaussians


def seen_larger(gaussians: Gaussians, small: Cameras, large: Cameras) -> Gaussians:
    """Return Gaussians that look in a camera's large image as the given ones look in its small one.

    A rasterizer adds `blur` px^2 to each projected covariance, which is less of the scene in a larger image.
    """
    depth = transform_points(small.world_to_camera, gaussians.means)[..., 2]
    before, after = ((depth / camera.intrinsics[..., 0, :1]).square() for camera in (small, large))
    variance = RenderingConstants().blur * (before - after)
    return replace(gaussians, scales=(gaussians.scales.square() + variance[..., None]).sqrt())


def worth_splitting(
    gaussians: Gaussians, target: FrontTarget, rasterizer: Rasterizer, background: float, most: int
) -> Bool[Tensor, " gaussian"]:
    """Return which Gaussians of a batch of one to split: those larger than pixels that show most of the image's error.

    None are split where the image is met as nearly as fitting meets it (`ENOUGH`), because splits alone cost a little.

    Args:
        most: largest number of them.
    """
    errors = _shown_errors(gaussians, target, rasterizer, background)[0]
    total = errors.sum().item()
    across = _across(gaussians[0], target.camera[0]).norm(dim=-2).topk(2).values[:, 1]
    depth = transform_points(target.camera.world_to_camera, gaussians.means)[0, :, 2]
    pixels = across * target.camera.intrinsics[0, 0, 0] / depth
    errors = torch.where((depth > 0) & (pixels > SMALLEST_SPLIT), errors, 0)
    chosen = torch.zeros_like(errors, dtype=torch.bool)
    if total <= ENOUGH * target.image.numel():
        return chosen
    chosen[errors.topk(min(most, len(errors))).indices] = True
    return chosen & (errors > SMALLEST_ERROR)


def _shown_errors(
    gaussians: Gaussians, target: FrontTarget, rasterizer: Rasterizer, background: float
) -> Float[Tensor, "1 gaussian"]:
    """Return the sum of the image's squared errors for each Gaussian, weighted by its share of each pixel."""
    with torch.inference_mode(False), torch.enable_grad():
        fixed = gaussians.map(torch.clone).detach()
        colors = fixed.colors.requires_grad_()
        rendering = rasterizer(replace(fixed, colors=colors), target.camera[:, None].map(torch.clone))
        error = (rendering.over(background).detach() - target.image[:, None]).square().sum(2, keepdim=True)
        if target.visible is not None:
            error = error * target.visible[:, None]
        # A colour's gradient is the sum of the pixels' gradients, weighted by its share of each.
        (shown,) = torch.autograd.grad(rendering.color, colors, error.expand_as(rendering.color))
    return shown[..., 0]


def _across(gaussians: Gaussians, camera: Cameras) -> Float[Tensor, "gaussian 3 axis"]:
    """Return the semi-axes of an unbatched set as columns, without what of them is along the ray."""
    axes = quaternion_to_matrix(gaussians.quaternions) * gaussians.scales[:, None, :]
    rays = functional.normalize(gaussians.means - camera.centers, dim=-1)
    return axes - rays[:, :, None] * (rays[:, None, :] @ axes)


def split(gaussians: Gaussians, chosen: Bool[Tensor, " gaussian"], camera: Cameras) -> Gaussians:
    """Split the chosen Gaussians of an unbatched set into four each, along the two axes that look longest.

    The four look from the camera nearly like the whole. Along their third axis they are no longer than along the
    first, lest they are spikes from the side. They come after all that are not split.
    """
    whole = gaussians[chosen]
    order = _across(whole, camera).norm(dim=-2).argsort(dim=-1, descending=True)
    axes = quaternion_to_matrix(whole.quaternions) * whole.scales[:, None, :]
    first, second = axes.gather(-1, order[:, None, :2].expand(-1, 3, -1)).unbind(-1)
    lengths = whole.scales.gather(-1, order)
    longest = SMALLER * lengths[:, 0]
    parts_lengths = torch.stack([longest, SMALLER * lengths[:, 1], torch.minimum(lengths[:, 2], longest)], dim=-1)
    scales = torch.zeros_like(whole.scales).scatter(-1, order, parts_lengths)
    like = replace(whole, scales=scales, opacities=opacities_of_parts(whole.opacities))
    parts = [replace(like, means=whole.means + u * first + v * second) for u, v in PLACES]
    return merge_gaussians([gaussians[~chosen], *parts])


def opacities_of_parts(opacities: Float[Tensor, " gaussian"]) -> Float[Tensor, " gaussian"]:
    """Return opacities with which four parts cover as much of the image together as the whole does.

    The integral of 1 - (1 - a g1) ... (1 - a g4), where the g are the parts' Gaussians, is a sum of integrals of
    products of Gaussians. It grows with a, so a table of it is inverted.
    """
    table = torch.linspace(0, 1, ENTRIES + 1, dtype=torch.float64)
    places = torch.tensor(PLACES, dtype=torch.float64)
    covered = torch.zeros_like(table)
    for subset in range(1, 2 ** len(PLACES)):
        members = places[[bool(subset >> index & 1) for index in range(len(PLACES))]]
        spread = (members - members.mean(0)).square().sum().item()
        integral = SMALLER**2 / len(members) * math.exp(-spread / (2 * SMALLER**2))  # over that of the whole
        covered -= (-table) ** len(members) * integral
    wanted = opacities.detach().cpu().double().contiguous()
    above = torch.searchsorted(covered, wanted).clamp(1, ENTRIES)
    low = covered[above - 1]
    share = ((wanted - low) / (covered[above] - low)).clamp(0, 1)
    return ((above - 1 + share) / ENTRIES).to(opacities)
