"""The Inception network whose features FID and KID compare."""

import warnings

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.errors import WeightsError
from completesplat.weights_files import weights_file

URL = "https://nvlabs-fi-cdn.nvidia.com/stylegan2-ada-pytorch/pretrained/metrics/inception-2015-12-05.pt"
SHA256 = "f58cb9b6ec323ed63459aa4fb441fe750cfe39fafad6da5cb504a16f19e958f4"
"""Of the file behind `URL`, as k-diffusion (`k_diffusion/evaluation.py`) states it too."""
ADVICE = f"fetch Inception with `curl -LO {URL}` and give it as evaluation.scoring.sets.inception.weights=FILE"


class InceptionFeatures(nn.Module):
    """Pool features of images, by a TorchScript Inception that takes bytes and resizes them itself; frozen.

    Args:
        network: called as NVlabs' `stylegan2-ada-pytorch/metrics` do: `network(bytes, return_features=True)`.
    """

    def __init__(self, network: torch.jit.ScriptModule) -> None:
        super().__init__()
        self.network = network.eval()
        self.requires_grad_(False)

    @torch.no_grad()
    def forward(self, images: Float[Tensor, "image 3 height width"]) -> Float[Tensor, "image feature"]:
        """Features (2048 of NVlabs' network) of sRGB images with values in [0, 1], rounded to 8 bits."""
        pixels = (255 * images.clamp(0, 1)).round().to(torch.uint8)
        with torch.autocast(images.device.type, enabled=False):
            return self.network(pixels, return_features=True).float()


def load_inception(weights: str = URL, sha256: str | None = SHA256) -> InceptionFeatures:
    """NVlabs' translation of the network that FID is defined with (Heusel et al. 2017; `inception-2015-12-05`).

    A TorchScript file is a program, not mere weights: only the one with this hash is run. With `sha256` None any file
    is run, and whoever gives it vouches for it.

    Args:
        weights: a file, or a URL (http or https) that is downloaded into torch's hub cache once.
        sha256: the file's SHA-256, or its first digits.

    Raises:
        WeightsError: the file is missing, cannot be downloaded, is another one, or is no such network.
    """
    path = weights_file(weights, sha256, ADVICE, "evaluation.scoring.sets.inception.sha256")
    try:
        with warnings.catch_warnings():
            # torch would have new programs exported; this one is published as TorchScript only.
            warnings.simplefilter("ignore", DeprecationWarning)
            network = torch.jit.load(str(path), map_location="cpu")
    except (OSError, RuntimeError, ValueError) as error:
        raise WeightsError(f"{path}: not a readable TorchScript file; {ADVICE}") from error
    if "return_features" not in {argument.name for argument in network.forward.schema.arguments}:
        raise WeightsError(f"{path}: a TorchScript file, but of a network that gives no features; {ADVICE}")
    return InceptionFeatures(network)
