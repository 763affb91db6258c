"""Data module of rendered meshes."""

from typing import Any

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.rendered.rendering import CATEGORY


class RenderedDataModule(CO3DDataModule):
    """`CO3DDataModule` of objects that `completesplat data render` wrote below `root`, split by seed."""

    def __init__(self, root: str, **settings: Any) -> None:
        super().__init__(root, CATEGORY, subset=None, **settings)

    def describe(self) -> dict[str, str | None]:
        return super().describe() | {"data_set": CATEGORY}
