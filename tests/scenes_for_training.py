"""Scenes without files and a trainer without output, for tests of what surrounds training."""

from dataclasses import replace
from pathlib import Path

import torch
from lightning import Trainer
from support import SMALL, some_gaussians
from torch import Tensor

import completesplat
from completesplat.autoreconstructor.posterior import Posterior
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.losses import Prediction
from completesplat.scene import SceneBatch, Views

SIZE = 16
SILENT = dict.fromkeys(("logger", "enable_checkpointing", "enable_progress_bar", "enable_model_summary"), False)


def scene_batch(batch: int = 2, targets: int = 2, seed: int = 0, size: int = SIZE) -> SceneBatch:
    """Random images, all from one camera at the origin."""
    count = 1 + targets
    cameras = Cameras(
        torch.eye(4).repeat(batch, count, 1, 1), pinhole(60, size).repeat(batch, count, 1, 1), (size, size)
    )
    generator = torch.Generator().manual_seed(seed)
    images = torch.rand(batch, count, 3, size, size, generator=generator)
    views = Views(images, cameras, torch.ones(batch, count, 1, size, size))
    return SceneBatch(
        views[:, 0], views[:, 1:], torch.tensor([[0.5, 4.0]]).repeat(batch, 1), torch.ones(batch, 1, size, size),
        torch.zeros(batch, dtype=torch.int64), tuple(f"scene {seed} {i}" for i in range(batch)),
    )  # fmt: skip


def views(images: Tensor) -> Views:
    """The images of scenes as views, [scene view 3 size size]."""
    batch, count, _, size, _ = images.shape
    return replace(scene_batch(batch, count - 1, size=size).all_views(), images=images)


def prediction(images: Tensor, posterior: Posterior | None = None, **gaussians: float) -> Prediction:
    return Prediction(images, some_gaussians(len(images), **gaussians), posterior)


def opened(root: Path, *settings: str):
    """Data and model of `experiment=toy_var` in a small size."""
    small = [setting for setting in SMALL if not setting.startswith(("trainer", "callbacks"))]
    config = completesplat.compose("fit", "experiment=toy_var", f"data.root={root}", *small, *settings)
    return completesplat.instantiate(config)


def quiet_trainer(**settings: object) -> Trainer:
    """Lightning's trainer on the CPU, which prints and writes nothing but what is asked for."""
    return Trainer(**{"accelerator": "cpu", **SILENT, **settings})
