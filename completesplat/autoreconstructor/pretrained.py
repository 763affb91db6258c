"""Pretrained weights of Stable Diffusion's VAE, from a file, a folder in diffusers' layout or the Hugging Face hub."""

import json
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.errors import WeightsError
from completesplat.files import home_path
from completesplat.weights import CONFIG_FILE, first_line, from_hub
from completesplat.weights.checkpoint_reading import mismatch, not_finite

ENDINGS = (".safetensors", ".bin", ".fp16.safetensors", ".fp16.bin")
WEIGHTS_FILES = tuple(f"diffusion_pytorch_model{ending}" for ending in ENDINGS)
SUFFIXES = (".safetensors", ".bin", ".ckpt", ".pt", ".pth")
LDM = re.compile(r"(?:first_stage_model\.|vae\.)?encoder\.down\.(\d+)\.")  # names in Stable Diffusion's own files
SUBFOLDERS = ("", "vae/")  # of a VAE by itself, or within a whole pipeline
MODEL_ID = re.compile(r"[A-Za-z0-9][\w.-]*(/[\w.-]+)?")
ENCODER = ("encoder.", "quant_conv.")
HEAD = {"decoder.conv_out.weight", "decoder.conv_out.bias"}
# Names in older versions of diffusers (`_convert_deprecated_attention_blocks` in its modeling_utils.py).
OLD_ATTENTION = {"query": "to_q", "key": "to_k", "value": "to_v", "proj_attn": "to_out.0"}
# Keys of config.json, and our options with the same meaning.
SETTINGS = {
    "block_out_channels": "channels",
    "layers_per_block": "layers_per_block",
    "latent_channels": "latent_channels",
    "norm_num_groups": "norm_groups",
}


def load_pretrained(source: str, encoder: Encoder, reconstructor: Reconstructor | None = None) -> None:
    """Load a VAE, except for the last convolution, whose outputs are a Splatter Image here.

    The reconstructor's skips have no counterpart in the checkpoint and keep their values.

    Args:
        source: a folder with `config.json` and `diffusion_pytorch_model.safetensors` (or `.bin`, `.fp16.safetensors`),
            a folder with these in a subfolder `vae`, a hub id of either, or a file of the VAE or of a whole model, with
            diffusers' names or Stable Diffusion's own (`first_stage_model`).
        reconstructor: None loads the encoder of a conditioning. The checkpoint may then lack a decoder.

    Raises:
        WeightsError: the checkpoint is missing, damaged or not finite, or its VAE has another kind or size.
    """
    part = "conditioning" if reconstructor is None else "autoreconstructor"
    file = _vae_file(source, part)
    place = file.parent if file.name in WEIGHTS_FILES else file
    config_file = file.with_name(CONFIG_FILE)
    try:
        config = dict(json.loads(config_file.read_text())) if config_file.is_file() else {}
        weights = _read_weights(file)
    except Exception as error:  # torch and safetensors raise many kinds for a damaged file
        cause = first_line(error).partition(". ")[0]  # torch adds advice to trust the file
        raise WeightsError(f"{place}: damaged, or not a VAE ({cause}); fetch it again") from error
    # Under these names the state dict's keys are those of diffusers' AutoencoderKL.
    vae = nn.ModuleDict({"encoder": encoder.network, "quant_conv": encoder.quant_conv})
    if reconstructor is None:
        weights = {name: value for name, value in weights.items() if name.startswith(ENCODER)}
    else:
        vae["post_quant_conv"] = reconstructor.post_quant_conv
        vae["decoder"] = reconstructor.network
    loaded = _without_head(weights)
    reason = mismatch(_without_head(vae.state_dict()), loaded) or _other_kind(config, encoder)
    if reason is not None:
        raise WeightsError(f"{place}: {reason}; {_needed_settings(config, part)}")
    unfit = not_finite(loaded)
    if unfit is not None:
        raise WeightsError(f"{place}: {unfit} is not finite; fetch it again")
    vae.load_state_dict(loaded, strict=False)


def _without_head(weights: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: value for name, value in weights.items() if name not in HEAD}


def _other_kind(config: Mapping[str, object], encoder: Encoder) -> str | None:
    """Return a difference between a VAE and ours that no tensor's shape shows, if there is one."""
    groups = config.get("norm_num_groups", 32)
    activation = config.get("act_fn", "silu")
    assert isinstance(encoder.network.conv_norm_out, nn.GroupNorm)
    if groups != encoder.network.conv_norm_out.num_groups:
        return f"its group normalisation has {groups} groups, not {encoder.network.conv_norm_out.num_groups}"
    return None if activation == "silu" else f"its activation is {activation}, not silu"


def _needed_settings(config: Mapping[str, object], part: str) -> str:
    """Name the options of the autoreconstructor's encoder, or of a conditioning, that fit a VAE's config."""
    names = dict(SETTINGS)
    network = f"{part}.encoder"
    if part == "conditioning":
        names["latent_channels"] = "out_channels"
        network = part
    overrides: list[str] = []
    for key, name in names.items():
        if key in config:
            value = json.dumps(config[key], separators=(",", ":"))
            overrides.append(f"{network}.{name}={value}")
    return f"its config.json asks for {' '.join(overrides)}" if overrides else "no config.json gives its sizes"


def _vae_file(source: str, part: str) -> Path:
    """Return the file of the VAE's tensors, downloaded from the hub if `source` is not a file or folder."""
    local = home_path(source)
    is_id = MODEL_ID.fullmatch(source) is not None
    hub_id = source if is_id and not local.exists() else "CompVis/stable-diffusion-v1-4"
    advice = (
        f"run `hf download {hub_id} --local-dir DIR` with network access (add `--include 'vae/*'` for the VAE of a "
        f"whole pipeline); then give {part}.pretrained=DIR"
    )
    if local.is_file() and local.suffix in SUFFIXES:
        return local
    if local.is_file():
        raise WeightsError(f"{source}: not one of the files that are read: {', '.join(SUFFIXES)}")
    if not local.exists() and not is_id:
        raise WeightsError(f"{source}: no such folder; {advice}")
    for file in WEIGHTS_FILES:
        names = [f"{subfolder}{name}" for subfolder in SUBFOLDERS for name in (CONFIG_FILE, file)]
        folder = local if local.exists() else from_hub(source, names, advice)
        for subfolder in SUBFOLDERS:
            path = folder / subfolder / file
            if path.is_file() and path.with_name(CONFIG_FILE).is_file():
                return path
    reason = f"no {CONFIG_FILE} and {WEIGHTS_FILES[0]} (or .bin) there, nor in a subfolder vae"
    other_files = sorted(str(path) for path in local.glob("*") if path.suffix in SUFFIXES)
    if other_files:
        advice = f"if one of its files is the VAE, give {part}.pretrained={other_files[0]}"
    raise WeightsError(f"{source}: {reason}; {advice}")


def _read_weights(file: Path) -> dict[str, Tensor]:
    """Return tensors by the names of diffusers' AutoencoderKL."""
    contents: dict[str, Any]
    if file.suffix == ".safetensors":
        contents = load_file(file)
    else:
        contents = torch.load(file, map_location="cpu", weights_only=True)
    weights: Any = contents.get("state_dict", contents)
    levels = {match[1] for match in map(LDM.match, weights) if match}
    if levels:
        from diffusers.loaders.single_file_utils import convert_ldm_vae_checkpoint

        convert: Callable[..., dict[str, Tensor]] = convert_ldm_vae_checkpoint
        weights = convert(weights, {"down_block_types": levels, "up_block_types": levels})
    return {_current_name(name): value for name, value in weights.items() if isinstance(value, Tensor)}


def _current_name(name: str) -> str:
    block, _, parameter = name.partition(".attentions.0.")
    layer, _, kind = parameter.partition(".")
    if layer not in OLD_ATTENTION:
        return name
    return f"{block}.attentions.0.{OLD_ATTENTION[layer]}.{kind}"
