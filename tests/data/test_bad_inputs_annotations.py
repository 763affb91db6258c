"""Bad annotations through the whole data module: raised by `setup` with their place, or left out and counted.

74 cases by name (47 frames, 22 other entries, 5 whole files), each under both policies.
"""

import shutil
from pathlib import Path

import pytest
from bad_annotations import BAD_ENTRIES, BAD_FILES, BAD_FRAMES
from bad_inputs import Seen, epoch, intact_pictures, module, write_three
from co3d_trees import CATEGORY, FRAMES, change

from completesplat.data.loading.module import SceneDataModule
from completesplat.data.validation import BadAnnotation
from completesplat.errors import DataError

FRAME_CASES, ENTRY_CASES, FILE_CASES = 47, 22, 5
# What else than nothing a bad entry takes away: frame 2 of sequence a, or all of it.
WITHOUT_FRAME = {"frame_without_number", "number_is_text", "number_is_a_fraction", "number_is_true", "name_is_a_number"}
WITHOUT_SEQUENCE = {
    "sequence_without_name", "cloud_without_path", "cloud_is_text", "cloud_outside", "infinite_cloud_quality",
    "quality_is_text", "sequence_not_annotated",
}  # fmt: skip
CONSEQUENCES = {"name_is_a_number", "sequence_without_name"}
ALL = {(name, number) for name in "ab" for number in range(4)}


def test_the_catalogues_are_complete():
    assert (len(BAD_FRAMES), len(BAD_ENTRIES), len(BAD_FILES)) == (FRAME_CASES, ENTRY_CASES, FILE_CASES)
    assert FRAME_CASES + ENTRY_CASES + FILE_CASES >= 30


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[bytes, Seen]]:
    root = tmp_path_factory.mktemp("intact")
    write_three(root, 4)
    return root, intact_pictures(root)


@pytest.fixture
def category(intact: tuple[Path, dict[bytes, Seen]], tmp_path: Path) -> Path:
    shutil.copytree(intact[0], tmp_path, dirs_exist_ok=True)
    return tmp_path / CATEGORY


def refused_by_setup(data: SceneDataModule) -> DataError:
    with pytest.raises(DataError) as caught:
        data.setup("fit")
    return caught.value


def what_training_sees(data: SceneDataModule, pictures: dict[bytes, Seen]) -> set[Seen]:
    """All frames that are used. Nothing is refused on the way: what is broken is known before."""
    loader = data.train_dataloader()
    seen = set(epoch(loader, pictures))
    assert loader.refused == []
    return seen


@pytest.mark.parametrize("policy", ["raise", "skip"])
@pytest.mark.parametrize("name", BAD_FRAMES)
def test_a_bad_frame_never_gets_into_a_batch(name, policy, category, intact):
    edit, kind, part = BAD_FRAMES[name]
    change(category / FRAMES, edit)
    data = module(category.parent, policy, targets=3, references_per_sequence=1)
    if policy == "raise":
        error = refused_by_setup(data)
    else:
        data.setup("fit")
        assert what_training_sees(data, intact[1]) == ALL - {("a", 2)}
        (error,) = data.source("train").refused
    assert (type(error), error.file, error.sequence, error.frame) == (kind, str(category / FRAMES), "a", 2)
    assert part in error.reason


@pytest.mark.parametrize("policy", ["raise", "skip"])
@pytest.mark.parametrize("name", BAD_ENTRIES)
def test_a_bad_entry_takes_away_no_more_than_what_it_is_of(name, policy, category, intact):
    file, edit, kind, sequence, frame, part = BAD_ENTRIES[name]
    change(category / file, edit)
    data = module(category.parent, policy, targets=3, references_per_sequence=1)
    if policy == "raise":
        error = refused_by_setup(data)
    else:
        data.setup("fit")
        gone = {("a", 2)} if name in WITHOUT_FRAME else {f for f in ALL if f[0] == "a" and name in WITHOUT_SEQUENCE}
        assert what_training_sees(data, intact[1]) == ALL - gone
        error, *others = data.source("train").refused
        # Whose entry it was is not known, so what is missing without it is told as well.
        assert len(others) == (name in CONSEQUENCES)
    assert (type(error), error.file, error.sequence, error.frame) == (kind, str(category / file), sequence, frame)
    assert part in error.reason


@pytest.mark.parametrize("policy", ["raise", "skip"])
@pytest.mark.parametrize("name", BAD_FILES)
def test_a_file_that_says_nothing_is_raised_under_either_policy(name, policy, category):
    file, edit, part = BAD_FILES[name]
    change(category / file, edit)
    error = refused_by_setup(module(category.parent, policy))
    assert (type(error), error.file) == (BadAnnotation, str(category / file))
    assert part in error.reason
