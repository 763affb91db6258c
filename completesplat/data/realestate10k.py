"""RealEstate10K (Zhou et al., SIGGRAPH 2018) as a data module."""

from collections.abc import Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from completesplat.data.checks import BadAnnotation, require_file
from completesplat.data.module import SceneDataModule
from completesplat.data.realestate10k_evaluation import (
    ChosenSource,
    EvaluationIndex,
    choose_clips,
    log_choice,
    read_index,
    read_keys,
)
from completesplat.data.realestate10k_source import CROPS, Framing, RE10KSource, open_clips
from completesplat.data.scenes import Choice, EvaluationScenes
from completesplat.data.sequences import PosedSequence, SequenceSource
from completesplat.data.splits import split_by_hash
from completesplat.data.view_selection import evaluation_views_within, nearby_views
from completesplat.errors import CompleteSplatError
from completesplat.weights_files import sha256_of


class RE10KDataModule(SceneDataModule):
    """Scenes of room tours.

    `root` has the folders `train` and `test`, either with texts and frames as published (`realestate10k_text`) or with
    pixelSplat's chunks (`realestate10k_chunks`), or is prepared. Training draws a random reference and random targets
    near it. Clips are checked when they are read. Each loading process has at most two chunks in memory.

    Args:
        min_gap, max_gap: frames between the reference and a training target, either way (Flash3D: at most 30).
        evaluation_targets, evaluation_gap: validation and test take a clip's first frame as the reference and so many
            evenly spaced targets among the next `evaluation_gap` frames.
        evaluation_index: a file of test views, instead of that rule: in the format of pixelSplat, MVSplat360,
            latentSplat or Flash3D (`read_index`).
        scene_list: a file with the keys of the clips to test, one a line.
        crop: "center": the largest central square (DFM); "principal": the largest one around the principal point.
        near, far: depth range in the clips' units (DFM, `data_io/realestate10k.py:55-56`; not stated by the paper).
        scale: all lengths, near and far included, are multiplied by this.
        val_fraction: share of `train` that is held out for validation, at least one clip, chosen by key and `val_seed`.
        **settings: of `SceneDataModule`.
    """

    def __init__(
        self,
        root: str,
        min_gap: int = 1,
        max_gap: int = 30,
        evaluation_targets: int = 3,
        evaluation_gap: int = 30,
        evaluation_index: str | None = None,
        scene_list: str | None = None,
        crop: str = "center",
        near: float = 0.7,
        far: float = 10.0,
        scale: float = 1.0,
        val_fraction: float = 0.02,
        val_seed: int = 0,
        **settings: Any,
    ) -> None:
        super().__init__(root, **settings)
        if not 1 <= min_gap <= max_gap or evaluation_gap < 1:
            raise CompleteSplatError("data: needs 1 <= min_gap <= max_gap and 1 <= evaluation_gap")
        if not 0 < near < far or not scale > 0:
            raise CompleteSplatError("data: needs 0 < near < far and 0 < scale")
        if crop not in CROPS:
            raise CompleteSplatError(f"data.crop={crop}: choose one of {', '.join(CROPS)}")
        self.gaps = min_gap, max_gap
        self.evaluation = evaluation_targets, evaluation_gap
        self.evaluation_index = Path(evaluation_index) if evaluation_index else None
        self.scene_list = Path(scene_list) if scene_list else None
        self.framing = Framing(self.image_size, crop, scale, near, far)
        self.val_fraction = val_fraction
        self.val_seed = val_seed
        self._test_views: dict[str, Choice] | None = None

    @cached_property
    def index(self) -> EvaluationIndex | None:
        """The content of `evaluation_index`.

        Raises:
            DataError: it is missing or malformed.
        """
        return None if self.evaluation_index is None else read_index(self.evaluation_index)

    def describe(self) -> dict[str, str]:
        """See `SceneDataModule`; a list that decides is named, with the work whose format it has and its checksum."""
        count, gap = self.evaluation
        views = f"reference: first frame; {count} targets within {gap} frames"
        if self.index is not None:
            views = f"those of {_identity(self.evaluation_index, self.index.form)}"
        listed = "" if self.scene_list is None else f"; scenes of {_identity(self.scene_list)}"
        return {
            "data_set": "realestate10k",
            "crop": f"largest square, {self.framing.crop}",
            "protocol_views": views + listed,
        }

    def prepared_settings(self) -> dict[str, Any]:
        """See `SceneDataModule`."""
        return {**vars(self.framing), "val_fraction": self.val_fraction, "val_seed": self.val_seed}

    def open(self, split: str) -> Mapping[str, RE10KSource]:
        """The test clips; or the clips of the folder `train`, which training and validation share."""
        if split == "test":
            clips = open_clips(self.root / "test")
            return {"test": RE10KSource(clips, clips.keys, self.framing)}
        clips = open_clips(self.root / "train")
        train, val = split_by_hash(clips.keys, self.val_fraction, self.val_seed)
        # Both read through the same two chunks.
        return {"train": RE10KSource(clips, train, self.framing), "val": RE10KSource(clips, val, self.framing)}

    def evaluated(self, split: str, source: SequenceSource) -> SequenceSource:
        """Of the test clips those that the evaluation index and the list of scenes name."""
        if split != "test":
            return source
        listed = None if self.scene_list is None else read_keys(self.scene_list)
        chosen = choose_clips(source.names, self.index, listed)
        log_choice(chosen)
        self._test_views = chosen.views
        return ChosenSource(source, chosen)

    def stackable(self, scenes: EvaluationScenes) -> bool:
        """Known from the evaluation index; reading all clips for it would take hours."""
        views = self._test_views or {}
        return len({len(views[name][1]) for name in scenes.store.names if name in views}) <= 1

    def training_views(self, frames: int, rng: np.random.Generator) -> Choice:
        """A random reference and random targets near it."""
        return nearby_views(frames, self.targets, *self.gaps, rng)

    def evaluation_views(self, sequence: PosedSequence, split: str) -> Choice:
        """The views of the evaluation index; without one, the first frame and some that follow it."""
        if self._test_views is None or sequence.name not in self._test_views:
            return evaluation_views_within(len(sequence.frames), *self.evaluation)
        reference, targets = self._test_views[sequence.name]
        position = {frame: view for view, frame in enumerate(sequence.frames)}
        for frame in (reference, *targets):
            if frame not in position:
                raise BadAnnotation("the frame is in the evaluation index, not in the data", None, sequence.name, frame)
        return position[reference], [position[frame] for frame in targets]


def _identity(path: Path | None, *said: str) -> str:
    """A file's name and content, wherever it lies."""
    assert path is not None
    return f"{path.name} ({', '.join([*said, f'SHA-256 {sha256_of(require_file(path))[:12]}'])})"
