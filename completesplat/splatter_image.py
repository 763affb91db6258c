"""Splatter Images: M layers of 15 or more raw values per pixel, and the activations that turn them into Gaussians.

All activations of the project are here (paper, supplement A.1; values and initialisation of Szymanowicz et al.,
"Splatter Image", `gaussian_predictor.py`). Per layer and pixel, in this order: depth 1, offset 3, opacity 1,
scale 3, rotation 4, colour 3, and, where colours depend on the direction, red, green and blue of each further harmonic.
Gaussians are in the reference camera's frame, ordered by layer, row, column.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal, NamedTuple

import torch
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.gaussians import DirectionalGaussians, Gaussians
from completesplat.geometry.cameras import Cameras, pixel_rays
from completesplat.geometry.harmonics import LARGEST_DEGREE, SH_C0, coefficients
from completesplat.geometry.rotations import normalize_quaternion
from completesplat.quantities import Few, Range
from completesplat.tensors import TensorDataclass


class Group(NamedTuple):
    """Group of raw values: their number, and the gain and bias of Splatter Image's head (`initialize_head`).

    The `Parameterization` sets the biases of depth and scale instead.
    """

    channels: int
    gain: float
    bias: float


GROUPS = {
    "depth": Group(1, 1.0, 0.0),
    "offset": Group(3, 0.1, 0.0),
    "opacity": Group(1, 1.0, -2.0),
    "scale": Group(3, 0.003, 0.0),
    "rotation": Group(4, 1.0, 0.0),
    "color": Group(3, 5.0, 0.0),
}
CHANNELS = sum(group.channels for group in GROUPS.values())
HARMONICS_GAIN = 0.5  # a tenth of the colour's, so that a new network's colours hardly depend on the direction

LayerMaps = Float[Tensor, "*batch layer height width"]


def independent_depths(raw: LayerMaps, near: Tensor, far: Tensor) -> LayerMaps:
    """Return z = near + (far - near) * sigmoid(raw) for every layer, the plain reading of the paper."""
    return near + (far - near) * raw.sigmoid()


def incremental_depths(raw: LayerMaps, near: Tensor, far: Tensor) -> LayerMaps:
    """Return the first layer as `independent_depths` does, and each further one exp(raw) behind the last (Flash3D).

    `initialize_head` makes that distance `Parameterization.layer_step` at first.
    """
    first = independent_depths(raw[..., :1, :, :], near, far)
    steps = raw[..., 1:, :, :].clamp(-10, 6).exp()
    return torch.cat([first, steps], dim=-3).cumsum(dim=-3)


def bent_below(values: Tensor, largest: float) -> Tensor:
    """Return values that approach a bound from below: the `largest` less softplus(largest - value).

    Far below the bound they hardly change. The gradient is nowhere 0: half at the bound, and falling beyond.
    """
    return largest - torch.nn.functional.softplus(largest - values)


LAYER_DEPTHS = {"independent": independent_depths, "incremental": incremental_depths}

Length = Annotated[float, Range(1e-9, 1e9)]
Degree = Annotated[int, Range(0, LARGEST_DEGREE)]


@dataclass(frozen=True)
class Parameterization:
    """Settings of the activations that turn raw values into Gaussians.

    Attributes:
        layers: M, Gaussians per pixel (2 in the paper).
        layer_depths: relation between the depths of one pixel's layers, a key of `LAYER_DEPTHS`.
        first_depth: initial depth of Gaussians, as a share of the depth range. One half is the object's distance in
            Splatter Image, whose range is centred on it.
        first_scale: initial standard deviation of Gaussians, in scene units; 0.02 in Splatter Image, about one pixel
            of an object in an image of 128.
        layer_step: initial distance of a layer behind the last with incremental depths, in scene units.
        smallest_scale, largest_scale: the exponential of the raw scale is clamped to this range, in scene units
            (the paper states none). The clamp has no gradient outside and the full gradient inside.
        smooth_scales: near `largest_scale`, bend towards it in place of the clamp, so that Gaussians that reach it keep
            a gradient and can shrink again. Small scales stay almost as they are.
        harmonics: largest degree of the spherical harmonics of colours. 0 is the paper's: one colour for all
            directions. Light that stands still while an object turns needs 1 to 3.
        within_range: give opacity 0 to Gaussians that their offset moves nearer than the depth range, because they
            can hide the object like a fog from other sides. The paper keeps them.
    """

    layers: Few = 2
    layer_depths: Literal["independent", "incremental"] = "independent"
    first_depth: Annotated[float, Range(1e-3, 0.999)] = 0.5
    first_scale: Length = 0.02
    layer_step: Length = 1.0
    smallest_scale: Length = 1e-4
    largest_scale: Length = 2.0
    harmonics: Degree = 0
    within_range: bool = False
    smooth_scales: bool = False

    @property
    def groups(self) -> dict[str, Group]:
        """Return the groups of a layer's raw values, in order."""
        if self.harmonics == 0:
            return GROUPS
        return GROUPS | {"harmonics": Group(3 * coefficients(self.harmonics), HARMONICS_GAIN, 0.0)}

    @property
    def layer_channels(self) -> int:
        """Return the number of a layer's raw values: 15 without harmonics."""
        return sum(group.channels for group in self.groups.values())

    @property
    def channels(self) -> int:
        return self.layers * self.layer_channels


@dataclass(frozen=True)
class SplatterImage(TensorDataclass):
    """Raw network output for every layer and pixel of a reference image."""

    raw: Float[Tensor, "*batch layer value height width"]
    parameterization: Parameterization

    def split(self) -> dict[str, Float[Tensor, "*batch layer channel height width"]]:
        """Return the raw values by group, in the order of `Parameterization.groups`."""
        groups = self.parameterization.groups
        parts = torch.split(self.raw, [group.channels for group in groups.values()], dim=-3)
        return dict(zip(groups, parts, strict=True))

    def gaussians(self, cameras: Cameras, depth_range: Float[Tensor, "*batch 2"]) -> Gaussians:
        """Activate the raw values and place each Gaussian on its pixel's ray (supplement A.1).

        Args:
            cameras: the reference cameras [*batch]; only their intrinsics matter, and the result is in their frames.
            depth_range: near and far along the optical axis, in scene units.
        """
        parts = self.split()
        settings = self.parameterization
        near, far = (x[..., None, None, None] for x in depth_range.unbind(-1))
        depth = LAYER_DEPTHS[settings.layer_depths](parts["depth"].squeeze(-3), near, far)
        rays = rearrange(pixel_rays(cameras), "... height width xyz -> ... 1 xyz height width")
        opacity = parts["opacity"].sigmoid()
        if settings.within_range:
            opacity = opacity * (depth + parts["offset"].select(-3, 2) >= near).unsqueeze(-3)
        log_scale = parts["scale"]
        if settings.smooth_scales:
            log_scale = bent_below(log_scale, math.log(settings.largest_scale))
        log_scale = log_scale.clamp(math.log(settings.smallest_scale), math.log(settings.largest_scale))

        def flat(values: Tensor) -> Tensor:
            return rearrange(values, "... layer channel height width -> ... (layer height width) channel")

        colors = flat(0.5 + SH_C0 * parts["color"])
        plain = Gaussians(
            means=flat(rays * depth.unsqueeze(-3) + parts["offset"]),
            quaternions=normalize_quaternion(flat(parts["rotation"])),
            scales=flat(log_scale.exp()),
            opacities=flat(opacity).squeeze(-1),
            colors=colors if settings.harmonics else colors.clamp(min=0),
        )
        if not settings.harmonics:
            return plain
        further = rearrange(flat(parts["harmonics"]), "... (coefficient rgb) -> ... coefficient rgb", rgb=3)
        return DirectionalGaussians(**vars(plain), harmonics=further)


def from_channels(
    output: Float[Tensor, "batch channel height width"], parameterization: Parameterization
) -> SplatterImage:
    """Wrap a network's output, whose channels are ordered by layer, then by group."""
    layers = parameterization.layers
    raw = rearrange(output, "batch (layer channel) height width -> batch layer channel height width", layer=layers)
    return SplatterImage(raw, parameterization)


@torch.no_grad()
def initialize_head(head: nn.Conv2d, parameterization: Parameterization) -> None:
    """Initialise a network's last convolution, after group normalisation and SiLU, like Splatter Image's output.

    Upstream's output passes a 3x3 convolution from 128 to N channels (xavier, weights times 0.2) and then a 1x1
    convolution with a gain for each group (`gaussian_predictor.py`, SongUNet and SingleImageSongUNetPredictor). The
    single convolution here has the variance that gives its raw values the same standard deviation.
    """
    assert head.bias is not None
    inputs = head.weight[0].numel()
    first = math.log(parameterization.first_depth / (1 - parameterization.first_depth))
    starts = {"scale": math.log(parameterization.first_scale)}
    row = 0
    for layer in range(parameterization.layers):
        behind = layer > 0 and parameterization.layer_depths == "incremental"
        starts["depth"] = math.log(parameterization.layer_step) if behind else first
        for name, group in parameterization.groups.items():
            rows = slice(row, row + group.channels)
            row = row + group.channels
            bound = math.sqrt(3 * _upstream_variance(group) / inputs)
            nn.init.uniform_(head.weight[rows], -bound, bound)
            nn.init.constant_(head.bias[rows], starts.get(name, group.bias))


def _upstream_variance(group: Group) -> float:
    """Return the variance of upstream's raw values for inputs of mean square 1: inputs times weight variance, twice."""
    inputs = 128 * 9
    outputs = CHANNELS * 9
    first = inputs * 0.2**2 * 2 / (inputs + outputs)
    second = CHANNELS * group.gain**2 * 2 / (CHANNELS + group.channels)
    return first * second


@torch.no_grad()
def zeroed(layer: nn.Module) -> nn.Module:
    """Set all weights of a layer to zero, and return it."""
    for parameter in layer.parameters():
        parameter.zero_()
    return layer
