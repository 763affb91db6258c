"""Scenes that any program wrote as files of Gaussians, scored like a model's."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from completesplat.errors import CompleteSplatError, PlyError
from completesplat.evaluation.scorer import Scorer
from completesplat.export.reading import read_gaussians
from completesplat.gaussians import Gaussians
from completesplat.scene import SceneBatch, Views
from completesplat.tensors import stack
from completesplat.weights import sha256_of
from completesplat.wording import by_numbers, safe_name

FILES = "sample_*.ply"
LEAST_IN_FRONT = 0.1  # of a scene's Gaussians: with less, the axes are wrong
FROM_OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))


class PlySamples(Scorer):
    """Scorer whose samples are the files `sample_*.ply` of each test scene.

    Args:
        folder, frame, align, name: `scenes`, `frame`, `align` and `method` of `conf/test.yaml`.
        **rendering: see `Scorer`.

    Raises:
        CompleteSplatError: there is no such folder.
    """

    draws_samples = True

    def __init__(self, folder: str, frame: str, align: str, name: str | None, **rendering: Any) -> None:
        super().__init__(**rendering)
        self.folder = Path(folder)
        self.frame = frame
        self.align = align
        self.name = name
        self.files: dict[str, list[Path]] = {}
        if not self.folder.is_dir():
            raise CompleteSplatError(f"scenes={folder}: no such folder; give one with SCENE/{FILES}")

    @property
    def method(self) -> str:
        """Return the name of the method, marked as read from files."""
        return f"{self.folder.resolve().name if self.name is None else self.name} (read from files)"

    def find_files(self, scenes: Sequence[str], samples: int) -> None:
        """Find the first `samples` files of these scenes, by name, or raise CompleteSplatError if a scene has fewer."""
        self.files = {}
        for scene in scenes:
            paths = (self.folder / safe_name(scene)).glob(FILES)
            self.files[scene] = sorted(paths, key=by_numbers)[:samples]
        incomplete = [scene for scene in scenes if len(self.files[scene]) < samples]
        if incomplete:
            folder = self.folder / safe_name(incomplete[0])
            count = len(self.files[incomplete[0]])
            present = f"{count} files {FILES}" if folder.is_dir() else "no such folder"
            needed = f"{samples} files are needed ({len(incomplete)} of {len(scenes)} scenes have too few)"
            raise CompleteSplatError(f"{folder}: {present}, {needed}; write them, or score fewer samples")

    def on_test_start(self) -> None:
        self.find_files(self.data.store("test").names, self.evaluation.samples)  # before any scene is scored
        super().on_test_start()

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        return self.draw(scenes, [seed], 1)

    def draw(self, scenes: SceneBatch, seeds: Sequence[int], samples: int, batch: int | None = None) -> Gaussians:
        """Read the first files of each scene, and pad the smaller sets with Gaussians of opacity 0."""
        sets: list[Gaussians] = []
        for i in range(len(scenes.names)):
            sets += self._read(scenes[i], samples)
        most = max(gaussians.count for gaussians in sets)

        def padded(values: Tensor) -> Tensor:
            return pad(values, (0, 0) * (values.ndim - 1) + (0, most - len(values)))

        return stack([gaussians.map(padded) for gaussians in sets])

    def _read(self, scene: SceneBatch, samples: int) -> list[Gaussians]:
        """Read one scene's samples and place them in the reference camera's frame, in the data's units."""
        sets = []
        paths = self.files[str(scene.names)][:samples]
        for path in paths:
            gaussians = read_gaussians(path)
            if not gaussians.count:
                raise PlyError(f"{path}: holds 0 Gaussians; write it again")
            if self.frame == "opengl":
                gaussians = gaussians.transform(FROM_OPENGL)
            sets.append(gaussians.to(scene.reference.images.device))
        if (sets[0].means[:, 2] > 0).float().mean() < LEAST_IN_FRONT:
            other = "opengl" if self.frame == "opencv" else "opencv"
            raise CompleteSplatError(f"{paths[0]}: nearly all Gaussians lie behind the camera; try frame={other}")
        if self.align != "scale":
            return sets
        factor = self._scale(sets[0], scene.reference)
        if factor is None:
            reason = "at the pixels that its first sample covers"
            if scene.reference.depths is None:
                reason = "(prepared data have none, nor has another evaluation.resolution)"
            raise CompleteSplatError(f"align=scale: {scene.names}: no true depth {reason}; use align=none")
        return [replace(x, means=factor * x.means, scales=factor * x.scales) for x in sets]

    def _scale(self, gaussians: Gaussians, reference: Views) -> float | None:
        """Return the least-squares factor from rendered to true depth, or None without common pixels."""
        depth = self.render_from(gaussians[None], reference.cameras[None])[0, 0].surface_depth()
        true = torch.zeros_like(depth) if reference.depths is None else reference.depths
        mask = true.isfinite() & (true > 0) & (depth > 0)
        if not mask.any():
            return None
        return ((depth * true)[mask].sum() / depth[mask].square().sum()).item()

    def on_test_epoch_end(self) -> None:
        self.seconds.pop("inference", None)  # this was the time of reading files
        super().on_test_epoch_end()

    def facts(self) -> dict[str, object]:
        """Return facts for the protocol, with the SHA-256 of each used file.

        The checkpoint's covers the sorted lines of `sha256sum` for these files.
        """
        paths = [path.relative_to(self.folder) for scene in self.files.values() for path in scene]
        digests = {path.as_posix(): sha256_of(self.folder / path) for path in sorted(paths)}
        lines = sorted(f"{digest}  {path}\n" for path, digest in digests.items())
        checksum = hashlib.sha256("".join(lines).encode()).hexdigest()
        return {
            "checkpoint": {"path": str(self.folder), "sha256": checksum, "step": None},
            "ema": None,
            "frame": self.frame,
            "align": self.align,
            "files": digests,
        }
