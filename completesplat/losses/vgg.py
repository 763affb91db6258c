"""VGG16's features with torchvision's weights, without torchvision, whose import breaks beside some builds of torch."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from completesplat.errors import WeightsError
from completesplat.weights_files import weights_file

BLOCKS = ((64, 64), (128, 128), (256, 256, 256), (512, 512, 512), (512, 512, 512))
URL = "https://download.pytorch.org/models/vgg16-397923af.pth"
ADVICE = f"fetch VGG16 with `curl -LO {URL}` and give the file as loss.terms.lpips.term.vgg_weights=FILE"


class VGG16Features(nn.Module):
    """The convolutions of VGG16 (Simonyan and Zisserman 2015, configuration D).

    The layers are numbered as in torchvision's `vgg16`, so its state dict's keys fit: `features.0.weight` and on.
    """

    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        last = 3
        for block in BLOCKS:
            if layers:
                layers.append(nn.MaxPool2d(2))
            for channels in block:
                layers += [nn.Conv2d(last, channels, 3, padding=1), nn.ReLU()]
                last = channels
        self.features = nn.Sequential(*layers)

    def forward(self, images: Float[Tensor, "image 3 height width"]) -> list[Float[Tensor, "image _ _ _"]]:
        """What each block gives before it is pooled: relu1_2, relu2_2, relu3_3, relu4_3, relu5_3."""
        outputs = []
        for layer in self.features:
            if isinstance(layer, nn.MaxPool2d):
                outputs.append(images)
            images = layer(images)
        return [*outputs, images]


def load_vgg16(weights: str, sha256: str | None = None) -> VGG16Features:
    """VGG16's features from a state dict of torchvision's `vgg16`; the classifier in it is left out.

    Args:
        weights: a file, or a URL (http or https) that is downloaded into torch's hub cache once.
        sha256: the file's SHA-256, or its first digits.

    Raises:
        WeightsError: the weights are missing, cannot be downloaded, are another file, or have another layout.
    """
    path = weights_file(weights, sha256, ADVICE, "loss.terms.lpips.term.vgg_sha256")
    try:
        contents = torch.load(path, map_location="cpu", weights_only=True)
        part = {key: value for key, value in contents.items() if key.startswith("features.")}
    except Exception as error:
        raise WeightsError(f"{path}: not a readable state dict ({type(error).__name__}); {ADVICE}") from error
    # Without values of its own, the network draws nothing: a run's seed means the same with and without this loss.
    with torch.device("meta"):
        network = VGG16Features()
    try:
        network.load_state_dict(part, assign=True)
    except RuntimeError as error:
        first = str(error).splitlines()[1].strip()
        raise WeightsError(f"{path}: not the weights of torchvision's vgg16 ({first:.200}); {ADVICE}") from error
    return network.float()
