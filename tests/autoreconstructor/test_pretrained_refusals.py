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
    torch.save({"weights": vae.state_dict()}, folder / BIN)
    assert "is missing there" in refusal(folder)


def test_weights_that_are_not_finite_or_not_floats_are_refused(folder):
    rewrite(folder, lambda weights: weights["encoder.conv_in.bias"].fill_(torch.nan))
    assert f"{folder}: encoder.conv_in.bias is not finite; fetch it again" in refusal(folder)
    for kind in (torch.int64, torch.complex64, torch.bool):
        rewrite(folder, lambda weights: weights.update({"encoder.conv_in.bias": torch.ones(8).to(kind)}))  # noqa: B023
        assert f"encoder.conv_in.bias is [8] of {kind} there and [8] here" in refusal(folder)


def test_files_that_are_no_vae_are_named_without_advice_to_download_another(folder, tmp_path):
    other = tmp_path / "vae.gguf"
    other.write_bytes(b"GGUF")
    assert refusal(other).startswith(f"{other}: not one of the files that are read: .safetensors, .bin, .ckpt")
    (folder / SAFETENSORS).rename(folder / "kl-f8.safetensors")
    message = refusal(folder)
    assert message.endswith(
        f"if one of its files is the VAE, give autoreconstructor.pretrained={folder}/kl-f8.safetensors"
    )
    torch.save({"state_dict": {"unet.weight": torch.ones(1)}}, other.with_suffix(".ckpt"))
    assert f"{other.with_suffix('.ckpt')}: encoder.conv_in.weight is missing there" in refusal(
        other.with_suffix(".ckpt")
    )
    other.with_suffix(".pt").write_bytes(b"\x80\x02c__builtin__\neval\n.")
    message = refusal(other.with_suffix(".pt"))
    assert message.startswith(f"{other.with_suffix('.pt')}: damaged, or not a VAE (")
    assert not any("hf download" in text or "trust" in text for text in (message, refusal(folder), refusal(other)))


@pytest.mark.parametrize("name", ["config.json", SAFETENSORS])
def test_a_folder_without_its_files_says_which_are_needed(folder, name):
    (folder / name).unlink()
    message = refusal(folder)
    assert message.startswith(f"{folder}: no config.json and {SAFETENSORS}")
    advice = f"give autoreconstructor.pretrained={folder / SAFETENSORS}" if name == "config.json" else "hf download"
    assert advice in message
    assert f"{folder / 'absent'}: no such folder" in refusal(folder / "absent")  # no id of the hub


@pytest.mark.parametrize("text", ["", "[1]"])
def test_a_damaged_config_is_refused(folder, text):
    (folder / "config.json").write_text(text)
    assert f"{folder}: damaged, or not a VAE" in refusal(folder)
