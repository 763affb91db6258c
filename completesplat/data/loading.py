"""How scenes are loaded, whatever data set they come from."""

import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from completesplat.scene import SceneBatch
from completesplat.tensors import stack


def scene_loader(
    scenes: Dataset[SceneBatch], batch_size: int, sampler: Sampler | None, workers: int
) -> DataLoader[SceneBatch]:
    """Batches of scenes, loaded by so many processes (0: none)."""
    return DataLoader(
        scenes,
        batch_size,
        sampler=sampler,
        num_workers=workers,
        # Workers hold what is cached, so they live on from one epoch to the next.
        persistent_workers=workers > 0,
        collate_fn=stack,
        pin_memory=torch.cuda.is_available(),
    )
