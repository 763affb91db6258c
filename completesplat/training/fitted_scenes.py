"""Gaussians fitted to whole sequences, once, and kept in files."""

import hashlib
import logging
import os
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path

from rich import get_console
from rich.progress import track
from safetensors.torch import load_file, save_file

from completesplat.data.loading.scenes import SceneStore
from completesplat.gaussians import Gaussians
from completesplat.scene import SceneBatch
from completesplat.tensors import stack

logger = logging.getLogger(__name__)


class FittedScenes:
    """Fits each sequence when it is first asked for, to all its pictures; what is in the folder is not fitted again.

    One sequence at a time is in memory: its pictures and masks (16 bytes a pixel) and its Gaussians. A file takes 56
    bytes for each Gaussian, a folder of 1,000 sequences with 4,000 Gaussians each 224 MB.

    Args:
        folder: of the files, which several processes may share.
        stores: of the sequences.
        fit: a batch of one scene -> its Gaussians, in the reference camera's frame.
        settings: what the fit depends on besides the pictures: another text means other files.
    """

    def __init__(
        self, folder: Path, stores: Sequence[SceneStore], fit: Callable[[SceneBatch], Gaussians], settings: str
    ) -> None:
        self.folder = folder
        self.stores = {name: store for store in stores for name in store.names}
        self.fit = fit
        self.settings = settings

    def complete(self, names: Sequence[str], progress: bool) -> None:
        """Fit those of these sequences that are not there yet; a bar shows it, or ten lines where there is no terminal.

        Raises:
            DataError: a sequence or one of its pictures cannot be read.
        """
        missing = [name for name in names if not self._path(name).is_file()]
        bar = progress and get_console().is_terminal
        for done, name in enumerate(track(missing, "fitting Gaussians to scenes", disable=not bar), start=1):
            self._make(name)
            if progress and not bar and done * 10 // len(missing) > (done - 1) * 10 // len(missing):
                logger.info("fitted Gaussians to %d of %d scenes", done, len(missing))

    def seen_from(self, name: str, frame: int) -> Gaussians:
        """A sequence's Gaussians in the frame of one of its cameras, on the CPU.

        Raises:
            DataError: it has to be fitted first, and it or one of its pictures cannot be read.
        """
        if not self._path(name).is_file():
            self._make(name)
        cameras = self.stores[name].source.read(name).cameras
        to_frame = cameras[frame].relative_to(cameras[0]).world_to_camera
        return Gaussians(**load_file(self._path(name))).transform(to_frame.float())

    def _make(self, name: str) -> None:
        """In the frame of the first camera."""
        store = self.stores[name]
        sequence = store.source.read(name)
        scene = store.scene(sequence, 0, range(1, len(sequence.frames)))
        gaussians = self.fit(stack([scene]))[0]
        tensors = {field.name: getattr(gaussians, field.name).cpu().contiguous() for field in fields(Gaussians)}
        self.folder.mkdir(parents=True, exist_ok=True)
        unfinished = self._path(name).with_suffix(f".{os.getpid()}.unfinished")
        save_file(tensors, unfinished)
        os.replace(unfinished, self._path(name))

    def _path(self, name: str) -> Path:
        """Names of sequences may have slashes."""
        key = hashlib.sha256(f"{name}\n{self.settings}".encode()).hexdigest()[:24]
        return self.folder / f"{key}.safetensors"
