"""Data modules of toy objects and rooms, which write their own data."""

from pathlib import Path
from typing import Any

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.packed.manifest import is_packed
from completesplat.data.realestate10k.module import RE10KDataModule
from completesplat.data.toy.data_sets import DESCRIPTION, ROOMS, SUBSET, DataSetSize, write
from completesplat.data.toy.object_scene import PATCH_COLORS
from completesplat.errors import MissingFile
from completesplat.quantities import Natural, Positive, Side

OWN_PLACE = Path("outputs/data")
"""Folder below which toy data are written without `make`. `data.root` of `conf/data/toy_*.yaml` lies there."""


def _provide(kind: str, root: Path, make: bool, numbers: DataSetSize) -> None:
    """Write data of a kind unless there are complete data (with `toy.json`) or prepared ones.

    Without `make`, refuse folders outside of `OWN_PLACE`, because their name may be a typing error.
    """
    if is_packed(root) or (root / f"toy_{kind}" / DESCRIPTION).is_file():
        return
    if not make and not root.is_relative_to(OWN_PLACE):
        message = "no toy data: data.make=true makes them there, and so does completesplat data toy"
        raise MissingFile(message, str(root))
    write(kind, root, **numbers)


class ToyObjectsDataModule(CO3DDataModule):
    """`CO3DDataModule` of toy objects, which are written to `root` on first use: below `OWN_PLACE`, or with `make`.

    Existing scenes are used as they are, whatever their number is. The default of `depth_before` is smaller than that
    of `CO3DDataModule` and equals that in `conf/data/toy_objects.yaml`, because a model knows the depth range that it
    was trained with.

    Args:
        scenes, frames, data_seed: data to write.
        category: a key of `DRAW`.
        make: write data outside of `OWN_PLACE`, too.
        **reading: settings of `CO3DDataModule`.
    """

    record = DESCRIPTION
    chances = dict.fromkeys(PATCH_COLORS, 1 / len(PATCH_COLORS))

    def __init__(
        self,
        root: str,
        scenes: Positive = 400,
        frames: Positive = 24,
        data_seed: Natural = 0,
        category: str = "toy_objects",
        subset: str | None = SUBSET,
        depth_before: float = 1.0,
        make: bool = False,
        **reading: Any,
    ) -> None:
        super().__init__(root, category, subset, depth_before=depth_before, **reading)
        self.make = make
        self.making = DataSetSize(scenes=scenes, frames=frames, size=self.image_size, seed=data_seed)

    def describe(self) -> dict[str, str | None]:
        return super().describe() | {"data_set": self.category}

    def prepare_data(self) -> None:
        """Write the scenes if there are none."""
        _provide(self.category.removeprefix("toy_"), self.root, self.make, self.making)


class ToyRoomsDataModule(RE10KDataModule):
    """`RE10KDataModule` of toy rooms, which are written to `root` on first use: below `OWN_PLACE`, or with `make`.

    Existing clips are used as they are, whatever their number is.

    Args:
        scenes, frames, height, data_seed: data to write.
        make: write data outside of `OWN_PLACE`, too.
        **reading: settings of `RE10KDataModule`.
    """

    def __init__(
        self,
        root: str,
        scenes: Positive = 100,
        frames: Positive = 60,
        height: Side = 72,
        data_seed: Natural = 0,
        make: bool = False,
        **reading: Any,
    ) -> None:
        home = Path(root)
        super().__init__(str(home if is_packed(home) else home / ROOMS / "text"), **reading)
        self.home = home
        self.make = make
        self.making = DataSetSize(scenes=scenes, frames=frames, size=height, seed=data_seed)

    def describe(self) -> dict[str, str]:
        return super().describe() | {"data_set": ROOMS}

    def prepare_data(self) -> None:
        """Write the clips if there are none."""
        _provide("rooms", self.home, self.make, self.making)
