"""The Inception of FID and KID, with a small TorchScript network of the same calling convention in its place."""

import hashlib

import pytest
import torch

from completesplat.errors import WeightsError
from completesplat.metrics.image_sets import SHA256, URL, load_inception

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")


class Means(torch.nn.Module):
    """Mean of each channel, by a product that autocast would round, and mean of the whole image."""

    def __init__(self) -> None:
        super().__init__()
        self.factor = torch.nn.Parameter(torch.eye(3))

    def forward(self, img: torch.Tensor, return_features: bool = False, use_fp16: bool = False) -> torch.Tensor:
        assert img.dtype == torch.uint8
        assert not self.training
        x = img.float().mean((2, 3)) @ self.factor
        if return_features:
            return torch.cat([x, x.mean(1, keepdim=True)], 1)
        return x.softmax(1)


@pytest.fixture
def file(tmp_path):
    torch.jit.script(Means()).save(str(tmp_path / "inception.pt"))
    return tmp_path / "inception.pt"


def test_features_are_those_of_the_image_in_8_bits_from_a_frozen_network_that_knows_no_autocast(file):
    network = load_inception(str(file), hashlib.sha256(file.read_bytes()).hexdigest())
    levels = torch.tensor([0.0, 0.4999 / 255, 0.5001 / 255, 0.6, 1.0, 1.5, -1.0])
    images = levels.view(-1, 1, 1, 1) * torch.tensor([1.0, 0.0, 0.0]).view(3, 1, 1).expand(3, 4, 5)
    features = network.describe(images)
    red = torch.tensor([0.0, 0, 1, 153, 255, 255, 0])
    torch.testing.assert_close(features, torch.stack([red, 0 * red, 0 * red, red / 3], dim=1))
    with torch.autocast("cpu", torch.bfloat16):
        assert torch.equal(network.describe(images), features)
    assert not features.requires_grad


def test_only_the_published_file_is_run_unless_another_hash_is_given(file):
    with pytest.raises(WeightsError, match=f"SHA-256 {hashlib.sha256(file.read_bytes()).hexdigest()}, not {SHA256}"):
        load_inception(str(file))
    with pytest.raises(WeightsError, match="SHA-256"):
        load_inception(str(file), "0" * 64)


@pytest.mark.parametrize(
    ("write", "reason"),
    [
        (lambda path: None, "no such file"),
        (lambda path: path.write_bytes(b"PK\x03\x04"), "not a readable TorchScript file"),
        (lambda path: torch.save(Means().state_dict(), path), "not a readable TorchScript file"),
        (lambda path: torch.jit.script(torch.nn.Identity()).save(str(path)), "gives no features"),
    ],
)
def test_other_files_are_refused_in_one_line_with_advice(tmp_path, write, reason):
    write(tmp_path / "network.pt")
    with pytest.raises(WeightsError, match=reason) as caught:
        load_inception(str(tmp_path / "network.pt"), None)
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'network.pt'}: ")
    assert f"curl -LO {URL}" in message
    assert "\n" not in message
