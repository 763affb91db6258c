"""How checkpoints get onto the disk."""

import os
from pathlib import Path
from typing import Any

import torch
from lightning.pytorch.plugins.io import TorchCheckpointIO


class CheckpointFiles(TorchCheckpointIO):
    """Writes straight into a file beside the final place and renames it: there is a whole checkpoint or none.

    Lightning's own first makes the whole file in memory, which for a model of 860 million parameters with its optimizer
    and its average takes 15 GB more. The unfinished file always has the same name, so that a run which is killed while
    it saves, again and again, leaves one of them and not many.
    """

    def save_checkpoint(self, checkpoint: dict[str, Any], path: str | os.PathLike, storage_options: Any = None) -> None:
        """Replace what is at this path."""
        final = Path(path)
        final.parent.mkdir(parents=True, exist_ok=True)
        unfinished = final.with_name(f".{final.name}.unfinished")
        try:
            torch.save(checkpoint, unfinished)
            with unfinished.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(unfinished, final)
        finally:
            unfinished.unlink(missing_ok=True)
