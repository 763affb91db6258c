import copy
import re
import shutil

import huggingface_hub
import pytest
import torch
from hydra.utils import instantiate
from pretrained_vaes import BIN, SAFETENSORS, build, rewrite, stable_diffusion_vae
from safetensors.torch import load_file, save_file
from support import compose_config

from completesplat.errors import WeightsError

HEAD = {"decoder.conv_out.weight", "decoder.conv_out.bias"}


def shared_weights(model) -> dict[str, torch.Tensor]:
    """The model's tensors that a VAE has too, under the VAE's names."""
    parts = {
        "encoder": model.encoder.network,
        "quant_conv": model.encoder.quant_conv,
        "post_quant_conv": model.reconstructor.post_quant_conv,
        "decoder": model.reconstructor.network,
    }
    names = {f"{part}.{name}": value for part, module in parts.items() for name, value in module.state_dict().items()}
    return {name: value for name, value in names.items() if name not in HEAD}


def assert_loaded(model, vae):
    expected = {name: value for name, value in vae.state_dict().items() if name not in HEAD}
    loaded = shared_weights(model)
    assert loaded.keys() == expected.keys()
    assert all(torch.equal(loaded[name], expected[name]) for name in expected)


def before_the_last_convolution(network, run):
    seen = []
    hook = network.conv_out.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    run()
    hook.remove()
    return seen[0]


@torch.no_grad()
def test_latents_and_decoder_features_are_the_vaes_and_all_but_head_and_skips_bit_for_bit(vae, folder):
    model = build(str(folder))
    random = build()
    assert_loaded(model, vae)
    images = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(2))
    posterior, features = model.encoder(images)
    expected = vae.encode(images * 2 - 1).latent_dist
    torch.testing.assert_close(posterior.mean, expected.mean)
    torch.testing.assert_close(posterior.log_variance, expected.logvar)
    latent = expected.mean
    reconstructor = model.reconstructor
    ours = before_the_last_convolution(reconstructor.network, lambda: reconstructor(latent, features))
    theirs = before_the_last_convolution(vae.decoder, lambda: vae.decode(latent))
    torch.testing.assert_close(ours, theirs)
    head = reconstructor.network.conv_out
    untouched = random.reconstructor.network.conv_out
    assert torch.equal(head.weight, untouched.weight)
    assert torch.equal(head.bias, untouched.bias)
    assert not any(parameter.any() for parameter in reconstructor.skips.parameters())


def test_a_pipelines_vae_and_a_bin_file_are_loaded(vae, folder):
    (folder / "model_index.json").write_text("{}")
    vae.save_pretrained(folder / "vae")
    (folder / "config.json").rename(folder / "elsewhere.json")
    assert_loaded(build(str(folder)), vae)
    torch.save(vae.state_dict(), folder / "vae" / BIN)
    (folder / "vae" / SAFETENSORS).unlink()
    assert_loaded(build(str(folder)), vae)


def test_older_names_of_the_attention_are_known(vae, folder):
    def age(weights):
        for new, old in {"to_q": "query", "to_k": "key", "to_v": "value", "to_out.0": "proj_attn"}.items():
            for name in [name for name in weights if f".{new}." in name]:
                weights[name.replace(f".{new}.", f".{old}.")] = weights.pop(name)

    rewrite(folder, age)
    assert any("proj_attn" in name for name in load_file(folder / SAFETENSORS))
    assert_loaded(build(str(folder)), vae)


def by_ldms_names(vae) -> dict[str, torch.Tensor]:
    """A VAE's tensors by Stable Diffusion's own names; the attention's layers are 1 x 1 convolutions there."""
    renamed = {}
    blocks = len(vae.config.up_block_types)
    for name, value in vae.state_dict().items():
        new = re.sub(r"down_blocks\.(\d)\.resnets", r"down.\1.block", name)
        new = re.sub(r"down_blocks\.(\d)\.downsamplers\.0", r"down.\1.downsample", new)
        new = re.sub(r"up_blocks\.(\d)\.resnets", lambda m: f"up.{blocks - 1 - int(m[1])}.block", new)
        new = re.sub(r"up_blocks\.(\d)\.upsamplers\.0", lambda m: f"up.{blocks - 1 - int(m[1])}.upsample", new)
        new = re.sub(r"mid_block\.resnets\.(\d)", lambda m: f"mid.block_{int(m[1]) + 1}", new)
        new = new.replace("mid_block.attentions.0", "mid.attn_1").replace("conv_norm_out", "norm_out")
        new = new.replace("conv_shortcut", "nin_shortcut")
        if "attn_1" in new:
            new = new.replace("group_norm", "norm").replace("to_out.0", "proj_out")
            new = re.sub(r"to_([qkv])\b", r"\1", new)
            value = value[:, :, None, None] if value.ndim == 2 else value
        renamed[new] = value.contiguous()
    return renamed


@pytest.mark.parametrize("prefix", ["first_stage_model.", ""])
@pytest.mark.parametrize("ending", [".safetensors", ".ckpt"])
def test_one_file_with_diffusers_or_with_stable_diffusions_names_is_loaded(vae, folder, prefix, ending):
    path = folder / f"model{ending}"
    others = {"model.diffusion_model.input.weight": torch.ones(2), "loss.logvar": torch.ones(())}
    for weights in (vae.state_dict(), {f"{prefix}{name}": x for name, x in by_ldms_names(vae).items()} | others):
        save_file(weights, path) if ending == ".safetensors" else torch.save({"state_dict": weights}, path)
        assert_loaded(build(str(path)), vae)
    (folder / "config.json").unlink()
    with pytest.raises(WeightsError, match="group normalisation has 32 groups, not 4"):  # as Stable Diffusion's has
        build(str(path))


def test_half_precision_under_its_own_name_is_loaded(vae, folder):
    halves = {name: value.half() for name, value in load_file(folder / SAFETENSORS).items()}
    save_file(halves, folder / "diffusion_pytorch_model.fp16.safetensors")
    (folder / SAFETENSORS).unlink()
    assert_loaded(build(str(folder)), copy.deepcopy(vae).half().float())


def test_of_a_hub_pipeline_only_the_vae_is_fetched(vae, tmp_path, monkeypatch):
    hub = tmp_path / "hub"
    cache = tmp_path / "cache"
    for part in ("vae", "unet"):
        vae.save_pretrained(hub / part, safe_serialization=False)

    def snapshot_download(hub_id, allow_patterns, revision):
        assert (hub_id, revision) == ("some/pipeline", None)
        for name in allow_patterns:
            if (hub / name).is_file():
                (cache / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(hub / name, cache / name)
        return str(cache)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot_download)
    assert_loaded(build("some/pipeline"), vae)
    assert sorted(path.name for path in cache.rglob("*") if path.is_file()) == ["config.json", BIN]


def parameters(*modules) -> int:
    return sum(parameter.numel() for module in modules for parameter in module.parameters())


def test_stable_diffusions_size_is_the_published_one():
    config = compose_config("fit", "autoreconstructor=stable_diffusion", "autoreconstructor.pretrained=null")
    with torch.device("meta"):
        model = instantiate(config.autoreconstructor, _convert_="all")
        theirs = stable_diffusion_vae((128, 256, 512, 512), layers_per_block=2, norm_groups=32)
    shapes = {name: value.shape for name, value in theirs.state_dict().items() if name not in HEAD}
    assert {name: value.shape for name, value in shared_weights(model).items()} == shapes
    assert round(parameters(model.encoder.network) / 1e6, 2) == 34.16
    assert parameters(model.encoder.quant_conv) == 8 * 8 + 8
    # The decoder's 49.49 M, its 128-channel 3x3 head widened from 3 to 30 channels.
    decoder = parameters(theirs.decoder, theirs.post_quant_conv)
    assert round(decoder / 1e6, 2) == 49.49
    assert parameters(model.reconstructor) == decoder + 27 * (128 * 9 + 1) + parameters(model.reconstructor.skips)
    assert parameters(model.reconstructor.skips) == 128 * 256 + 256


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
    contents = {"vae.gguf": b"GGUF", "vae.pt": b"\x80\x02c__builtin__\neval\n."}
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
    torch.save({"state_dict": {"unet.weight": torch.ones(1)}}, tmp_path / "vae.ckpt")
    (folder / SAFETENSORS).rename(folder / "kl-f8.safetensors")
    for name, reason in {
        "vae.gguf": "not one of the files that are read: .safetensors, .bin, .ckpt",
        "vae.pt": "damaged, or not a VAE (",
        "vae.ckpt": "encoder.conv_in.weight is missing there",
        "vae_only": f"give autoreconstructor.pretrained={folder}/kl-f8.safetensors",
    }.items():
        message = refusal(tmp_path / name)
        assert message.startswith(str(tmp_path / name))
        assert reason in message
        assert "hf download" not in message
        assert "trust" not in message
    assert refusal(tmp_path / "absent").startswith(f"{tmp_path / 'absent'}: no such folder")  # no id of the hub
