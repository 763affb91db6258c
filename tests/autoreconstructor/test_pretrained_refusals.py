"""Every checkpoint that cannot be started from is refused in one line that says what to do."""

import huggingface_hub
import pytest
import torch
from pretrained_vaes import SAFETENSORS, build

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
    assert f"{folder / 'absent'}: no such folder" in refusal(folder / "absent")  # no id of the hub
