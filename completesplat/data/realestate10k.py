"""RealEstate10K (Zhou et al., SIGGRAPH 2018) as a data module."""

import logging
from pathlib import Path

import torch
from jaxtyping import Float
from lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader

from completesplat.data.loading import scene_loader
from completesplat.data.realestate10k_evaluation import choose_clips
from completesplat.data.realestate10k_scenes import (
    CROPS,
    ChunkSampler,
    Clips,
    EvaluationScenes,
    SceneStore,
    TrainingScenes,
    open_clips,
    split_by_hash,
)
from completesplat.data.typical_camera import TypicalCamera, typical_camera
from completesplat.errors import CompleteSplatError, DataError
from completesplat.scene import SceneBatch

SPLITS_OF_STAGE = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",)}
# A mean over all of 66,033 clips would take hours.
CLIPS_OF_MEANS, FRAMES_OF_MEANS = 256, 8

logger = logging.getLogger(__name__)


class RE10KDataModule(LightningDataModule):
    """Scenes of room tours.

    `root` has the folders `train` and `test`, either with texts and frames as published (`realestate10k_text`) or with
    pixelSplat's chunks (`realestate10k_chunks`). Training draws a random reference and random targets near it; what is
    drawn depends on the seed, the epoch and the item only. Clips are checked when they are read.

    Args:
        image_size: pictures are cropped to a square and resized to this.
        targets: target views of a training scene (not stated by the paper).
        min_gap, max_gap: frames between the reference and a training target, either way (Flash3D: at most 30).
        evaluation_targets, evaluation_gap: validation and test take a clip's first frame as the reference and so many
            evenly spaced targets among the next `evaluation_gap` frames.
        evaluation_index: pixelSplat's file of test views, instead of that rule.
        scene_list: a file with the keys of the clips to test, one a line.
        evaluation_batch_size: scenes of an evaluation batch; 1 is used if they differ in their number of targets.
        crop: "center": the largest central square (DFM); "principal": the largest one around the principal point.
        near, far: depth range in the clips' units (DFM, `data_io/realestate10k.py:55-56`; not stated by the paper).
        scale: all lengths, near and far included, are multiplied by this.
        val_fraction: share of `train` that is held out for validation, at least one clip, chosen by key and `val_seed`.
        references_per_clip: training items of a clip in one epoch.
        workers: processes that load data, each with at most two chunks in memory; 0: none.
    """

    def __init__(
        self,
        root: str,
        image_size: int = 128,
        batch_size: int = 8,
        targets: int = 3,
        min_gap: int = 1,
        max_gap: int = 30,
        evaluation_targets: int = 3,
        evaluation_gap: int = 30,
        evaluation_index: str | None = None,
        scene_list: str | None = None,
        evaluation_batch_size: int = 4,
        crop: str = "center",
        near: float = 0.7,
        far: float = 10.0,
        scale: float = 1.0,
        val_fraction: float = 0.02,
        val_seed: int = 0,
        references_per_clip: int = 1,
        workers: int = 0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if not 1 <= min_gap <= max_gap or evaluation_gap < 1:
            raise CompleteSplatError("data: needs 1 <= min_gap <= max_gap and 1 <= evaluation_gap")
        if not 0 < near < far or not scale > 0:
            raise CompleteSplatError("data: needs 0 < near < far and 0 < scale")
        if crop not in CROPS:
            raise CompleteSplatError(f"data.crop={crop}: choose one of {', '.join(CROPS)}")
        self.root = Path(root)
        self.image_size = image_size
        self.batch_size = batch_size
        self.targets = targets
        self.gaps = min_gap, max_gap
        self.evaluation = evaluation_targets, evaluation_gap
        self.evaluation_index = Path(evaluation_index) if evaluation_index else None
        self.scene_list = Path(scene_list) if scene_list else None
        self.evaluation_batch_size = evaluation_batch_size
        self.placement = crop, scale, near, far
        self.val_fraction = val_fraction
        self.val_seed = val_seed
        self.references_per_clip = references_per_clip
        self.workers = workers
        self.seed = seed
        self._stores: dict[str, SceneStore] = {}
        self._test_views: dict[str, tuple[int, list[int]]] | None = None

    def setup(self, stage: str | None = None) -> None:
        """List the clips (their cameras and pictures are read later).

        Raises:
            DataError: missing or malformed files, or no clips for this stage.
        """
        for split in SPLITS_OF_STAGE.get(stage or "", ()):
            self.store(split)

    def store(self, split: str) -> SceneStore:
        """The scenes of a split ("train", "val" or "test").

        Raises:
            DataError: it has no clips.
        """
        if split not in self._stores:
            (self._list_tests if split == "test" else self._list_training)()
        store = self._stores[split]
        if not store.keys:
            raise DataError(f"no {split} clips below {self.root}")
        return store

    def _list_training(self) -> None:
        clips = open_clips(self.root / "train")
        train, val = split_by_hash(clips.keys, self.val_fraction, self.val_seed)
        # Both read through the same two chunks.
        self._stores |= {"train": self._store(clips, train), "val": self._store(clips, val)}
        logger.info("%d clips to train, %d to validate; left out: %d missing", len(train), len(val), clips.missing)

    def _list_tests(self) -> None:
        clips = open_clips(self.root / "test")
        keys, self._test_views, left_out = choose_clips(clips.keys, self.evaluation_index, self.scene_list)
        self._stores["test"] = self._store(clips, keys)
        counts = ", ".join(f"{count} {reason}" for reason, count in {"missing": clips.missing, **left_out}.items())
        logger.info("%d clips to test; left out: %s", len(keys), counts)

    def _store(self, clips: Clips, keys: list[str]) -> SceneStore:
        return SceneStore(clips, keys, self.image_size, *self.placement)

    def train_dataloader(self) -> DataLoader[SceneBatch]:
        """Random views of all training clips, chunk by chunk in random order."""
        scenes = TrainingScenes(self.store("train"), self.targets, *self.gaps, self.references_per_clip, self.seed)
        return self._loader(scenes, self.batch_size, ChunkSampler(scenes.chunks(), self.seed))

    def val_dataloader(self) -> DataLoader[SceneBatch]:
        """The held-out clips, first frame to those that follow."""
        return self._evaluation_loader(EvaluationScenes(self.store("val"), *self.evaluation, listed=None))

    def test_dataloader(self) -> DataLoader[SceneBatch]:
        """The test clips."""
        store = self.store("test")  # lists the views
        return self._evaluation_loader(EvaluationScenes(store, *self.evaluation, listed=self._test_views))

    def _evaluation_loader(self, scenes: EvaluationScenes) -> DataLoader[SceneBatch]:
        return self._loader(scenes, self.evaluation_batch_size if scenes.stackable() else 1, sampler=None)

    def _loader(
        self, scenes: TrainingScenes | EvaluationScenes, batch_size: int, sampler: ChunkSampler | None
    ) -> DataLoader[SceneBatch]:
        return scene_loader(scenes, batch_size, sampler, self.workers)

    def typical_camera(self) -> TypicalCamera:
        """The mean camera of some training frames: 8 of each of the first 256 clips."""
        store = self.store("train")
        cameras = [store.cameras(clip, few) for clip, few in store.excerpts(CLIPS_OF_MEANS, FRAMES_OF_MEANS)]
        frames = sum(len(c.intrinsics) for c in cameras)
        return typical_camera(cameras, [store.depth_range.expand(frames, 2)])

    def mean_image(self) -> Float[Tensor, "3 height width"]:
        """Mean of some training pictures, those of `typical_camera`: a guess that knows nothing about the input."""
        store = self.store("train")
        total, count = torch.zeros(3, self.image_size, self.image_size, dtype=torch.float64), 0
        for clip, frames in store.excerpts(CLIPS_OF_MEANS, FRAMES_OF_MEANS):
            for frame in frames:
                total += store.image(clip, frame)
                count += 1
        return (total / (255 * count)).float()
