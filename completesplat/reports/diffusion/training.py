"""What an optimizer step of stage 2 costs, its batch included: from the latent cache, or encoded on the fly."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import torch
from torch.optim import Optimizer

from completesplat.data.module import SceneDataModule
from completesplat.reports.diffusion.comparing import Comparison
from completesplat.training.encoding import encode_training_set
from completesplat.training.scene_module import SceneModule

MAXIMAL_NORM = 1.0  # of gradients, as in conf/trainer


class Training:
    """Optimizer steps of either stage as in a run, without what a run logs.

    Args:
        module: on its device.
        precision: Lightning's; "bf16-mixed" computes the networks in bfloat16.
    """

    def __init__(self, module: SceneModule, precision: str) -> None:
        self.module: Any = module.train()
        self.precision = precision
        for logs in ("log_loss", "log_dict"):  # there is no trainer that would
            setattr(module, logs, lambda *_, **__: None)
        self.optimizer: Optimizer = module.optimizer([p for p in module.parameters() if p.requires_grad])

    def step(self, batch: Any) -> None:
        """One optimizer step on a batch of scenes, encoded or not."""
        module = self.module
        with autocast(module.device, self.precision):
            loss = module.training_step(batch.to(module.device), 0)
        self.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(module.parameters(), MAXIMAL_NORM)
        self.optimizer.step()


def autocast(device: torch.device, precision: str) -> torch.autocast:
    """The context in which Lightning computes with this precision."""
    return torch.autocast(device.type, torch.bfloat16, enabled=precision.startswith("bf16"))


def cached_vs_on_the_fly(training: Training, data: Callable[..., SceneDataModule], folder: Path) -> Comparison:
    """Steps on batches that are loaded within the time.

    Args:
        data: settings (`encoded`) -> the data module, whose scenes are there.
        folder: where the training set is encoded.
    """
    parts = training.module.completesplat
    pictures = data()
    store = encode_training_set(
        parts.autoreconstructor,
        pictures,
        folder,
        conditioning=parts.conditioning if parts.conditioning.frozen else None,
        device=training.module.device,
        progress=False,
    )
    parts.latent_scale.fill_(store.scale)
    parts.train()
    fill_cache(pictures)
    cached, fly = batches(data(encoded=str(folder))), batches(pictures)
    return Comparison(
        "cached_vs_on_the_fly",
        ("step from the latent cache", lambda: training.step(next(cached))),
        ("encoding on the fly", lambda: training.step(next(fly))),
    )


def fill_cache(data: SceneDataModule) -> None:
    """Read all training pictures, as a run has after its first epochs: what `data.cache` keeps is there then."""
    store = data.store("train")
    for name in store.names:
        sequence = store.source.read(name)
        for view in range(len(sequence.frames)):
            store.image(sequence, view)


def batches(data: SceneDataModule) -> Iterator[Any]:
    """The training batches of one epoch after the other."""
    loader = data.train_dataloader()
    epoch = 0
    while True:
        loader.sampler.set_epoch(epoch)  # type: ignore[union-attr]
        yield from loader
        epoch += 1
