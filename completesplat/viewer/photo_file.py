"""The file of the page's photo, which is read again for each part that is taken of it."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8

from completesplat.errors import CompleteSplatError
from completesplat.export.images import to_pixels
from completesplat.photo.reading import Photograph, read_whole
from completesplat.quantities import Crop
from completesplat.scene_model import SceneModel


@dataclass(frozen=True)
class PhotoFile:
    """A photo as it was given to the page.

    Attributes:
        name: its name, for people; never a path.
        content: the bytes of its file.
        fov_degrees, remove_background: how it is read (`SceneModel.read`).
    """

    name: str
    content: bytes
    fov_degrees: float | None = None
    remove_background: bool = False

    def read(self, model: SceneModel, crop: Crop) -> Photograph:
        """Read a part of it for a model. Arguments and errors are those of `SceneModel.read`."""
        with self._stored() as path:
            return model.read(path, self.fov_degrees, remove_background=self.remove_background, crop=crop)

    def whole(self, longest: int) -> UInt8[np.ndarray, "_ _ 3"]:
        """Return all of it, upright, no longer than so many pixels."""
        with self._stored() as path:
            image = read_whole(path, background=1.0)
        image.thumbnail((longest, longest))
        if image.mode == "RGB":
            return np.array(image)
        return to_pixels(torch.from_numpy(np.array(image)).expand(3, -1, -1))

    @contextmanager
    def _stored(self) -> Iterator[Path]:
        """Lend a file with its content. Errors name the photo instead of this file."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "photo"
            path.write_bytes(self.content)
            try:
                yield path
            except CompleteSplatError as error:
                raise CompleteSplatError(str(error).replace(str(path), self.name)) from error
