"""Latent caches of tiny rooms, for tests: a small untrained autoreconstructor and packed clips."""

from pathlib import Path

import torch
from hydra.utils import instantiate
from packed_sequences import prepared
from realestate10k_trees import make_clip, module, write_tree
from support import compose_config

from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.data.realestate10k.module import RE10KDataModule
from completesplat.data.tolerance import ErrorTolerance

FRAMES = 5


def small_autoreconstructor(seed: int = 0, latent_channels: int = 4) -> VariationalAutoReconstructor:
    """16 x 16 pixels become 2 x 2 latents."""
    sizes = {"channels": "[8,8,16,16]", "latent_channels": latent_channels}
    config = compose_config("fit", *(f"autoreconstructor.encoder.{name}={size}" for name, size in sizes.items()))
    torch.manual_seed(seed)
    return instantiate(config.autoreconstructor, _convert_="all").eval()


def sound_rooms(root: Path, clips: int = 5, **settings: object) -> Path:
    """Packed clips that could be read completely; beside them, in "raw", the files that they were made from."""
    made = [make_clip(f"c{i}", FRAMES) for i in range(clips)]
    return pack(write_tree(root / "raw", "text", made, made[:1]), **settings)


def broken_rooms(root: Path) -> Path:
    """Nine packed clips without what could not be used: one image of c5, nearly all of c6 and the cameras of c7."""
    clips = [make_clip(f"c{i}", FRAMES) for i in range(9)]
    clips[5].images[1] = b"<html>"
    clips[6].images[1:] = [b"<html>"] * (FRAMES - 1)
    clips[7].rows[:, 6:] *= 2
    return pack(write_tree(root / "raw", "text", clips, clips[:1]))


def pack(raw: Path, **settings: object) -> Path:
    """The packed store of these clips, beside them."""
    return prepared(rooms(raw, **settings), raw.with_name("packed"), tolerance=ErrorTolerance("skip", 1.0))


def rooms(root: Path, **settings: object) -> RE10KDataModule:
    """All clips but one for training, at 16 pixels; as many items as want may be replaced."""
    return module(root, **{"val_fraction": 0.0, "max_bad_fraction": 10.0, "batch_size": 3, **settings})
