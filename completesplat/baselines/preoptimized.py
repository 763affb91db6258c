"""Supplement's failed "Pre-optimizing 3D Gaussian splats and projecting into Splatter Images".

Any 3D Gaussians are projected into a Splatter Image: each goes to the pixel that its centre falls into, which leaves
80 % of pixels empty. A VAE then encodes such sparse Splatter Images. The paper states neither its network nor its loss:
"We find it difficult to train a VAE to encode each modalities of such sparse splatter images".
"""

import math
from collections.abc import Callable, Iterable

import torch
from einops import rearrange
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.model import Reconstruction
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pixel_rays, project
from completesplat.geometry.harmonics import SH_C0
from completesplat.rasterizers import RenderingConstants
from completesplat.splatter_image import LAYER_DEPTHS, LayerMaps, Parameterization, SplatterImage
from completesplat.tensors import as_float64

EMPTY_LOGIT = -30.0
"""Raw opacity of a place without a Gaussian: its opacity is 1e-13."""
CERTAINTY = 1e-6
"""Smallest distance of shares and opacities from 0 and 1, where their logits are infinite."""

Raw = Float[Tensor, "batch layer 15 height width"]


def project_to_splatter_image(
    gaussians: Gaussians, cameras: Cameras, depth_range: Float[Tensor, "batch 2"], parameterization: Parameterization
) -> tuple[SplatterImage, Bool[Tensor, "batch height width"]]:
    """Return the Splatter Image of a set of Gaussians, and a mask of its pixels without a Gaussian in any layer.

    Each pixel takes its most opaque Gaussians, the most opaque one in the first layer. Gaussians behind the camera,
    outside its image, or with an opacity below 1/255 (never drawn) are dropped. The offset represents what ray and
    depth range cannot. Scales are clamped to the parameterisation's range, opacities to 1e-6 below 1.

    Args:
        gaussians: [batch], in the reference cameras' frames.
        cameras: the reference cameras [batch], of which only the intrinsics matter.
        depth_range: near and far along the optical axis, in scene units.
    """
    height, width = cameras.image_size
    grid = (gaussians.means.shape[0], parameterization.layers, height, width)
    source, place = _places(gaussians, cameras, parameterization.layers)

    def placed(values: Float[Tensor, "batch gaussian channel"], elsewhere: float) -> Tensor:
        """Arrange values as [batch layer channel height width]."""
        flat = values.new_full((math.prod(grid), values.shape[-1]), elsewhere)
        flat[place] = values.flatten(0, 1)[source]
        return flat.view(*grid, -1).movedim(-1, 2)

    smallest = math.log(parameterization.smallest_scale)
    largest = math.log(parameterization.largest_scale)
    means = placed(gaussians.means, 0.0)
    filled = placed(torch.ones_like(gaussians.opacities)[..., None], 0.0).bool()
    near, far = (x[:, None, None, None] for x in depth_range.unbind(-1))
    raw_depths = _raw_depths(means[:, :, 2], near, far, parameterization.layer_depths)
    depths = LAYER_DEPTHS[parameterization.layer_depths](raw_depths, near, far)
    rays = rearrange(pixel_rays(cameras), "b h w xyz -> b 1 xyz h w")
    parts = [
        raw_depths[:, :, None],
        torch.where(filled, means - rays * depths[:, :, None], 0.0),
        placed(gaussians.opacities.logit(CERTAINTY)[..., None], EMPTY_LOGIT),
        placed(gaussians.scales.log().clamp(smallest, largest), smallest),
        placed(gaussians.quaternions, 0.0),
        placed((gaussians.colors - 0.5) / SH_C0, 0.0),
    ]
    if parameterization.harmonics:
        parts.append(parts[0].new_zeros(*grid[:2], parameterization.groups["harmonics"].channels, height, width))
    return SplatterImage(torch.cat(parts, dim=2), parameterization), ~filled.any(dim=1).squeeze(1)


def occupied(image: SplatterImage) -> Bool[Tensor, "batch layer height width"]:
    """Return which places of a projection's Splatter Image hold a Gaussian."""
    return image.split()["opacity"].squeeze(2) > EMPTY_LOGIT


def _places(gaussians: Gaussians, cameras: Cameras, layers: int) -> tuple[Int64[Tensor, " n"], Int64[Tensor, " n"]]:
    """Return the selected Gaussians and their places: indices into [batch gaussian] and [batch layer height width]."""
    height, width = cameras.image_size
    # The Gaussians are in the camera's frame, so its pose in the world does not matter.
    identity = torch.eye(4).to(cameras.world_to_camera).expand_as(cameras.world_to_camera)
    pixels, depths = project(Cameras(identity, cameras.intrinsics, cameras.image_size), gaussians.means)
    column, row = pixels.floor().unbind(-1)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height) & (depths > 0)
    usable = (inside & (gaussians.opacities >= RenderingConstants().min_alpha)).flatten().nonzero().squeeze(-1)
    source = usable[gaussians.opacities.flatten()[usable].argsort(descending=True, stable=True)]
    scene = source // gaussians.count
    pixel = row.flatten()[source].long() * width + column.flatten()[source].long()
    key, order = (scene * height * width + pixel).sort(stable=True)
    source = source[order]
    scene = scene[order]
    pixel = pixel[order]
    # Number of earlier Gaussians in the same pixel.
    layer = torch.arange(len(key), device=key.device) - torch.searchsorted(key, key)
    selected = layer < layers
    place = (scene * layers + layer) * height * width + pixel
    return source[selected], place[selected]


def _raw_depths(depths: LayerMaps, near: Tensor, far: Tensor, layer_depths: str) -> LayerMaps:
    """Return raw values that activate close to these depths. The offset represents the rest."""
    shares = ((depths - near) / (far - near)).logit(CERTAINTY)
    if layer_depths == "independent":
        return shares
    steps = depths.diff(dim=1).clamp(min=math.exp(-10)).log().clamp(max=6)
    return torch.cat([shares[:, :1], steps], dim=1)


class SparseVAE(nn.Module):
    """VAE from a Splatter Image to a Splatter Image, made of the autoreconstructor's blocks without skips.

    A place is one layer of one pixel. For each place the encoder sees 15 normalised raw values (zeros if the place is
    empty), and whether it is occupied. The decoder's outputs are normalised raw values. A low opacity marks an empty
    place. In training a latent is drawn from the posterior. In evaluation its mode is used.

    Args:
        encoder: builds an `Encoder` from a number of `in_channels`.
        reconstructor: its last convolution starts with PyTorch's defaults, since its outputs are normalised.

    Raises:
        CompleteSplatError: the reconstructor has skips, which would carry the Splatter Image past the latent.
    """

    mean: Tensor
    std: Tensor

    def __init__(self, encoder: Callable[..., Encoder], reconstructor: Reconstructor) -> None:
        super().__init__()
        if len(reconstructor.skips) > 0:
            raise CompleteSplatError("a VAE of Splatter Images has no skips: set its reconstructor's skip_levels=[]")
        layers = reconstructor.parameterization.layers
        channels = reconstructor.parameterization.layer_channels
        self.encoder = encoder(in_channels=layers * (channels + 1))
        self.reconstructor = reconstructor
        reconstructor.network.conv_out.reset_parameters()
        # Statistics of the raw values of occupied places, by layer and channel.
        self.register_buffer("mean", torch.zeros(layers, channels, 1, 1))
        self.register_buffer("std", torch.ones(layers, channels, 1, 1))

    def forward(self, image: SplatterImage) -> Reconstruction:
        mask = occupied(image)[:, :, None]
        inputs = torch.cat([torch.where(mask, self.normalize(image.raw), 0.0), mask.float()], dim=2)
        posterior, _ = self.encoder.encode(inputs.flatten(1, 2))
        latent = posterior.sample() if self.training else posterior.mode()
        decoded = self.reconstructor(latent, ())
        return Reconstruction(SplatterImage(decoded.raw * self.std + self.mean, decoded.parameterization), posterior)

    def normalize(self, raw: Raw) -> Raw:
        """Normalise raw values to mean 0 and standard deviation 1 in each channel of each layer."""
        return (raw - self.mean) / self.std

    @torch.no_grad()
    def measure(self, images: Iterable[SplatterImage]) -> None:
        """Set the normalisation to the mean and standard deviation over the occupied places of these images."""
        count = torch.zeros_like(as_float64(self.mean))
        total = torch.zeros_like(count)
        squares = torch.zeros_like(count)
        for image in images:
            mask = occupied(image)[:, :, None]
            raw = as_float64(torch.where(mask, image.raw, 0.0))
            count += as_float64(mask).sum(dim=(0, 3, 4), keepdim=True)[0]
            total += raw.sum(dim=(0, 3, 4), keepdim=True)[0]
            squares += raw.square().sum(dim=(0, 3, 4), keepdim=True)[0]
        mean = total / count.clamp(min=1)
        variance = squares / count.clamp(min=1) - mean.square()
        self.mean.copy_(mean)
        # A channel that does not vary is only centred. A layer without Gaussians is not normalised.
        self.std.copy_(torch.where(variance > 1e-8, variance, 1.0).sqrt())

    def errors(self, predicted: SplatterImage, truth: SplatterImage) -> dict[str, Float[Tensor, ""]]:
        """Return the reconstruction error of each group of raw values.

        It is the mean squared error of the normalised values over occupied places. That of "opacity" is the binary
        cross entropy over all places in nats, where an empty place has opacity 0.
        """
        mask = occupied(truth)[:, :, None]
        squared = torch.where(mask, self.normalize(predicted.raw) - self.normalize(truth.raw), 0.0).square()
        places = mask.sum().clamp(min=1)
        groups = SplatterImage(squared, truth.parameterization).split()
        errors = {name: group.sum() / (places * group.shape[2]) for name, group in groups.items()}
        logits = predicted.split()["opacity"]
        opacities = truth.split()["opacity"].sigmoid()
        errors["opacity"] = nn.functional.binary_cross_entropy_with_logits(logits, opacities)
        return errors
