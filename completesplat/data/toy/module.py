"""Toy objects as a data module that makes its own data."""

from pathlib import Path
from typing import Any

from completesplat.data.co3d import CO3DDataModule
from completesplat.data.toy.objects import CATEGORY, write_objects


class ToyObjectsDataModule(CO3DDataModule):
    """`CO3DDataModule` on toy objects, which are written to `root` on first use.

    Scenes that are already there are taken as they are, however many they are.

    Args:
        root: where the scenes are, or will be.
        scenes, frames, data_seed: what to make where there is nothing yet.
        **reading: settings of `CO3DDataModule`.
    """

    def __init__(self, root: str, scenes: int = 400, frames: int = 24, data_seed: int = 0, **reading: Any) -> None:
        super().__init__(root, CATEGORY, **reading)
        self.scenes = scenes
        self.frames = frames
        self.data_seed = data_seed

    def prepare_data(self) -> None:
        """Write the scenes unless a complete set is there (its description is written last)."""
        if not (Path(self.root) / CATEGORY / "toy.json").is_file():
            write_objects(self.root, self.scenes, self.frames, self.image_size, self.data_seed)
