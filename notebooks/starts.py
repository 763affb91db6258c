"""Checkpoints that a training can start from, made of other weights (experiments.md, "Anything").

python notebooks/starts.py WEIGHTS START1 [wider]   # stage 1's: model.checkpoint=START1
python notebooks/starts.py WEIGHTS START2 RUN1      # stage 2's: RUN1's autoreconstructor, the other networks of WEIGHTS

WEIGHTS is a folder. With `wider`, the autoreconstructor has twice the channels and computes the same function (Net2Net,
Chen, Goodfellow and Shlens, ICLR 2016): every channel is there twice, and what reads it is divided unevenly between
both, so that they learn different things.
"""

import sys

import torch
from safetensors.torch import load_file

UNEVEN = 0.25  # standard deviation of a copy's share of a weight, whose mean is one half
PART = "autoreconstructor."


def twice(name, weight):
    """Return a tensor for twice the channels on all axes that are neither images, latents nor Splatter Images."""
    if "quant_conv" in name:
        return weight
    if ".to_q." in name or ".to_k." in name:
        weight = weight * 2**-0.25  # attention divides by the root of the number of channels
    if ".conv_out." not in name:
        weight = weight.repeat_interleave(2, 0)
    if weight.ndim > 1 and ".conv_in." not in name:
        share = 0.5 + UNEVEN * torch.randn(weight.shape)
        weight = torch.stack([weight * share, weight * (1 - share)], 2).flatten(1, 2)
    return weight


def main(weights, out, *words):
    """Write a checkpoint as the words of the command say."""
    torch.manual_seed(0)
    given = {name: value.float() for name, value in load_file(f"{weights}/model.safetensors").items()}
    first = {name.removeprefix(PART): value for name, value in given.items() if name.startswith(PART)}
    if words in ((), ("wider",)):
        state = {f"model.{name}": twice(name, x) if words else x for name, x in first.items()}
    else:
        trained = torch.load(f"{words[0]}/checkpoints/last.ckpt", map_location="cpu", weights_only=True)["state_dict"]
        rest = {name: value for name, value in given.items() if not name.startswith(PART)}
        # stage 2 measures the latents again
        rest |= {
            "latent_std": torch.ones_like(rest["latent_std"]),
            "latent_mean": torch.zeros_like(rest["latent_mean"]),
        }
        state = {f"completesplat.{name}": value for name, value in rest.items()}
        state |= {f"completesplat.{PART}{name.removeprefix('model.')}": value for name, value in trained.items()}
    torch.save({"state_dict": state}, out)


if __name__ == "__main__":
    main(*sys.argv[1:])
