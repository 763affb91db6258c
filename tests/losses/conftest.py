import pytest
import torch
from vgg_weights import CONVOLUTIONS


@pytest.fixture(scope="module")
def weights() -> dict[str, torch.Tensor]:
    """Random weights under which the variance of the activations stays the same from layer to layer."""
    generator = torch.Generator().manual_seed(0)
    made = {}
    for index, (channels, outputs) in CONVOLUTIONS.items():
        weight = torch.randn(outputs, channels, 3, 3, generator=generator)
        made[f"features.{index}.weight"] = weight * (2 / (9 * channels)) ** 0.5
        made[f"features.{index}.bias"] = 0.1 * torch.randn(outputs, generator=generator)
    return made


@pytest.fixture(scope="module")
def vgg_file(weights, tmp_path_factory):
    """The weights as a file, with something of the classifier, as in torchvision's; 60 MB, so it does not stay."""
    path = tmp_path_factory.mktemp("vgg") / "vgg16.pth"
    torch.save(weights | {"classifier.6.bias": torch.zeros(1000)}, path)
    yield path
    path.unlink()
