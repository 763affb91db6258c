"""Data module of RealEstate10K, whose clips become posed sequences."""

from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.loading.scenes import EvaluationScenes
from completesplat.data.loading.view_selection import Choice, ClipViews, GrowingGap
from completesplat.data.packed.manifest import Scalar
from completesplat.data.realestate10k.clips import ChunkedClips, Clip, TextClips
from completesplat.data.realestate10k.evaluation_index import EvaluationIndex, choose_clips, read_index, read_keys
from completesplat.data.sequences import MaskedImage, PosedSequence, SequenceSource
from completesplat.data.splits import split_by_hash
from completesplat.data.validation import require_file
from completesplat.errors import CompleteSplatError, DataError, errors_at, refused_to
from completesplat.geometry.cameras import crop_resize
from completesplat.photo.crop import Square, principal_square
from completesplat.quantities import Natural, Positive, Share
from completesplat.tensors import stack
from completesplat.weights import sha256_of

Clips = TextClips | ChunkedClips


class ClipFraming(NamedTuple):
    """Settings of images and cameras, which `RE10KDataModule` explains."""

    image_size: int
    crop: str
    scale: float
    near: float
    far: float


def open_clips(folder: Path) -> Clips:
    """Open the clips of a split's folder, as chunks if it has an `index.json`, else as text files."""
    if (folder / "index.json").is_file():
        return ChunkedClips(folder)
    if folder.is_dir() and any(folder.glob("*.txt")):
        return TextClips(folder)
    raise DataError("no RealEstate10K clips there: neither index.json (with *.torch) nor *.txt", str(folder))


class RE10KSource(SequenceSource):
    """Some clips of one folder. Several sources may share `clips`."""

    def __init__(self, clips: Clips, names: list[str], framing: ClipFraming) -> None:
        left_out = {"frames are missing": clips.missing} if clips.missing else {}
        super().__init__(names, len(names) + len(clips.missing), clips.refused, left_out)
        self.framing = framing
        self._clips = clips

    def groups(self, names: Sequence[str]) -> list[list[int]]:
        return self._clips.chunks(names)

    def fingerprint(self) -> str:
        """Return the SHA-256 of the files that list the clips, not of the images."""
        return self._clips.fingerprint()

    def read(self, name: str) -> PosedSequence:
        """Read one clip's cameras. `PosedSequence.read` reads its images."""
        clip = self._clips.clip(name)
        framing = self.framing
        count = len(clip.images)
        squares = [_square(clip, framing.crop, frame) for frame in range(count)]
        if len(set(squares)) == 1:
            cameras = crop_resize(clip.cameras, *squares[0], framing.image_size)
        else:
            cameras = stack([crop_resize(clip.cameras[i], *squares[i], framing.image_size) for i in range(count)])
        cameras = cameras.scale_world(torch.tensor(framing.scale, dtype=torch.float64))
        depth_range = torch.tensor([framing.near * framing.scale, framing.far * framing.scale])
        read = partial(_read, clip, squares, framing.image_size)
        return PosedSequence(name, tuple(range(count)), cameras, depth_range.repeat(count, 1), read)


def _square(clip: Clip, crop: str, frame: int) -> Square:
    height, width = clip.cameras.image_size
    with errors_at(clip.source, clip.key, frame):
        x = width / 2
        y = height / 2
        if crop == "principal":
            x, y = clip.cameras.intrinsics[frame, :2, 2].tolist()
        return principal_square((x, y), (height, width))


def _read(clip: Clip, squares: list[Square], size: int, index: int) -> MaskedImage:
    with errors_at(clip.source, clip.key, index):
        return MaskedImage(clip.read(index, squares[index], size), None)


class RE10KDataModule(SceneDataModule):
    """Scenes of room tours.

    `root` is prepared, or has folders `train` and `test` with text files and frames as published or with
    pixelSplat's chunks. Training draws a random reference and random targets near it.
    Clips are checked when they are read. Each loading process has at most two chunks in memory.

    Args:
        min_gap, max_gap: smallest and largest distance in frames, in both directions, from the reference to a training
            target; `max_gap` may grow from epoch to epoch (`GrowingGap`).
        evaluation_targets, evaluation_gap: validation and test take a clip's first frame as the reference and
            `evaluation_targets` evenly spaced targets. The last target is `evaluation_gap` frames away (None: the final
            `max_gap`), or it is the clip's last frame.
        evaluation_index: file of test views that replaces this rule, in the format of pixelSplat, MVSplat360,
            latentSplat or Flash3D (`read_index`).
        scene_list: file with the keys of the clips to test, one a line.
        crop: "center": the largest central square (DFM); "principal": the largest square around the principal point.
        near, far: depth range in the clips' units (DFM, `data_io/realestate10k.py:55-56`; not stated by the paper).
        scale: factor of all lengths, including near and far.
        val_fraction: share of `train` that is held out for validation, at least one clip, chosen by key and `val_seed`.
        **settings: of `SceneDataModule`.
    """

    def __init__(
        self,
        root: str,
        min_gap: int = 1,
        max_gap: int | Mapping[str, int] = 150,
        evaluation_targets: Positive = 3,
        evaluation_gap: Positive | None = None,
        evaluation_index: str | None = None,
        scene_list: str | None = None,
        crop: Literal["center", "principal"] = "center",
        near: float = 0.7,
        far: float = 10.0,
        scale: float = 1.0,
        val_fraction: Share = 0.02,
        val_seed: Natural = 0,
        **settings: Any,
    ) -> None:
        super().__init__(root, **settings)
        largest = GrowingGap(max_gap, max_gap, 0) if isinstance(max_gap, int) else GrowingGap(**max_gap)
        self.views = ClipViews(min_gap, largest, evaluation_targets, evaluation_gap or largest.last)
        if not 0 < near < far or not scale > 0:
            raise CompleteSplatError("data: needs 0 < near < far and 0 < scale")
        self.evaluation_index = Path(evaluation_index) if evaluation_index else None
        self.scene_list = Path(scene_list) if scene_list else None
        self.framing = ClipFraming(self.image_size, crop, scale, near, far)
        self.val_fraction = val_fraction
        self.val_seed = val_seed
        self._test_views: dict[str, Choice] = {}

    @cached_property
    def index(self) -> EvaluationIndex | None:
        """Content of the file `evaluation_index`."""
        return None if self.evaluation_index is None else read_index(self.evaluation_index)

    def describe(self) -> dict[str, str]:
        """Return facts for results, in which a file is named by its checksum, and an index also by its format."""
        facts = {
            "data_set": "realestate10k",
            "crop": f"largest square, {self.framing.crop}",
            "protocol_views": self.views.described(),
        }
        if self.index is not None and self.evaluation_index is not None:
            checksum = _checksum(self.evaluation_index)
            facts["protocol_views"] = f"index in {self.index.form}'s format, SHA-256 {checksum}"
        if self.scene_list is not None:
            facts["scene_list"] = f"SHA-256 {_checksum(self.scene_list)}"
        return facts

    def packed_settings(self) -> dict[str, Scalar]:
        return {**self.framing._asdict(), "val_fraction": self.val_fraction, "val_seed": self.val_seed}

    def open(self, split: str) -> Mapping[str, RE10KSource]:
        """Open the test clips, or the clips of the folder `train` for both training and validation."""
        if split == "test":
            clips = open_clips(self.root / "test")
            return {"test": RE10KSource(clips, clips.keys, self.framing)}
        clips = open_clips(self.root / "train")
        train, val = split_by_hash(clips.keys, self.val_fraction, self.val_seed)
        # Both sources share the two chunks in memory.
        return {
            "train": RE10KSource(clips, train, self.framing),
            "val": RE10KSource(clips, val, self.framing),
        }

    def select_sequences(self, split: str, source: SequenceSource) -> SequenceSource:
        """Select the test clips that are in the evaluation index and in the scene list."""
        if split != "test":
            return source
        listed = None if self.scene_list is None else read_keys(self.scene_list)
        chosen = choose_clips(source, self.index, listed)
        self._test_views = chosen.views
        return chosen

    def check_test(self) -> None:
        """Read all clips of an evaluation index, chunks as a whole, because clips may lack its frames."""
        if self.index is not None:
            store = self.store("test")
            refused = list[DataError]()
            for name in store.names:
                with refused_to(refused.append, sequence=name):
                    store.source.read(name)
            self.test_dataloader().account(refused, empty=len(refused) == len(store.names))

    def stackable(self, scenes: EvaluationScenes) -> bool:
        """Decide by the evaluation index, because reading all clips would take hours."""
        views = [self._test_views[name] for name in scenes.store.names if name in self._test_views]
        return len({len(targets) for _, targets in views}) <= 1

    def training_views(self, frames: int, epoch: int, rng: np.random.Generator) -> Choice:
        return self.views.training(frames, self.targets, epoch, rng)

    def evaluation_views(self, sequence: PosedSequence, split: str) -> Choice:
        """Return the views of the evaluation index or, without one, the first frame and frames after it."""
        if sequence.name not in self._test_views:
            return self.views.evaluation(len(sequence.frames))
        reference, targets = self._test_views[sequence.name]
        return sequence.frames.index(reference), [sequence.frames.index(frame) for frame in targets]


def _checksum(path: Path) -> str:
    return sha256_of(require_file(path))[:12]
