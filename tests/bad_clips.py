"""RealEstate10K clips that must not reach a batch, and how a tree with one of them among intact ones is read."""

import shutil
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
from bad_images import png
from bad_inputs import read_whole
from realestate10k_trees import StoredClip, assert_refusal, encode, equal, make_clip, module, same

from completesplat.data.realestate10k.module import RE10KDataModule
from completesplat.data.validation import BadAnnotation, BadCamera, BadPicture, TooFewFrames
from completesplat.errors import DataError
from completesplat.scene import SceneBatch

BAD, INTACT, HELD_OUT = "bad", ("one", "three"), "two"
# Four frames, so that each scene of four views shows all of them.
CLIPS = [make_clip(key, frames=4) for key in (BAD, *INTACT, HELD_OUT)]
GIF = encode(np.zeros((18, 32, 3), dtype=np.uint8), "GIF")
SETTINGS = {
    **{"targets": 3, "max_gap": 30, "batch_size": 1, "evaluation_batch_size": 1},
    **{"references_per_sequence": 2, "val_fraction": 0.0},
}


def entry(row: int, column: int | slice, value: float) -> Callable[[StoredClip], object]:
    return lambda clip: clip.rows[row].__setitem__(column, value)


def picture(frame: int, make: Callable[[bytes], bytes]) -> Callable[[StoredClip], object]:
    return lambda clip: clip.pictures.__setitem__(frame, make(clip.pictures[frame]))


def mirrored(clip: StoredClip) -> None:
    clip.rows[2, 6:10] *= -1


def first_only(clip: StoredClip) -> None:
    clip.timestamps, clip.rows, clip.pictures = clip.timestamps[:1], clip.rows[:1], clip.pictures[:1]


# name: (change, kind, frame), in whichever form a clip is stored.
BAD_CLIPS: dict[str, tuple[Callable[[StoredClip], object], type[DataError], int | None]] = {
    "nan_in_a_pose": (entry(2, 9, np.nan), BadAnnotation, 2),
    "infinite_translation": (entry(1, 13, np.inf), BadAnnotation, 1),
    "infinite_focal_length": (entry(3, 0, np.inf), BadAnnotation, 3),
    "nan_principal_point": (entry(0, 2, np.nan), BadAnnotation, 0),
    "reflection": (mirrored, BadCamera, 2),
    "sheared_rotation": (entry(2, 6, 1.5), BadCamera, 2),
    "zero_pose": (entry(3, slice(6, 18), 0), BadCamera, 3),
    "zero_focal_length": (entry(3, 1, 0), BadCamera, 3),
    "negative_focal_length": (entry(1, 0, -0.5), BadCamera, 1),
    "lens_distortion": (entry(2, 4, 0.1), BadCamera, 2),
    "one_frame": (first_only, TooFewFrames, None),
    "cut_jpeg": (picture(2, lambda data: data[: len(data) // 2]), BadPicture, 2),
    "html_instead_of_a_picture": (picture(1, lambda data: b"<html>404</html>"), BadPicture, 1),
    "html_instead_of_the_first_picture": (picture(0, lambda data: b"<html>404</html>"), BadPicture, 0),
    "gif_instead_of_jpeg": (picture(3, lambda data: GIF), BadPicture, 3),
    "empty_picture": (picture(2, lambda data: b""), BadPicture, 2),
    "empty_first_picture": (picture(0, lambda data: b""), BadPicture, 0),
    "another_size_in_the_middle": (picture(2, lambda data: make_clip("x", size=(32, 18)).pictures[0]), BadPicture, 2),
    "bomb_of_144_megapixels": (picture(0, lambda data: png(12000, 12000, (b"IDAT", b""))), BadPicture, 0),
    "cut_header_of_the_first_picture": (picture(0, lambda data: png(32, 18, (b"pHYs", b""))), BadPicture, 0),
}


def changed(change: Callable[[StoredClip], object]) -> list[StoredClip]:
    """The clips with one that is broken."""
    clip = make_clip(BAD, frames=4)
    change(clip)
    return [clip, *CLIPS[1:]]


def read_tree(folder: Path, policy: str, **settings) -> RE10KDataModule:
    """The clips of a folder, for training and as the test split."""
    shutil.copytree(folder, folder.with_name("test"), symlinks=True)
    return module(folder.parent, **{**SETTINGS, "on_bad": policy, "max_bad_fraction": 10.0, **settings})


def count_readings(data: RE10KDataModule) -> Counter[str]:
    """From now on, how often each training clip is asked for."""
    source, counted = data.source("train"), Counter()
    read = source.read

    def counting(name: str):
        counted[name] += 1
        return read(name)

    source.read = counting
    return counted


def assert_intact(batch: SceneBatch, intact: RE10KDataModule) -> None:
    """A batch of one scene is what the intact tree gives for the frames that it shows."""
    store, (name,) = intact.store("train"), batch.names
    sequence = store.source.read(name)
    pictures = [store.image(sequence, frame) / 255 for frame in range(len(sequence.frames))]
    views = [next(f for f, p in enumerate(pictures) if torch.equal(p, image)) for image in batch.all_views().images[0]]
    assert same(batch[0], store.scene(sequence, views[0], views[1:]))


def check_source(folder: Path, kind: type[DataError], file: Path, frame: int | None, **settings) -> None:
    """The broken clip is refused with its place by the source of these training clips, and the others are not."""
    source = module(folder.parent, **{**SETTINGS, **settings}).source("train")
    assert source.refused == []
    with pytest.raises(DataError) as caught:
        read_whole(source, BAD)
    assert_refusal(caught.value, kind, file, BAD, frame)
    for name in INTACT:
        read_whole(source, name)


def check_policies(
    folder: Path, policy: str, intact: RE10KDataModule, kind: type[DataError], file: Path, frame: int | None, **settings
) -> None:
    """One clip is broken: it is raised with its place, or an epoch has everything else, counted exactly.

    Args:
        folder: the training clips.
        file: in that folder.
    """
    data = read_tree(folder, policy, **settings)
    test_file = folder.with_name("test") / file.relative_to(folder)
    readings, train, test = count_readings(data), data.train_dataloader(), data.test_dataloader()
    if policy == "raise":
        for loader, path in ((train, file), (test, test_file)):
            with pytest.raises(DataError) as caught:
                list(loader)
            assert_refusal(caught.value, kind, path, BAD, frame)
        return
    batches = list(train)
    assert len(batches) == len(train) == 6
    assert {name for batch in batches for name in batch.names} == set(INTACT)
    for batch in batches:
        assert_intact(batch, intact)
    assert len(train.refused) == readings[BAD] >= 2
    for error in train.refused:
        assert_refusal(error, kind, file, BAD, frame)
    assert equal(list(test), [batch for batch in intact.test_dataloader() if BAD not in batch.names])
    (error,) = test.refused
    assert_refusal(error, kind, test_file, BAD, frame)
