"""Toy objects and rooms as data modules that make their own data."""

from functools import partial
from pathlib import Path
from typing import Any

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.packed.manifest import is_packed
from completesplat.data.realestate10k.module import RE10KDataModule
from completesplat.data.toy.modes import ToyHiddenModes
from completesplat.data.toy.objects import SUBSET, write_objects
from completesplat.data.toy.rooms import ROOMS, write_rooms


class ToyObjectsDataModule(CO3DDataModule):
    """`CO3DDataModule` on toy objects, which are written to `root` on first use.

    Scenes that are already there are taken as they are, however many they are.

    `category` is a key of `DRAW`; `scenes`, `frames` and `data_seed` are of what to make; the others are settings of
    `CO3DDataModule`. `depth_before` is closer than there, as in `conf/data/toy_objects.yaml`: a model knows the depth
    range that it was trained with.
    """

    def __init__(
        self,
        root: str,
        scenes: int = 400,
        frames: int = 24,
        data_seed: int = 0,
        category: str = "toy_objects",
        subset: str | None = SUBSET,
        depth_before: float = 1.0,
        **reading: Any,
    ) -> None:
        super().__init__(root, category, subset, depth_before=depth_before, **reading)
        self.scenes = scenes
        self.frames = frames
        self.data_seed = data_seed

    def describe(self) -> dict[str, str | None]:
        return super().describe() | {"data_set": self.category}

    def prepare_data(self) -> None:
        """Write the scenes unless a complete set is there (its description is written last)."""
        if not is_packed(self.root) and not (self.root / self.category / "toy.json").is_file():
            numbers = self.scenes, self.frames, self.image_size, self.data_seed
            write_objects(self.root, *numbers, category=self.category)

    def hidden_modes(self, views: int, spread_views: int) -> ToyHiddenModes:
        """The test scenes with every colour that the patch on the back could have had; see `ToyHiddenModes`."""
        store = self.store("test")
        choose = partial(self.evaluation_views, split="test")
        return ToyHiddenModes(self.root / self.category, store, choose, self.image_size, views, spread_views)


class ToyRoomsDataModule(RE10KDataModule):
    """`RE10KDataModule` on toy rooms, which are written to `root` on first use.

    Clips that are already there are taken as they are, however many they are.

    `form` is "text" or "chunks", of RealEstate10K's two forms: both hold the same. `scenes`, `frames`, `height` and
    `data_seed` are of what to make; the others are settings of `RE10KDataModule`.
    """

    def __init__(
        self,
        root: str,
        form: str = "text",
        scenes: int = 100,
        frames: int = 60,
        height: int = 72,
        data_seed: int = 0,
        **reading: Any,
    ) -> None:
        home = Path(root)
        super().__init__(str(home if is_packed(home) else home / ROOMS / form), **reading)
        self.home = home
        self.making: dict[str, Any] = {"scenes": scenes, "frames": frames, "size": height, "seed": data_seed}

    def describe(self) -> dict[str, str]:
        return super().describe() | {"data_set": ROOMS}

    def prepare_data(self) -> None:
        """Write the rooms unless a complete set is there (its description is written last)."""
        if not is_packed(self.home) and not (self.home / ROOMS / "toy.json").is_file():
            write_rooms(self.home, **self.making)
