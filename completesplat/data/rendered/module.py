"""Data module of rendered meshes."""

from functools import partial
from typing import Any

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.rendered.modes import RenderedHiddenModes
from completesplat.data.rendered.rendering import CATEGORY


class RenderedDataModule(CO3DDataModule):
    """`CO3DDataModule` of objects that `completesplat data render` wrote below `root`, split by seed."""

    def __init__(self, root: str, **settings: Any) -> None:
        super().__init__(root, CATEGORY, subset=None, **settings)

    def describe(self) -> dict[str, str | None]:
        return super().describe() | {"data_set": CATEGORY}

    def hidden_modes(self, views: int, spread_views: int) -> RenderedHiddenModes:
        """Return the test scenes with all paints of the back; see `RenderedHiddenModes`."""
        choose = partial(self.evaluation_views, split="test")
        return RenderedHiddenModes(self.root / CATEGORY, self.store("test"), choose, views, spread_views)
