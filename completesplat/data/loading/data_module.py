"""Base class of all data modules: settings of training, augmentation and loading, and Lightning's hooks."""

import logging
from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

from lightning import LightningDataModule

from completesplat.data.loading.augmentation import Augmentation
from completesplat.data.loading.data_set import SceneDataSet
from completesplat.data.loading.distributed import batch_per_process, processes
from completesplat.data.loading.latent_cache import CachedTrainingScenes, LatentCache
from completesplat.data.loading.loader import EpochSampler, RepeatedEpoch, SceneLoader
from completesplat.data.loading.scenes import EvaluationScenes, TrainingScenes
from completesplat.data.loading.training_statistics import feature_moments
from completesplat.data.validation.processes import usable_cores
from completesplat.errors import CompleteSplatError, DataError
from completesplat.quantities import Natural, Positive, Range, Share
from completesplat.wording import counted

MOST_WORKERS = 4  # if data.workers is null
SPLITS_OF_STAGE = {
    "fit": ("train", "val"),
    "validate": ("val",),
    "test": ("test",),
    "predict": ("test",),
}
UNCHANGED = (
    "data.color_jitter=null data.camera_jitter=null data.horizontal_flip=false data.background=null "
    "data.random_background=0"
)

logger = logging.getLogger(__name__)


class SceneDataModule(SceneDataSet, LightningDataModule):
    """Loaders of a data set's scenes for training, validation and test.

    The random choices of training depend on the seed, the epoch and the item only.

    Args:
        batch_size: scenes of an optimizer step, summed over all training processes and accumulated batches.
        targets: target views of a training scene (not stated by the paper); 0 for latent diffusion, which needs none.
        evaluation_batch_size: scenes of an evaluation batch; 1 is used if scenes have different numbers of targets.
        references_per_sequence: training items of a sequence in one epoch.
        color_jitter, box_masks, camera_jitter: settings of `ColorJitter`, `BoxMasks` and `CameraJitter`; None: off.
        horizontal_flip: mirror half of the training scenes horizontally.
        random_background: share of the training scenes whose background is replaced by a random colour, the same in
            all views; images without a mask stay as they are.
        workers: processes that load data; 0: none; None: one for each core, at most four.
        latent_cache: folder of latents from which stage 2 is trained (`CachedTrainingScenes`), without colour jitter,
            flips, `background` or `random_background`; validation and test read images.
        allow_changed: a resumed run may continue with training data that have changed.
        **reading: settings of `SceneDataSet`.
    """

    def __init__(
        self,
        root: str,
        batch_size: Positive = 8,
        targets: Natural = 3,
        evaluation_batch_size: Positive = 4,
        references_per_sequence: Positive = 1,
        color_jitter: Mapping[str, float] | None = None,
        box_masks: Mapping[str, Any] | None = None,
        camera_jitter: Mapping[str, Any] | None = None,
        horizontal_flip: bool = False,
        random_background: Share = 0.0,
        workers: Annotated[int, Range(0, 256)] | None = 0,
        latent_cache: str | None = None,
        allow_changed: bool = False,
        seed: Natural = 0,
        **reading: Any,
    ) -> None:
        super().__init__(root, **reading)
        self.batch_size = batch_size
        self.targets = targets
        self.evaluation_batch_size = evaluation_batch_size
        self.references_per_sequence = references_per_sequence
        self.augmentation = Augmentation.of_settings(
            color_jitter, box_masks, camera_jitter, horizontal_flip, random_background
        )
        self.workers = min(MOST_WORKERS, usable_cores()) if workers is None else workers
        self.latent_cache = None if latent_cache is None else Path(latent_cache)
        self.allow_changed = allow_changed
        self.seed = seed
        # The same data in the smaller images that a tested model takes, if it is scored at a higher resolution.
        self.low_resolution: SceneDataModule | None = None
        changes_images = self.augmentation.changes_images() or self.background is not None
        if self.latent_cache is not None and changes_images:
            raise CompleteSplatError(f"data.latent_cache is of images as they are: set {UNCHANGED}")

    def check_test(self) -> None:
        """Raise DataError for a test that cannot work, before its model is trained. By default, nothing is checked."""

    def setup(self, stage: str | None = None) -> None:
        """List the sequences (images are read later).

        Raises:
            DataError: missing or malformed files, no sequences for this stage, or a latent cache of other data.
            CompleteSplatError: too few training scenes for `batch_size`, or too few frames for `targets`.
        """
        for split in SPLITS_OF_STAGE.get(stage or "", ()):
            self.store(split)
            source = self.source(split)
            left_out = "".join(f"; {len(names)} left out: {reason}" for reason, names in source.left_out.items())
            logger.info("%s: %s%s", split, counted(len(source.names), "sequence"), left_out)
        if stage == "fit":
            _ = self.trained_on  # computed now, because the files could change during the run
            self.training_scenes().check(self.batch_size)

    def training_scenes(self) -> TrainingScenes:
        """Return the items of training, images or cached latents."""
        settings = (
            self.store("train"),
            self.training_views,
            self.targets,
            self.augmentation,
            self.references_per_sequence,
            self.seed,
        )
        if self.latent_cache is not None:
            return CachedTrainingScenes(*settings, self.cached_latents)
        return TrainingScenes(*settings)

    @cached_property
    def cached_latents(self) -> LatentCache:
        """Latent cache in the folder `latent_cache`, checked for damage and against the training data."""
        assert self.latent_cache is not None
        cache = LatentCache(self.latent_cache)
        cache.must_belong_to(self.source("train"), self.packed_settings())
        return cache

    def train_dataloader(self) -> SceneLoader:
        """Load random views of all training sequences in random order."""
        scenes = self.training_scenes()
        count = processes()[1]
        accumulated = 1 if self.trainer is None else self.trainer.accumulate_grad_batches
        most = len(scenes) - len(scenes) % (count * accumulated)
        if most < self.batch_size:
            message = "data.batch_size=%d: an epoch has %d scenes; taken are %d"
            logger.warning(message, self.batch_size, len(scenes), most)
            self.batch_size = max(1, most)  # Lightning's `BatchSizeFinder` doubles it after `setup`
        batch_size = batch_per_process(self.batch_size, count, accumulated)
        repeated = getattr(self.trainer, "overfit_batches", 0)
        sampler = (RepeatedEpoch if repeated else EpochSampler)(scenes.groups(), self.seed)
        return SceneLoader(scenes, batch_size, sampler, self.workers, self.tolerance)

    def val_dataloader(self) -> SceneLoader:
        """Load fixed views of all validation sequences."""
        scenes = self._evaluation_scenes("val")
        return SceneLoader(scenes, self._evaluation_batch(scenes), None, self.workers, self.tolerance)

    def test_dataloader(self) -> SceneLoader:
        """Load fixed views of this process's share of the test sequences, with the true depths that there are."""
        scenes = self._evaluation_scenes("test")
        batch_size = self._evaluation_batch(scenes)
        return SceneLoader(scenes.share(batch_size), batch_size, None, self.workers, self.tolerance)

    predict_dataloader = test_dataloader

    def _evaluation_scenes(self, split: str) -> EvaluationScenes:
        store = self.store(split)
        low_resolution = None if self.low_resolution is None else self.low_resolution.store(split)
        choose = partial(self.evaluation_views, split=split)
        return EvaluationScenes(store, choose, store.names, low_resolution, depths=split == "test")

    def _evaluation_batch(self, scenes: EvaluationScenes) -> int:
        return self.evaluation_batch_size if self.stackable(scenes) else 1

    @cached_property
    def trained_on(self) -> dict[str, str | int]:
        """Fingerprint and number of sequences of the training data, as they were at the first access."""
        source = self.source("train")
        return {"fingerprint": source.fingerprint(), "sequences": len(source.names)}

    def state_dict(self) -> dict[str, str | int]:
        """Return fingerprint and size of the training data for checkpoints."""
        return dict(self.trained_on)

    def load_state_dict(self, state_dict: dict[str, str | int]) -> None:
        """Compare the training data with those of the run that is resumed. With `allow_changed`, only warn.

        Raises:
            DataError: the training data have changed.
        """
        now = self.trained_on
        before = now | state_dict  # checkpoints of version 0.1 have no number of sequences
        if before == now:
            return
        counts = f"{before['sequences']} sequences then, {now['sequences']} now"
        message = f"not the training data that this run had before ({counts})"
        if not self.allow_changed:
            raise DataError(f"{message}; data.allow_changed=true goes on with these", str(self.root))
        logger.warning("%s: %s", self.root, message)

    def training_facts(self) -> dict[str, float | list[float]]:
        """Return the facts about training images that weights store (`TrainingImages`)."""
        boxes = self.augmentation.box_masks
        facts: dict[str, float | list[float]] = {"box_masks": 0.0 if boxes is None else boxes.probability}
        if self.background is not None:
            facts["background"] = self.background
        facts.update(feature_moments(self.store("train")))
        return facts
