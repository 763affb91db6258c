"""Learned perceptual similarity (LPIPS) on VGG16's features, with torchvision's weights."""

from collections.abc import Collection, Iterable
from importlib.resources import as_file, files

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.errors import WeightsError
from completesplat.losses.terms import Prediction
from completesplat.scene import Views
from completesplat.weights import weights_file
from completesplat.weights.checkpoint_reading import mismatch

BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
URL = "https://download.pytorch.org/models/vgg16-397923af.pth"
ADVICE = f"fetch VGG16 with `curl -LO {URL}` and give the file as loss.terms.lpips.term.vgg_weights=FILE"
# Mean and standard deviation of ImageNet's colours on [-1, 1] (Zhang et al., `lpips/lpips.py`, ScalingLayer).
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
SMALLEST_NORM = 1e-10
RGB = tuple[float, float, float]
Images = Float[Tensor, "image 3 height width"]
Head = Float[Tensor, "1 _ 1 1"]


class Activations(nn.Module):
    """Sequence of layers that returns its activations after certain numbers of layers, the `ends`."""

    def __init__(self, layers: Iterable[nn.Module], ends: Collection[int]) -> None:
        super().__init__()
        self.features = nn.Sequential(*layers)
        self.ends = ends

    def forward(self, images: Images) -> list[Float[Tensor, "image _ _ _"]]:
        outputs = []
        for number, layer in enumerate(self.features, 1):
            images = layer(images)
            if number in self.ends:
                outputs.append(images)
        return outputs


def vgg16() -> Activations:
    """Build the convolutions of VGG16 (Simonyan and Zisserman 2015, configuration D).

    The layers are numbered as in torchvision's `vgg16`, so its state dict's keys fit: `features.0.weight` and so on.
    The outputs are those of each block before pooling: relu1_2, relu2_2, relu3_3, relu4_3, relu5_3.
    """
    layers: list[nn.Module] = []
    ends = []
    last = 3
    for block in BLOCKS:
        for channels in block:
            layers += [nn.Conv2d(last, channels, 3, padding=1), nn.ReLU()]
            last = channels
        ends.append(len(layers))
        layers.append(nn.MaxPool2d(2))
    return Activations(layers[:-1], ends)


def load_vgg16(weights: str, sha256: str | None = None) -> Activations:
    """Load VGG16's features from a state dict of torchvision's `vgg16`, without its classifier.

    Args:
        weights: a file, or a URL (http or https) that is downloaded into torch's hub cache once.
        sha256: the file's SHA-256, or its first digits.

    Raises:
        WeightsError: the weights are missing, cannot be downloaded, have another SHA-256, or have another layout.
    """
    path = weights_file(weights, sha256, ADVICE, "loss.terms.lpips.term.vgg_sha256")
    try:
        contents = torch.load(path, map_location="cpu", weights_only=True)
        state: dict[str, Tensor] = {}
        for key, value in contents.items():
            if isinstance(value, Tensor) and key.startswith("features."):
                state[key] = value
    except Exception as error:
        raise WeightsError(f"{path}: not a readable state dict ({type(error).__name__}); {ADVICE}") from error
    # On "meta", the network draws no random numbers, so this loss does not change those of the rest of the run.
    with torch.device("meta"):
        network = vgg16()
    reason = mismatch(network.state_dict(), state)
    if reason is not None:
        raise WeightsError(f"{path}: not the weights of torchvision's vgg16 ({reason}); {ADVICE}")
    network.load_state_dict(state, assign=True)
    return network.float()


class PerceptualDistance(nn.Module):
    """Weighted squared distance of a frozen network's unit-length features (Zhang et al. 2018, Eq. 1).

    With VGG16 and `load_heads`, it is LPIPS, version 0.1 (their repository `PerceptualSimilarity`).

    Args:
        features: network whose activations are compared.
        heads: non-negative weight of each channel of each activation.
        shift, scale: the network takes (2 x - 1 - shift) / scale for sRGB colours x in [0, 1].
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, features: Activations, heads: list[Head], shift: RGB = SHIFT, scale: RGB = SCALE) -> None:
        super().__init__()
        self.features = features
        self.heads = nn.ParameterList(heads)
        self.register_buffer("shift", torch.tensor(shift).view(3, 1, 1))
        self.register_buffer("scale", torch.tensor(scale).view(3, 1, 1))
        self.requires_grad_(False)

    def forward(self, first: Images, second: Images) -> Float[Tensor, " image"]:
        """Return the distance of each pair of sRGB images with values in [0, 1] and sides of at least 16 pixels."""
        # Weights moved to a device in inference mode (validation before the first step) could not be used in training.
        if self.shift.device != first.device:
            with torch.inference_mode(False):
                self.to(first.device)
        layers = zip(self.heads, self.directions(first), self.directions(second), strict=True)
        maps = [nn.functional.conv2d((left - right).square(), head) for head, left, right in layers]
        return torch.stack([differences.mean((1, 2, 3)) for differences in maps]).sum(0)

    def directions(self, images: Images) -> list[Float[Tensor, "image _ _ _"]]:
        """Return each layer's activations with unit length over the channels, or zeros where no channel is active."""
        activations = self.features((2 * images - 1 - self.shift) / self.scale)
        # Where all channels are zero, the gradient of this norm is zero. That of a square root of a sum is not finite.
        norms = [torch.linalg.vector_norm(layer, dim=1, keepdim=True) for layer in activations]
        return [layer / (norm + SMALLEST_NORM) for layer, norm in zip(activations, norms, strict=True)]


def load_heads() -> list[Head]:
    """Load the weights of version 0.1 for VGG, which torchmetrics ships."""
    resource = files("torchmetrics.functional.image") / "lpips_models" / "vgg.pth"
    with as_file(resource) as path:
        weights = torch.load(path, map_location="cpu", weights_only=True)
    return [weights[f"lin{layer}.model.1.weight"] for layer in range(5)]


class PerceptualTerm:
    """Loss term: a `PerceptualDistance`, averaged over the views, always in float32.

    The network is not part of the trained module, so no checkpoint holds it. With `views`, so many views are drawn for
    each batch, the same for all of its scenes, and the others do not count.
    """

    views: int | None = None

    distance: PerceptualDistance

    def __call__(self, prediction: Prediction, truth: Views) -> Float[Tensor, ""]:
        chosen = slice(None) if self.views is None else torch.randperm(truth.images.shape[1])[: self.views]
        with torch.autocast(prediction.images.device.type, enabled=False):
            predicted = prediction.images[:, chosen].flatten(0, 1).float()
            true = truth.images[:, chosen].flatten(0, 1).float()
            return torch.mean(self.distance(predicted, true))


class LearnedPerceptualSimilarity(PerceptualTerm):
    """LPIPS with VGG16 (paper, Eq. 1, third term).

    Args:
        vgg_weights, vgg_sha256: see `load_vgg16`; `vgg_sha256=None` accepts any file of the right layout.
    """

    def __init__(self, vgg_weights: str, vgg_sha256: str | None = None) -> None:
        self.distance = PerceptualDistance(load_vgg16(vgg_weights, vgg_sha256), load_heads())
