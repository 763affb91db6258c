"""Data module of rendered meshes."""

from typing import Any

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.hidden_modes import HiddenModeScenes
from completesplat.data.rendered.drawing import PAINTS
from completesplat.data.rendered.rendering import CATEGORY, DESCRIPTION, OBJECT
from completesplat.data.validation import field, read_json
from completesplat.errors import CompleteSplatError, DataError, errors_at


class RenderedDataModule(CO3DDataModule):
    """`CO3DDataModule` of objects that `completesplat data render` wrote below `root`, split by seed."""

    def __init__(self, root: str, **settings: Any) -> None:
        super().__init__(root, CATEGORY, subset=None, **settings)

    def describe(self) -> dict[str, str | None]:
        return super().describe() | {"data_set": CATEGORY}

    def hidden_modes(self, views: int, spread_views: int) -> HiddenModeScenes:
        """Return the test scenes with all paints of the back.

        Raises:
            CompleteSplatError: the objects were rendered without hidden=modes, or are prepared data.
        """
        folder = self.root / CATEGORY
        if not (folder / DESCRIPTION).is_file():
            raise DataError("hidden modes need data as they were rendered, not prepared", str(folder))
        with errors_at(folder / DESCRIPTION):
            hidden = field(read_json(folder / DESCRIPTION), "hidden", str)
        if hidden != "modes":
            raise CompleteSplatError(f"{folder}: rendered with hidden={hidden}; hidden modes need hidden=modes")
        chances = {name: paint.chance for name, paint in PAINTS.items()}
        return self.written_modes(OBJECT, chances, views, spread_views)
