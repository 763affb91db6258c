"""Every checkpoint that cannot be started from is refused in one line that says what to do."""

import huggingface_hub
import pytest
import torch
from pretrained_vaes import BIN, SAFETENSORS, build, rewrite

from completesplat.errors import WeightsError


def refusal(source, **changes) -> str:
    with pytest.raises(WeightsError) as caught:
        build(str(source), **changes)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_hub_id_while_offline_says_how_to_fetch_it(monkeypatch, tmp_path):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    message = refusal("CompVis/stable-diffusion-v1-4")
    assert "`hf download CompVis/stable-diffusion-v1-4 --local-dir DIR`" in message
    assert "autoreconstructor.pretrained=DIR" in message


@pytest.mark.parametrize(
    ("changes", "difference", "setting"),
    [
        ({"channels": (16, 16, 16, 16)}, "weight is [8, 3, 3, 3] there and [16, 3, 3, 3] here", "channels=[8,8,16,16]"),
        ({"norm_groups": 8}, "4 groups, not 8", "norm_groups=4"),  # every shape fits
    ],
)
def test_another_size_names_the_difference_and_the_setting(folder, changes, difference, setting):
    message = refusal(folder, **changes)
    assert difference in message
    assert f"autoreconstructor.encoder.{setting}" in message


def test_another_activation_is_refused(folder):
    path = folder / "config.json"
    path.write_text(path.read_text().replace('"silu"', '"gelu"'))
    assert "its activation is gelu, not silu" in refusal(folder)


def test_tensors_missing_or_too_many_are_named(folder):
    rewrite(folder, lambda weights: weights.update({"decoder.extra": torch.zeros(1)}))
    assert "decoder.extra has no place here" in refusal(folder)
    rewrite(folder, lambda weights: weights.pop("decoder.mid_block.resnets.1.conv2.bias"))
    assert "decoder.mid_block.resnets.1.conv2.bias is missing there" in refusal(folder)


def test_a_truncated_file_is_damaged_and_a_bin_file_that_is_no_mapping_of_tensors_refused(vae, folder):
    path = folder / SAFETENSORS
    for kept in (-1, 0):
        path.write_bytes(path.read_bytes()[:kept])
        assert f"{folder}: damaged" in refusal(folder)
    path.unlink()
    torch.save({"state_dict": vae.state_dict()}, folder / BIN)
    assert "is missing there" in refusal(folder)


@pytest.mark.parametrize("name", ["config.json", SAFETENSORS])
def test_a_folder_without_its_files_says_which_are_needed(folder, name):
    (folder / name).unlink()
    message = refusal(folder)
    assert message.startswith(f"{folder}: no config.json and {SAFETENSORS}")
    assert "hf download" in message
    assert f"{folder / 'absent'}: no such folder" in refusal(folder / "absent")  # no id of the hub


@pytest.mark.parametrize("text", ["", "[1]"])
def test_a_damaged_config_is_refused(folder, text):
    (folder / "config.json").write_text(text)
    assert f"{folder}: damaged, or not a VAE" in refusal(folder)
