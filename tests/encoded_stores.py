"""Encoded stores of tiny rooms, for tests: a small untrained autoreconstructor and clips that are partly broken."""

from pathlib import Path

import torch
from hydra.utils import instantiate
from realestate10k_trees import make_clip, module, write_tree
from support import compose_config

from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.data.realestate10k.module import RE10KDataModule

FRAMES = 5


def small_autoreconstructor(seed: int = 0, latent_channels: int = 4) -> VariationalAutoReconstructor:
    """16 x 16 pixels become 2 x 2 latents."""
    sizes = [
        "autoreconstructor.encoder.channels=[8,8,16,16]",
        f"autoreconstructor.encoder.latent_channels={latent_channels}",
    ]
    config = compose_config("fit", *sizes)
    torch.manual_seed(seed)
    return instantiate(config.autoreconstructor, _convert_="all").eval()


def sound_rooms(root: Path, clips: int = 5, form: str = "text") -> Path:
    """Clips that can be read completely."""
    made = [make_clip(f"c{i}", FRAMES) for i in range(clips)]
    return write_tree(root, form, made, made[:1])


def broken_rooms(root: Path, form: str = "text") -> Path:
    """Nine clips: one picture of c5, all but one of c6 and the cameras of c7 cannot be used."""
    clips = [make_clip(f"c{i}", FRAMES) for i in range(9)]
    clips[5].pictures[1] = b"<html>"
    clips[6].pictures[1:] = [b"<html>"] * (FRAMES - 1)
    clips[7].rows[:, 6:] *= 2
    return write_tree(root, form, clips, clips[:1])


def rooms(root: Path, **settings: object) -> RE10KDataModule:
    """All clips but one for training, at 16 pixels; as many items as want may be replaced."""
    return module(root, **{"val_fraction": 0.0, "most_bad": 10.0, "batch_size": 3, **settings})
