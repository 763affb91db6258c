"""Data module for categories of CO3D v2 (Reizenstein et al., ICCV 2021), or of data in its layout."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

from completesplat.data.co3d.category import Filters, read_categories
from completesplat.data.co3d.category_writers import in_mode
from completesplat.data.co3d.source import CO3DSource
from completesplat.data.loading.hidden_modes import HiddenModeScenes
from completesplat.data.loading.object_data_module import ObjectDataModule
from completesplat.data.packed.manifest import Scalar
from completesplat.data.splits import SeededSplit
from completesplat.errors import CompleteSplatError, DataError, MissingFile
from completesplat.quantities import Natural, Positive, Range, Share


class CO3DDataModule(ObjectDataModule):
    """Scenes of one category or several, read without PyTorch3D and without the `co3d` package.

    Args:
        root: folder of the categories, or a folder of prepared data.
        category: a folder below `root`, such as "hydrant", or several, which are one data set. Then each is split and
            filtered for itself, and scenes are named CATEGORY/NAME. The order of categories changes nothing.
        subset: name of the set list that splits the frames (Splatter Image: `fewview_dev`); None: split by seed.
        allow_shared_sequences: accept a set list that tests on sequences of training or validation. CO3D's
            `fewview_train` does, and so do all lists that divide the frames of a sequence (`manyview_...`).
        val_fraction, test_fraction, split_seed: shares of the sequences by seed, at least one in each split.
        min_frames, min_viewpoint_quality, min_point_cloud_quality, most_training_sequences: see `Filters`.
        depth_before, depth_after: see `ObjectDataModule` (Splatter Image: 2 and 2, for masked objects; not stated by
            the paper for full images).
        **settings: of `ObjectDataModule`.
    """

    record = ""
    """Name of the file in a sequence's folder that tells the mode of its images, in data with hidden modes."""

    chances: ClassVar[Mapping[str, float]] = {}
    """Probabilities of all modes by name, for sequences whose record gives none. Empty: the data have no modes."""

    def __init__(
        self,
        root: str,
        category: str | Sequence[str],
        subset: str | None = "fewview_dev",
        allow_shared_sequences: bool = False,
        val_fraction: Share = 0.05,
        test_fraction: Share = 0.1,
        split_seed: Natural = 0,
        min_frames: Annotated[int, Range(2)] = 2,
        min_viewpoint_quality: float | None = None,
        min_point_cloud_quality: float | None = None,
        most_training_sequences: Positive | None = None,
        depth_before: float = 1.5,
        depth_after: float = 4.0,
        **settings: Any,
    ) -> None:
        super().__init__(root, depth_before=depth_before, depth_after=depth_after, **settings)
        self.categories = [category] if isinstance(category, str) else sorted(category)
        if not self.categories or len(set(self.categories)) < len(self.categories):
            raise CompleteSplatError(f"data.category=[{','.join(self.categories)}]: must name each category once")
        self.category = ",".join(self.categories)
        self.subset = subset
        self.allow_shared_sequences = allow_shared_sequences
        self.seeded = SeededSplit(val_fraction, test_fraction, split_seed)
        self.filters = Filters(min_frames, min_viewpoint_quality, min_point_cloud_quality, most_training_sequences)

    def describe(self) -> dict[str, str | None]:
        return {
            "data_set": f"co3d/{self.category}",
            "subset": self.subset,
            "split": self._split(),
            **self.described_views("a sequence's first frame"),
        }

    def _split(self) -> str:
        """Describe in words how sequences are split."""
        val, test, seed = self.seeded
        if self.subset is None:
            return f"by seed {seed}: {val:g} of the sequences for validation, {test:g} for the test"
        if self.allow_shared_sequences:
            return "of the set list, shared sequences allowed"
        return f"of the set list; where it validates nothing, {val:g} of training validates, by seed {seed}"

    def packed_settings(self) -> dict[str, Scalar]:
        settings: dict[str, Scalar] = {
            "category": self.category,
            "subset": self.subset,
            "allow_shared_sequences": self.allow_shared_sequences,
        }
        for part in (self.seeded, self.filters, self.framing):
            settings.update(part._asdict())
        return settings

    def open(self, split: str) -> Mapping[str, CO3DSource]:
        """Open all splits at once, because they share the annotations. Sequences without images are left out.

        Raises:
            DataError: more sequences have no images than `max_bad_fraction` allows; else as `read_categories`.
        """
        splits, files, refused = read_categories(
            self.root, self.categories, self.subset, self.seeded, self.filters, self.allow_shared_sequences
        )
        first = {name: frames[0].image for split in splits.values() for name, frames in split.frames.items()}
        absent = {name for name, image in first.items() if not os.path.isdir(image.parent)}
        most = 0.0 if self.tolerance.on_bad == "raise" else self.tolerance.max_bad_fraction
        if len(absent) > most * len(first):
            counted = f"{len(absent)} of {len(first)} sequences have no images, as after a partial download"
            folder = self.root / self.categories[0] if len(self.categories) == 1 else self.root
            raise DataError(f"{counted}; data.max_bad_fraction=1 uses the others", str(folder))
        splits = {split: members.without(absent, "not downloaded") for split, members in splits.items()}
        return {name: CO3DSource(members, self.framing, files, refused) for name, members in splits.items()}

    def hidden_modes(self, views: int, spread_views: int) -> HiddenModeScenes:
        """Return the test scenes with the modes that were written beside their images.

        Raises:
            MissingFile: no test scene has images of its modes.
            CompleteSplatError: the data set has no hidden modes.
        """
        if not self.chances:
            return super().hidden_modes(views, spread_views)
        store = self.store("test")
        folder = self.root / self.category
        first = next(iter(self.chances))
        if not any((folder / name / first).is_dir() for name in store.names):
            advice = "data toy writes those of test scenes, data render all with hidden=modes; prepared data have none"
            raise MissingFile(f"no test scene has images in each mode, such as {first}: {advice}", str(folder))
        source = store.source
        assert isinstance(source, CO3DSource)
        modes = {mode: replace(store, source=source.with_images(partial(in_mode, mode=mode))) for mode in self.chances}
        return HiddenModeScenes(store, modes, partial(self._record_of, folder), self.chances, views, spread_views)

    def _record_of(self, folder: Path, name: str) -> Path:
        return folder / name / self.record
