"""One category of CO3D v2 (Reizenstein et al., ICCV 2021), or of anything in its layout, as a data module."""

from pathlib import Path

import torch
from jaxtyping import Float
from lightning import LightningDataModule
from torch import Tensor
from torch.utils.data import DataLoader

from completesplat.data.co3d_annotations import CO3DSequence, read_category
from completesplat.data.co3d_scenes import EpochSampler, EvaluationScenes, SceneStore, TrainingScenes
from completesplat.data.loading import scene_loader
from completesplat.data.typical_camera import TypicalCamera, typical_camera
from completesplat.errors import DataError
from completesplat.scene import SceneBatch

SPLITS_OF_STAGE = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",)}


class CO3DDataModule(LightningDataModule):
    """Scenes of one category.

    Training draws a random reference and random targets of a sequence; validation and test take a sequence's first
    frame as the reference and its other frames as targets. What is drawn depends on the seed, the epoch and the item
    only. Needs neither PyTorch3D nor the `co3d` package.

    Args:
        root: folder of the categories.
        category: a folder below `root`, such as "hydrant".
        subset: the set list that splits the frames. CO3D's own fewview lists repeat training frames in their test
            split except `fewview_dev` and `fewview_test`.
        image_size: pictures are cropped to the largest square around the principal point and resized to this.
        targets: target views of a training scene (not stated by the paper).
        evaluation_targets: at most this many evenly spaced targets of an evaluation scene; None: all.
        evaluation_batch_size: scenes of an evaluation batch; 1 is used if they differ in their number of targets.
        depth_before, depth_after: the depth range around the object's centre, where the object's half size is 0.57
            (Splatter Image: 2 and 2, for masked objects; not stated by the paper for full pictures).
        references_per_sequence: training items of a sequence in one epoch.
        workers: processes that load data; 0: none.
        cache: keep decoded pictures in memory.
    """

    def __init__(
        self,
        root: str,
        category: str,
        subset: str = "fewview_train",
        image_size: int = 64,
        batch_size: int = 8,
        targets: int = 3,
        evaluation_targets: int | None = None,
        evaluation_batch_size: int = 4,
        depth_before: float = 1.5,
        depth_after: float = 4.0,
        references_per_sequence: int = 1,
        workers: int = 0,
        cache: bool = True,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.root = Path(root)
        self.category = category
        self.subset = subset
        self.image_size = image_size
        self.batch_size = batch_size
        self.targets = targets
        self.evaluation_targets = evaluation_targets
        self.evaluation_batch_size = evaluation_batch_size
        self.depth_before = depth_before
        self.depth_after = depth_after
        self.references_per_sequence = references_per_sequence
        self.workers = workers
        self.cache = cache
        self.seed = seed
        self._stores: dict[str, SceneStore] = {}

    def setup(self, stage: str | None = None) -> None:
        """Read the annotations (no pictures).

        Raises:
            DataError: missing or malformed files, or no sequences for this stage.
        """
        if not self._stores:
            sequences = read_category(self.root, self.category, self.subset)
            self._stores = {split: self._store(members) for split, members in sequences.items()}
        for split in SPLITS_OF_STAGE.get(stage or "", ()):
            self.store(split)

    def _store(self, sequences: list[CO3DSequence]) -> SceneStore:
        return SceneStore(sequences, self.image_size, self.depth_before, self.depth_after, self.cache)

    def store(self, split: str) -> SceneStore:
        """The scenes of a split ("train", "val" or "test").

        Raises:
            DataError: it has no sequences.
        """
        store = self._stores[split]
        if not store.sequences:
            raise DataError(f"no {split} sequences in subset {self.subset} of {self.root / self.category}")
        return store

    def train_dataloader(self) -> DataLoader[SceneBatch]:
        """Random views of all training sequences, in random order."""
        scenes = TrainingScenes(self.store("train"), self.targets, self.references_per_sequence, self.seed)
        return self._loader(scenes, self.batch_size, EpochSampler(len(scenes), self.seed))

    def val_dataloader(self) -> DataLoader[SceneBatch]:
        """The validation sequences, first frame to all others."""
        return self._evaluation_loader("val")

    def test_dataloader(self) -> DataLoader[SceneBatch]:
        """The test sequences, first frame to all others."""
        return self._evaluation_loader("test")

    def _evaluation_loader(self, split: str) -> DataLoader[SceneBatch]:
        scenes = EvaluationScenes(self.store(split), self.evaluation_targets)
        return self._loader(scenes, self.evaluation_batch_size if scenes.stackable() else 1, sampler=None)

    def _loader(
        self, scenes: TrainingScenes | EvaluationScenes, batch_size: int, sampler: EpochSampler | None
    ) -> DataLoader[SceneBatch]:
        return scene_loader(scenes, batch_size, sampler, self.workers)

    def typical_camera(self) -> TypicalCamera:
        """The mean camera of the training frames."""
        store = self.store("train")
        sequences = range(len(store.sequences))
        return typical_camera([store.cameras(i)[0] for i in sequences], [store.depth_ranges(i) for i in sequences])

    def mean_image(self) -> Float[Tensor, "3 height width"]:
        """Mean of all training pictures: the guess of a model that knows nothing about its input."""
        store = self.store("train")
        total, count = torch.zeros(3, self.image_size, self.image_size, dtype=torch.float64), 0
        for index, sequence in enumerate(store.sequences):
            for frame in range(len(sequence.frames)):
                total += store.image(index, frame)
                count += 1
        return (total / (255 * count)).float()
