"""How damaged CO3D trees are read: what training saw of them, and what was counted as broken."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from co3d_trees import CATEGORY, SUBSET, write_tree

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.loading.loader import SceneLoader
from completesplat.data.sequences import SPLITS, PosedSequence, SequenceSource
from completesplat.data.validation import at
from completesplat.scene import SceneBatch

ITEMS = 4  # of a sequence in an epoch
Seen = tuple[str, int]  # sequence, number of the frame


def one_of_each_kind(catalogue: Mapping[str, tuple], position: int) -> list[str]:
    """The first case of each class of error, which a case has at this position."""
    names: dict[type, str] = {}
    for name, case in catalogue.items():
        names.setdefault(case[position], name)
    return list(names.values())


def read_whole(source: SequenceSource, name: str) -> None:
    """Read a sequence and all of its pictures; refusals say where they happened, as a loader's do."""
    with at(sequence=name):
        sequence = source.read(name)
        for index, number in enumerate(sequence.frames):
            with at(frame=number):
                sequence.read(index)


def write_three(root: Path, frames: int) -> Path:
    """Training sequences a and b, c for validation, d for testing; returns the category's folder."""
    return write_tree(root, dict.fromkeys("abcd", frames), {"train": "ab", "val": "c", "test": "d"})


def module(root: Path, on_bad: str, category: str = CATEGORY, **settings: Any) -> CO3DDataModule:
    """Small pictures, one scene in a batch, and no limit on what is skipped."""
    defaults = {
        "image_size": 8,
        "batch_size": 1,
        "targets": 1,
        "references_per_sequence": ITEMS,
        "max_bad_fraction": 10.0,
    }
    return CO3DDataModule(str(root), category, **{"subset": SUBSET, "on_bad": on_bad, **defaults, **settings})


def picture_key(image: torch.Tensor) -> bytes:
    return (255 * image).round().to(torch.uint8).numpy().tobytes()


def intact_pictures(root: Path) -> dict[bytes, Seen]:
    """All pictures of a tree that nothing is wrong with; no two are alike."""
    data, found = module(root, "raise"), {}
    for split in SPLITS:
        for name in data.source(split).names:
            sequence = data.source(split).read(name)
            for index, number in enumerate(sequence.frames):
                found[picture_key(sequence.read(index).image / 255)] = name, number
    return found


def frames_of(batch: SceneBatch, intact: dict[bytes, Seen]) -> list[Seen]:
    """Which frames a batch of one scene shows: every picture is exactly one of the intact ones, of this sequence."""
    views = batch.all_views()
    assert all(t.isfinite().all() for t in (views.masks, views.cameras.world_to_camera, batch.depth_range))
    seen = [intact[picture_key(image)] for image in views.images[0]]
    assert {(sequence,) for sequence, _ in seen} == {batch.names}
    return seen


def epoch(loader: SceneLoader, intact: dict[bytes, Seen], number: int = 0) -> list[Seen]:
    """The frames that an epoch of training shows. It has all of its scenes, whatever is broken."""
    assert loader.sampler is not None
    loader.sampler.set_epoch(number)
    scenes = [frames_of(batch, intact) for batch in loader]
    assert len(scenes) == len(loader) == len(loader.dataset)
    return [frame for frames in scenes for frame in frames]


def count_readings(data: CO3DDataModule, split: str = "train") -> Counter[str]:
    """From now on, how often each sequence is asked for."""
    source, counted = data.source(split), Counter[str]()
    read = source.read

    def counting(name: str) -> PosedSequence:
        counted[name] += 1
        return read(name)

    source.read = counting  # type: ignore[method-assign]
    return counted
