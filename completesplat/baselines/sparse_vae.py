"""VAE of sparse Splatter Images: the second half of an approach that the supplement reports as failed.

The supplement ("Pre-optimizing 3D Gaussian splats and projecting into Splatter Images") states neither the network nor
the loss: "We find it difficult to train a VAE to encode each modalities of such sparse splatter images".
"""

from collections.abc import Callable, Iterable

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.model import Reconstruction
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.baselines.preoptimized import occupied
from completesplat.errors import CompleteSplatError
from completesplat.splatter_image import SplatterImage
from completesplat.tensors import as_float64

Raw = Float[Tensor, "batch layer 15 height width"]


class SparseVAE(nn.Module):
    """VAE from a Splatter Image to a Splatter Image, made of the autoreconstructor's blocks without skips.

    A place is one layer of one pixel. For each place the encoder sees 15 normalised raw values (zeros if the place is
    empty), and whether it is occupied. The decoder's outputs are normalised raw values; a low opacity marks an empty
    place. In training a latent is drawn from the posterior; in evaluation its mode is used.

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
        layers, channels = reconstructor.parameterization.layers, reconstructor.parameterization.layer_channels
        self.encoder = encoder(in_channels=layers * (channels + 1))
        self.reconstructor = reconstructor
        reconstructor.network.conv_out.reset_parameters()
        # Statistics of the raw values of occupied places, by layer and channel.
        self.register_buffer("mean", torch.zeros(layers, channels, 1, 1))
        self.register_buffer("std", torch.ones(layers, channels, 1, 1))

    def forward(self, image: SplatterImage) -> Reconstruction:
        mask = occupied(image)[:, :, None]
        seen = torch.cat([torch.where(mask, self.normalize(image.raw), 0.0), mask.float()], dim=2)
        posterior, _ = self.encoder.encode(seen.flatten(1, 2))
        latent = posterior.sample() if self.training else posterior.mode()
        decoded = self.reconstructor(latent, ())
        return Reconstruction(SplatterImage(decoded.raw * self.std + self.mean, decoded.parameterization), posterior)

    def normalize(self, raw: Raw) -> Raw:
        """Normalise raw values to mean 0 and standard deviation 1 in each channel of each layer."""
        return (raw - self.mean) / self.std

    @torch.no_grad()
    def measure(self, images: Iterable[SplatterImage]) -> None:
        """Set the normalisation to the mean and standard deviation over the occupied places of these images."""
        count, total, squares = (torch.zeros_like(as_float64(self.mean)) for _ in range(3))
        for image in images:
            mask = occupied(image)[:, :, None]
            raw = as_float64(torch.where(mask, image.raw, 0.0))
            count += as_float64(mask).sum(dim=(0, 3, 4), keepdim=True)[0]
            total += raw.sum(dim=(0, 3, 4), keepdim=True)[0]
            squares += raw.square().sum(dim=(0, 3, 4), keepdim=True)[0]
        mean = total / count.clamp(min=1)
        variance = squares / count.clamp(min=1) - mean.square()
        self.mean.copy_(mean)
        # A channel that does not vary is only centred; a layer without Gaussians is not normalised.
        self.std.copy_(torch.where(variance > 1e-8, variance, 1.0).sqrt())

    def errors(self, predicted: SplatterImage, truth: SplatterImage) -> dict[str, Float[Tensor, ""]]:
        """Return the reconstruction error of each group of raw values.

        It is the mean squared error of the normalised values over occupied places; for "opacity", the binary cross
        entropy over all places in nats, where an empty place has opacity 0.
        """
        mask = occupied(truth)[:, :, None]
        squared = torch.where(mask, self.normalize(predicted.raw) - self.normalize(truth.raw), 0.0).square()
        places = mask.sum().clamp(min=1)
        errors = {
            name: group.sum() / (places * group.shape[2])
            for name, group in SplatterImage(squared, truth.parameterization).split().items()
        }
        logits, opacities = predicted.split()["opacity"], truth.split()["opacity"].sigmoid()
        return errors | {"opacity": nn.functional.binary_cross_entropy_with_logits(logits, opacities)}
