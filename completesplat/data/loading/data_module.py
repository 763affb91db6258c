"""Base classes of all data modules: settings and loaders."""

import logging
from abc import abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from jaxtyping import Float
from lightning import LightningDataModule
from torch import Tensor

from completesplat.data.hidden_modes import HiddenModeScenes
from completesplat.data.loading.augmentation import BoxMasks, CameraJitter, ColorJitter, augment
from completesplat.data.loading.distributed import batch_per_process, processes
from completesplat.data.loading.latent_cache import CachedTrainingScenes, LatentCache
from completesplat.data.loading.loader import EpochSampler, RepeatedEpoch, SceneLoader
from completesplat.data.loading.scenes import EvaluationScenes, SceneStore, TrainingScenes
from completesplat.data.loading.training_statistics import TypicalCamera, feature_moments, mean_camera, mean_image
from completesplat.data.loading.view_selection import Choice, draw_spread_views, evaluation_views, training_views
from completesplat.data.packed.manifest import Scalar, is_packed, settings_must_match
from completesplat.data.packed.source import PackedSource, local_root
from completesplat.data.placement import ObjectFraming
from completesplat.data.sequences import PosedSequence, SequenceSource
from completesplat.data.validation.processes import usable_cores
from completesplat.errors import CompleteSplatError, DataError, TooFewFrames, errors_at
from completesplat.files import counted
from completesplat.settings.schema import Natural, Positive, Range, Share, Side, check_value, hints_of

MOST_WORKERS = 4  # if data.workers is null
SPLITS_OF_STAGE = {"fit": ("train", "val"), "validate": ("val",), "test": ("test",), "predict": ("test",)}

UNCHANGED = (
    "data.color_jitter=null data.camera_jitter=null data.horizontal_flip=false data.background=null "
    "data.random_background=0"
)

T = TypeVar("T")

logger = logging.getLogger(__name__)


def _built(kind: Callable[..., T], settings: Mapping[str, Any] | None) -> T | None:
    try:
        return None if settings is None else kind(**settings)
    except TypeError as error:  # a name is misspelt
        raise CompleteSplatError(f"data: {dict(settings or {})}: {error}") from None


class SceneDataModule(LightningDataModule):
    """Scenes from a data set as published, or as prepared with `completesplat data prepare`.

    The random choices of training depend on the seed, the epoch and the item only.

    Args:
        root: folder of the data set or of its prepared form, or the address of the prepared form (`packed.source`).
        batch_size: scenes of an optimizer step, summed over all training processes and accumulated batches.
        targets: target views of a training scene (not stated by the paper); 0 for latent diffusion, which needs none.
        evaluation_batch_size: scenes of an evaluation batch; 1 is used if scenes have different numbers of targets.
        references_per_sequence: training items of a sequence in one epoch.
        mask_threshold: masks are binarized at this probability; None: they stay soft.
        background: grey value that replaces the background of images with a mask ("Objects only"); None: it stays.
        color_jitter, box_masks, camera_jitter: settings of `ColorJitter`, `BoxMasks` and `CameraJitter`; None: off.
        horizontal_flip: mirror half of the training scenes horizontally.
        random_background: share of the training scenes whose background is replaced by a random colour, the same in
            all views; images without a mask stay as they are.
        workers: processes that load data; 0: none; None: one for each core, at most four.
        cache: keep decoded images in memory.
        latent_cache: folder of latents from which stage 2 is trained (`CachedTrainingScenes`), without colour jitter,
            flips, `background` or `random_background`; validation and test read images.
        on_bad: "skip" items that cannot be read (counted and reported), or "raise" the error.
        max_bad_fraction: share of an epoch's items that may be skipped; one always may, unless this is 0.
        allow_changed: a resumed run may continue with training data that have changed.
    """

    splits_share_sequences = False
    """Whether all splits have the same sequences on purpose, because each split has other frames of them."""

    def __init__(
        self,
        root: str,
        image_size: Side = 128,
        batch_size: Positive = 8,
        targets: Natural = 3,
        evaluation_batch_size: Positive = 4,
        references_per_sequence: Positive = 1,
        mask_threshold: Annotated[float, Range(1e-6, 1)] | None = None,
        background: Share | None = None,
        color_jitter: Mapping[str, float] | None = None,
        box_masks: Mapping[str, Any] | None = None,
        camera_jitter: Mapping[str, Any] | None = None,
        horizontal_flip: bool = False,
        random_background: Share = 0.0,
        workers: Annotated[int, Range(0, 256)] | None = 0,
        cache: bool = False,
        latent_cache: str | None = None,
        on_bad: Literal["skip", "raise"] = "skip",
        max_bad_fraction: Share = 0.1,
        allow_changed: bool = False,
        seed: Natural = 0,
    ) -> None:
        super().__init__()
        ranged = {"targets": targets, "mask_threshold": mask_threshold, "background": background}
        ranged["random_background"] = random_background
        for name, value in (ranged | {"workers": workers, "on_bad": on_bad}).items():
            check_value(f"data.{name}", hints_of(SceneDataModule.__init__)[name], value)
        changed = color_jitter or camera_jitter or horizontal_flip or random_background or background is not None
        if latent_cache is not None and changed:
            raise CompleteSplatError(f"data.latent_cache is of images as they are: set {UNCHANGED}")
        self.root = local_root(root)
        self.image_size = image_size
        self.batch_size = batch_size
        self.targets = targets
        self.evaluation_batch_size = evaluation_batch_size
        self.references_per_sequence = references_per_sequence
        self.mask_threshold = mask_threshold
        self.background = background
        self.box_masks = _built(BoxMasks, box_masks)
        self.augment = partial(
            augment,
            color_jitter=_built(ColorJitter, color_jitter),
            box_masks=self.box_masks,
            horizontal_flip=horizontal_flip,
            camera_jitter=_built(CameraJitter, camera_jitter),
            random_background=random_background,
        )
        self.workers = min(MOST_WORKERS, usable_cores()) if workers is None else workers
        self.cache = cache
        self.latent_cache = None if latent_cache is None else Path(latent_cache)
        self.policy = on_bad, max_bad_fraction
        self.allow_changed = allow_changed
        self.seed = seed
        # The same data in the smaller images that a tested model sees.
        self.at_model_size: SceneDataModule | None = None
        self._sources: dict[str, SequenceSource] = {}
        self._stores: dict[str, SceneStore] = {}

    @abstractmethod
    def packed_settings(self) -> dict[str, Scalar]:
        """Return the settings that determine images, cameras and splits; prepared data must have the same."""

    @abstractmethod
    def describe(self) -> Mapping[str, str | None]:
        """Return facts for results: "data_set", "crop", "protocol_views"; "subset" and "split" if there are lists."""

    @abstractmethod
    def open(self, split: str) -> Mapping[str, SequenceSource]:
        """Open the data set's own files; return the sequences of this split, and of splits that are read with it.

        Raises:
            DataError: the files are missing or unreadable as a whole.
        """

    @abstractmethod
    def training_views(self, frames: int, epoch: int, rng: np.random.Generator) -> Choice:
        """Return reference and targets of a training scene."""

    @abstractmethod
    def evaluation_views(self, sequence: PosedSequence, split: str) -> Choice:
        """Return reference and targets of a scene of "val" or "test".

        Raises:
            DataError: the sequence lacks one of the frames.
        """

    def evaluated(self, split: str, source: SequenceSource) -> SequenceSource:
        """Select the sequences of a split that are used; by default all."""
        return source

    def stackable(self, scenes: EvaluationScenes) -> bool:
        """Return whether all evaluation scenes have the same number of targets."""
        return scenes.stackable()

    def hidden_modes(self, views: int, spread_views: int) -> HiddenModeScenes:
        """Return all test scenes. Targets are up to `views` views that show the modes best, and evenly spread ones.

        Raises:
            CompleteSplatError: the alternatives for what the reference image hides are not known.
        """
        known = "toy objects, or data render hidden=modes"
        raise CompleteSplatError(f"evaluation=hidden_modes needs data whose hidden parts are known: {known}")

    def check_test(self) -> None:
        """Raise DataError for a test that cannot work, before its model is trained; by default, nothing is checked."""

    def setup(self, stage: str | None = None) -> None:
        """List the sequences (images are read later).

        Raises:
            DataError: missing or malformed files, no sequences for this stage, or a latent cache of other data.
            CompleteSplatError: too few training scenes for `batch_size`, or too few frames for `targets`.
        """
        for split in SPLITS_OF_STAGE.get(stage or "", ()):
            self.store(split)
            source = self.source(split)
            left_out = "".join(f"; {len(them)} left out: {reason}" for reason, them in source.left_out.items())
            logger.info("%s: %s%s", split, counted(len(source.names), "sequence"), left_out)
        if stage == "fit":
            _ = self.trained_on  # computed now, because the files could change during the run
            self._check_training()

    def source(self, split: str) -> SequenceSource:
        """Return the sequences of a split ("train", "val" or "test") from the data set's own or prepared files.

        Raises:
            DataError: files are missing, malformed or prepared with other settings, or broken if `on_bad` is "raise".
        """
        if split not in self._sources:
            if is_packed(self.root):
                settings_must_match(self.root, self.packed_settings())
                self._sources[split] = PackedSource(self.root, split, self.image_size)
            else:
                self._sources |= self.open(split)
        source = self._sources[split]
        if source.refused and self.policy[0] == "raise":
            raise source.refused[0]
        return source

    def store(self, split: str) -> SceneStore:
        """Return the scenes of a split, which must have sequences that can be used; errors as in `source`."""
        if split not in self._stores:
            source = self.source(split)
            used = self.evaluated(split, source)
            if not used.names:
                raise DataError(f"no {split} sequences that can be used", str(self.root))
            if source.refused:
                logger.warning("%d annotations cannot be used; the first: %s", len(source.refused), source.refused[0])
            self._stores[split] = SceneStore(used, self.mask_threshold, self.cache, self.background)
        return self._stores[split]

    @cached_property
    def cached_latents(self) -> LatentCache:
        """Latent cache in the folder `latent_cache`, checked for damage and against the training data."""
        assert self.latent_cache is not None
        store = LatentCache(self.latent_cache)
        store.must_belong_to(self.source("train"), self.packed_settings())
        return store

    def train_dataloader(self) -> SceneLoader:
        """Load random views of all training sequences in random order."""
        scenes = self._training_scenes()
        accumulated = 1 if self.trainer is None else self.trainer.accumulate_grad_batches
        if (most := len(scenes) - len(scenes) % (processes()[1] * accumulated)) < self.batch_size:
            logger.warning(
                "data.batch_size=%d: an epoch has %d scenes; taken are %d", self.batch_size, len(scenes), most
            )
            self.batch_size = max(1, most)  # Lightning's `BatchSizeFinder` doubles it after `setup`
        batch_size = batch_per_process(self.batch_size, processes()[1], accumulated)
        sampler = RepeatedEpoch if getattr(self.trainer, "overfit_batches", 0) else EpochSampler
        return SceneLoader(scenes, batch_size, sampler(scenes.groups(), self.seed), self.workers, *self.policy)

    def _check_training(self) -> None:
        """Raise if an epoch has fewer scenes than a batch, or every sequence has fewer frames than a scene needs."""
        scenes, frames = self._training_scenes(), [1]
        names = scenes.store.names
        if self.batch_size > len(scenes):
            counted = f"{len(scenes)} scenes (data.references_per_sequence of each of {len(names)} sequences)"
            raise CompleteSplatError(f"data.batch_size={self.batch_size}: an epoch has {counted}; lower it")
        for name in names:
            if max(frames) > self.targets:
                return
            with suppress(DataError):
                frames.append(len(scenes.store.source.read(name).frames))
        if 1 < max(frames) <= self.targets:
            message = f"a scene needs {self.targets + 1} frames, training sequences have at most {max(frames)} frames"
            raise CompleteSplatError(f"data.targets={self.targets}: {message}")

    def _drawn_views(self, frames: int, epoch: int, rng: np.random.Generator) -> Choice:
        """Return `training_views` of a sequence, after a check that its targets can all be different."""
        if frames <= self.targets:
            raise TooFewFrames(f"{frames} frames, data.targets={self.targets} needs {self.targets + 1}")
        return self.training_views(frames, epoch, rng)

    def _training_scenes(self) -> TrainingScenes:
        settings = self.store("train"), self._drawn_views, self.augment, self.references_per_sequence, self.seed
        if self.latent_cache is not None:
            return CachedTrainingScenes(*settings, self.cached_latents, self.box_masks)
        return TrainingScenes(*settings)

    def val_dataloader(self) -> SceneLoader:
        """Load fixed views of all validation sequences."""
        return self._evaluation_loader("val")

    def test_dataloader(self) -> SceneLoader:
        """Load fixed views of all test sequences."""
        return self._evaluation_loader("test")

    predict_dataloader = test_dataloader

    def _evaluation_loader(self, split: str) -> SceneLoader:
        store, seen = self.store(split), None if self.at_model_size is None else self.at_model_size.store(split)
        choose, depths = partial(self.evaluation_views, split=split), split == "test"
        scenes = EvaluationScenes(store, choose, store.names, seen, depths)
        batch_size = self.evaluation_batch_size if self.stackable(scenes) else 1
        local = scenes.share(batch_size) if split == "test" else scenes
        return SceneLoader(local, batch_size, None, self.workers, *self.policy)

    @cached_property
    def trained_on(self) -> dict[str, str | int]:
        """Fingerprint and number of sequences of the training data, as they were at the first access."""
        source = self.source("train")
        return {"fingerprint": source.fingerprint(), "sequences": len(source.names)}

    def state_dict(self) -> dict[str, str | int]:
        """Return fingerprint and size of the training data for checkpoints."""
        return dict(self.trained_on)

    def load_state_dict(self, state_dict: dict[str, str | int]) -> None:
        """Compare the training data with those of the run that is resumed; with `allow_changed`, only warn.

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

    def typical_camera(self) -> TypicalCamera:
        """Return the mean camera of the training images."""
        with errors_at(file=self.root):
            return mean_camera(self.store("train"))

    def training_facts(self) -> dict[str, float | list[float]]:
        """Return the facts about training images that weights store (`completesplat.parts.TrainingImages`)."""
        hidden = 0.0 if self.box_masks is None else self.box_masks.probability
        background = {} if self.background is None else {"background": self.background}
        return {"box_masks": hidden, **background, **feature_moments(self.store("train"))}

    def mean_image(self) -> Float[Tensor, "3 height width"] | None:
        """Return the mean of the images that `typical_camera` averages, a baseline that ignores the input, if any."""
        return mean_image(self.store("train"), self.image_size) if self.source("train").names else None


class ObjectDataModule(SceneDataModule):
    """Scenes of objects that the cameras surround.

    Training draws a random reference and other frames of a sequence. Validation and test take a sequence's first frame
    as the reference and other frames as targets.

    Args:
        evaluation_targets: at most this many evenly spaced targets of a test scene; None: all other frames.
        validation_targets: the same for a validation scene; None: as for a test scene.
        spread_targets: spread the training targets evenly around the reference (the sequence taken as a ring), in
            random order, for a posterior that sees them; false: draw random targets.
        depth_before, depth_after: depth range in front of and behind the centre of the object, whose half size is 0.57.
        **settings: of `SceneDataModule`.
    """

    def __init__(
        self,
        root: str,
        evaluation_targets: Positive | None = None,
        validation_targets: Positive | None = None,
        spread_targets: bool = False,
        depth_before: float = 2.0,
        depth_after: float = 2.0,
        **settings: Any,
    ) -> None:
        super().__init__(root, **settings)
        self.framing = ObjectFraming(self.image_size, depth_before, depth_after)
        self.spread_targets = spread_targets
        self.evaluation_targets = evaluation_targets
        self.validation_targets = evaluation_targets if validation_targets is None else validation_targets

    def training_facts(self) -> dict[str, float | list[float]]:
        return super().training_facts() | {"depth_before": self.framing.depth_before}

    def described_views(self, reference: str) -> dict[str, str | None]:
        """Return those facts of `describe` that all data of objects share, given what the reference of a test is."""
        targets = "its other frames" if self.evaluation_targets is None else f"{self.evaluation_targets} others"
        views = f"reference: {reference}; targets: {targets}"
        return {"crop": "largest square around the principal point", "protocol_views": views}

    def training_views(self, frames: int, epoch: int, rng: np.random.Generator) -> Choice:
        """Draw a random reference and targets at random, or spread around it."""
        return (draw_spread_views if self.spread_targets else training_views)(frames, self.targets, rng)

    def evaluation_views(self, sequence: PosedSequence, split: str) -> Choice:
        """Return the first frame as reference and others as targets."""
        targets = self.validation_targets if split == "val" else self.evaluation_targets
        return evaluation_views(len(sequence.frames), targets)
