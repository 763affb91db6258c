"""VGG16's weights: the right ones, or a refusal that says how to get them."""

import pytest
import torch
from vgg_weights import blank, digest, saved

from completesplat.errors import WeightsError
from completesplat.losses.lpips import URL, LearnedPerceptualSimilarity, load_vgg16


def test_the_right_hash_or_its_first_digits_are_accepted_and_half_precision_too(vgg_file, weights, tmp_path):
    for sha256 in (digest(vgg_file), digest(vgg_file)[:8].upper()):
        network = load_vgg16(str(vgg_file), sha256)
        assert torch.equal(network.state_dict()["features.28.weight"], weights["features.28.weight"])
    half = {name: tensor.half() for name, tensor in blank().items()}
    network = load_vgg16(str(saved(half, tmp_path / "right.pth")))
    assert {value.dtype for value in network.parameters()} == {torch.float32}


def refusal(vgg_weights: object, sha256: str | None = None) -> str:
    with pytest.raises(WeightsError) as caught:
        LearnedPerceptualSimilarity(str(vgg_weights), sha256)
    message = str(caught.value)
    assert "\n" not in message
    assert f"curl -LO {URL}" in message
    assert "loss.terms.lpips.term.vgg_weights=FILE" in message
    return message


def test_a_file_that_is_no_state_dict_is_refused(tmp_path):
    torch.save([1, 2], tmp_path / "list.pth")
    torch.save({"features.0.weight": torch.nn.Identity()}, tmp_path / "code.pth")
    (tmp_path / "page.pth").write_text("<html>not found</html>")
    for name in ("list", "code", "page"):
        assert "not a readable state dict" in refusal(tmp_path / f"{name}.pth")
    assert f"{tmp_path / 'none.pth'}: no such file" in refusal(tmp_path / "none.pth")


@pytest.mark.parametrize(
    ("key", "value", "text"),
    [
        ("features.28.bias", None, "features.28.bias is missing there"),
        ("features.0.weight", torch.zeros(64, 1, 3, 3), "features.0.weight is [64, 1, 3, 3] there"),
        # vgg16_bn and vgg19 have more entries than vgg16.
        ("features.34.weight", torch.zeros(1), "features.34.weight has no place here"),
    ],
)
def test_weights_of_another_layout_are_refused(key, value, text, tmp_path):
    changed = {name: tensor for name, tensor in (blank() | {key: value}).items() if tensor is not None}
    assert text in refusal(saved(changed, tmp_path / "changed.pth"))
