"""Gaussian scenes that any program wrote, scored as the samples of a model are."""

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import pad
from torch.optim import Adam

from completesplat.errors import CompleteSplatError, PlyError
from completesplat.export.ply import read_ply
from completesplat.files import safe_name
from completesplat.gaussians import Gaussians
from completesplat.rasterizers import Rasterizer
from completesplat.scene import SceneBatch, Views
from completesplat.settings.schema import Share
from completesplat.tensors import stack
from completesplat.training.optimization import constant
from completesplat.training.stage import Stage
from completesplat.weights import sha256_of

SAMPLES = "sample_*.ply"
TO_OPENCV = {"opencv": torch.eye(4), "opengl": torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))}
"""Rotations from the axes of files to those of our cameras."""


class SceneFiles(Stage):
    """Samples from files, `FOLDER/SCENE/sample_*.ply` for each test scene; it has nothing to train.

    Args:
        folder, frame, align, name: `scenes`, `frame`, `align` and `method` in `conf/test.yaml`.
        background: as in `Stage`.

    Raises:
        CompleteSplatError: there is no such folder.
    """

    draws_samples = True

    def __init__(
        self,
        folder: Path,
        frame: str,
        align: str,
        name: str | None,
        rasterizer: Rasterizer,
        background: Share = 0.5,
    ) -> None:
        super().__init__(rasterizer, Adam, constant, background)
        self.folder, self.frame, self.align = folder, frame, align
        self.name = folder.resolve().name if name is None else name
        self.files: dict[str, list[Path]] = {}
        if not folder.is_dir():
            raise CompleteSplatError(f"scenes={folder}: no such folder; give one that has SCENE/{SAMPLES}")

    @property
    def method(self) -> str:
        """Return the name of the method that wrote the files."""
        return self.name

    def find(self, scenes: Sequence[str], samples: int) -> None:
        """Find the files of these scenes, of each the first ones by name.

        Raises:
            CompleteSplatError: a scene has no folder, or fewer files than `samples`.
        """
        folders = {scene: self.folder / safe_name(scene) for scene in scenes}
        if missing := [folder for folder in folders.values() if not folder.is_dir()]:
            lacking = f"so do {len(missing)} of {len(folders)} test scenes"
            raise CompleteSplatError(f"{missing[0]}: no such folder, {lacking}; write {SAMPLES} into one for each")
        self.files = {scene: sorted(folder.glob(SAMPLES))[:samples] for scene, folder in folders.items()}
        if few := [scene for scene, files in self.files.items() if len(files) < samples]:
            counted = f"{len(self.files[few[0]])} files {SAMPLES}, {samples} are wanted"
            raise CompleteSplatError(f"{folders[few[0]]}: {counted}; write more, or score fewer samples")

    def on_test_start(self) -> None:
        """Find the files of all test scenes before any is scored."""
        self.find(self.data.store("test").names, self.evaluation.samples)
        super().on_test_start()

    def draw(self, scenes: SceneBatch, seeds: Sequence[int], samples: int, batch: int | None = None) -> Gaussians:
        """Read the first files of each scene; smaller sets are filled up with Gaussians that nobody sees."""
        sets = [gaussians for i in range(len(scenes.names)) for gaussians in self._read(scenes[i], samples)]
        most = max(gaussians.count for gaussians in sets)
        return stack([filled_up(gaussians, most) for gaussians in sets])

    def reconstruct(self, scenes: SceneBatch, seed: int = 0) -> Gaussians:
        """Read the first file of each scene."""
        return self.draw(scenes, [seed], 1)

    def _read(self, scene: SceneBatch, samples: int) -> list[Gaussians]:
        """Read one scene's samples, placed in the reference camera's frame in the data's units.

        Raises:
            CompleteSplatError: the camera sees no Gaussian of the first sample, or its scale cannot be found.
            PlyError: a file is damaged or empty.
        """
        paths = self.files[str(scene.names)][:samples]
        sets = [self._placed(path).to(scene.reference.images.device) for path in paths]
        if not (sets[0].means[:, 2] > 0).any():
            (other,) = TO_OPENCV.keys() - {self.frame}
            reason = f"all Gaussians lie behind the reference camera with frame={self.frame}"
            raise CompleteSplatError(f"{paths[0]}: {reason}; try frame={other}")
        if self.align == "none":
            return sets
        factor = self._scale(sets[0], scene.reference)
        if factor is None:
            reason = "the data have no true depth where the first sample shows something"
            raise CompleteSplatError(f"align=scale: {paths[0].parent.name}: {reason}; use align=none")
        return [replace(one, means=factor * one.means, scales=factor * one.scales) for one in sets]

    def _placed(self, path: Path) -> Gaussians:
        gaussians = read_ply(path)
        if not gaussians.count:
            raise PlyError(f"{path}: holds 0 Gaussians; write the scene again")
        return gaussians if self.frame == "opencv" else gaussians.transform(TO_OPENCV[self.frame])

    def _scale(self, gaussians: Gaussians, reference: Views) -> Float[Tensor, ""] | None:
        """Return the factor by which the rendered depth fits the true one best (least squares); None without either."""
        if reference.depths is None:
            return None
        rendered = self.render_from(gaussians[None], reference.cameras[None])[0, 0]
        known = (rendered.alpha > 0.5) & (reference.depths > 0) & reference.depths.isfinite()
        depth, true = rendered.expected_depth()[known], reference.depths[known]
        return (depth * true).sum() / depth.square().sum() if known.any() else None

    def test_results(self) -> dict[str, dict[str, Any]]:
        """Return the results of `Stage` without the time of inference, which is that of reading files here."""
        results = super().test_results()
        results["model"]["seconds"].pop("inference", None)
        return results

    def facts(self) -> dict[str, object]:
        """Return facts for the protocol: folder, a checksum of all files that were used, frame and alignment."""
        paths = sorted(path for files in self.files.values() for path in files)
        lines = [f"{sha256_of(path)}  {path.relative_to(self.folder).as_posix()}\n" for path in paths]
        checksum = hashlib.sha256("".join(lines).encode()).hexdigest()
        facts = {"checkpoint": {"path": str(self.folder), "sha256": checksum, "step": None}, "ema": None}
        return {**facts, "gaussians": "read from files", "frame": self.frame, "align": self.align}


def filled_up(gaussians: Gaussians, count: int) -> Gaussians:
    """Return one unbatched set of `count` Gaussians, of which the added ones have an opacity of 0."""
    return gaussians.map(lambda values: pad(values, (0, 0) * (values.ndim - 1) + (0, count - gaussians.count)))
