"""Damaged CO3D trees: each damage at the source, and one of each kind of error through the data module and its policy.

Bad pictures and bad annotations are read one by one by `test_bad_images` and `test_bad_annotations`.
"""

import shutil
from pathlib import Path

import pytest
from bad_annotations import BAD_ENTRIES, BAD_FILES, BAD_FRAMES, CONSEQUENCES, WITHOUT
from bad_images import BAD_DEPTHS, BAD_IMAGES
from bad_inputs import (
    ITEMS,
    Seen,
    count_readings,
    epoch,
    intact_pictures,
    module,
    one_of_each_kind,
    read_whole,
    write_three,
)
from bad_trees import OF_A_FRAME, OF_A_SEQUENCE, OF_ALL, Damage
from co3d_trees import CATEGORY, FRAMES, SEQUENCES, SET_LIST, change

from completesplat.data.validation import BadAnnotation, BadPicture
from completesplat.errors import CompleteSplatError, DataError

POLICIES = pytest.mark.parametrize("policy", ["raise", "skip"])
DAMAGES = {name: (damage, kind, file, 1) for name, (damage, kind, file) in OF_A_FRAME.items()} | OF_A_SEQUENCE
ALL = {(name, number) for name in "ab" for number in (0, 1)}


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[bytes, Seen]]:
    """A tree of sequences of two frames, which are both in each of their scenes, and its pictures."""
    root = tmp_path_factory.mktemp("intact")
    write_three(root, 2)
    return root, intact_pictures(root)


@pytest.fixture
def four_frames(tmp_path: Path) -> tuple[Path, dict[bytes, Seen]]:
    """A category whose sequences have four frames, which are all in each of their scenes, and its pictures."""
    category = write_three(tmp_path, 4)
    return category, intact_pictures(tmp_path)


@pytest.fixture
def category(intact: tuple[Path, dict[bytes, Seen]], tmp_path: Path) -> Path:
    shutil.copytree(intact[0], tmp_path / "root")
    return tmp_path / "root" / CATEGORY


def refusals(category: Path, pictures: dict[bytes, Seen], policy: str) -> list[DataError]:
    """Training's, whose sequence a is refused whenever it is read, and nothing else."""
    data = module(category.parent, policy)
    data.setup("fit")
    assert data.source("train").refused == []
    readings, loader = count_readings(data), data.train_dataloader()
    if policy == "raise":
        with pytest.raises(DataError) as caught:
            list(loader)
        return [caught.value]
    for number in (0, 1):
        readings.clear()
        assert {name for name, _ in epoch(loader, pictures, number)} == {"b"}
        # Its own items come every epoch; what is drawn in their place may be others of them.
        assert len(loader.refused) == readings["a"] >= ITEMS
    return loader.refused


# One that is no picture; those that depend on what is annotated, and on what a mask is.
@POLICIES
@pytest.mark.parametrize("name", ["cut_png", "other_size", "coloured_mask"])
def test_a_bad_picture_never_gets_into_a_batch(name, policy, category, intact):
    make, mode, part = BAD_IMAGES[name]
    file = category / "a" / ("images" if mode == "RGB" else "masks") / "frame000002.png"
    file.write_bytes(make())
    for error in refusals(category, intact[1], policy):
        assert (type(error), error.file, error.sequence, error.frame) == (BadPicture, str(file), "a", 1)
        assert part in error.reason


@POLICIES
@pytest.mark.parametrize("name", ["negative", "zero_scale"])
def test_a_bad_depth_map_leaves_a_sequence_without_a_cloud_out(name, policy, category, intact):
    make, scale, part = BAD_DEPTHS[name]
    file = category / "a/depths/frame000002.png"
    file.write_bytes(make())
    change(category / FRAMES, lambda entries: entries[1]["depth"].update(scale_adjustment=scale))
    change(category / SEQUENCES, lambda entries: entries[0].update(point_cloud=None))
    for error in refusals(category, intact[1], policy):
        assert (type(error), error.file, error.sequence, error.frame) == (BadPicture, str(file), "a", 1)
        assert part in error.reason


def test_a_bad_depth_map_is_not_looked_at_where_there_is_a_point_cloud(category, intact):
    (category / "a/depths/frame000002.png").write_text("depth")
    assert set(epoch(module(category.parent, "raise").train_dataloader(), intact[1])) == ALL


def annotated(category: Path, policy: str, pictures: dict[bytes, Seen], gone: set[Seen]) -> list[DataError]:
    """What `setup` raises or leaves out, of a tree of four frames a sequence; training sees everything but that."""
    data = module(category.parent, policy, targets=3, references_per_sequence=1)
    if policy == "raise":
        with pytest.raises(DataError) as caught:
            data.setup("fit")
        return [caught.value]
    data.setup("fit")
    loader = data.train_dataloader()
    assert set(epoch(loader, pictures)) == {(name, number) for name in "ab" for number in range(4)} - gone
    # Nothing is refused on the way: what is broken is known before.
    assert loader.refused == []
    return data.source("train").refused


@POLICIES
@pytest.mark.parametrize("name", one_of_each_kind(BAD_FRAMES, 1))
def test_a_bad_frame_never_gets_into_a_batch(name, policy, four_frames):
    category, pictures = four_frames
    edit, kind, _ = BAD_FRAMES[name]
    change(category / FRAMES, edit)
    (error,) = annotated(category, policy, pictures, {("a", 2)})
    assert (type(error), error.file, error.sequence, error.frame) == (kind, str(category / FRAMES), "a", 2)


# A frame without a sequence, a sequence without a name, one that leads outside, and one that takes nothing away.
@POLICIES
@pytest.mark.parametrize("name", ["name_is_a_number", "sequence_without_name", "cloud_outside", "frame_twice"])
def test_a_bad_entry_takes_away_no_more_than_what_it_is_of(name, policy, four_frames):
    category, pictures = four_frames
    file, edit, kind, sequence, frame, _ = BAD_ENTRIES[name]
    change(category / file, edit)
    gone = {("a", number) for number in WITHOUT.get(name, [])}
    error, *others = annotated(category, policy, pictures, gone)
    assert (type(error), error.file, error.sequence, error.frame) == (kind, str(category / file), sequence, frame)
    assert len(others) == (policy == "skip" and name in CONSEQUENCES)


@POLICIES
def test_a_file_that_says_nothing_is_raised_under_either_policy(policy, category):
    file, edit, part = BAD_FILES["frames_are_no_list"]
    change(category / file, edit)
    with pytest.raises(BadAnnotation, match=part) as caught:
        module(category.parent, policy).setup("fit")
    assert caught.value.file == str(category / file)


def damaged(category: Path, name: str) -> tuple[type[DataError], str | None, int | None]:
    """Damage a tree; the kind of the error, its file or nothing if it has another name, and its frame."""
    damage: Damage
    damage, kind, file, frame = DAMAGES[name]
    damage(category)
    return kind, file and str(category / file), frame


def assert_place(error: DataError, kind: type[DataError], file: str | None, frame: int | None) -> None:
    assert (type(error), error.sequence, error.frame) == (kind, "a", frame)
    assert file is None or error.file == file


@pytest.mark.parametrize("name", DAMAGES)
def test_what_is_broken_is_refused_by_the_source_with_its_place(name, category):
    kind, file, frame = damaged(category, name)
    source = module(category.parent, "raise").source("train")
    assert source.refused == []
    with pytest.raises(DataError) as caught:
        read_whole(source, "a")
    assert_place(caught.value, kind, file, frame)
    assert "\n" not in str(caught.value)


@POLICIES
@pytest.mark.parametrize("name", [*one_of_each_kind(OF_A_FRAME, 1), *one_of_each_kind(OF_A_SEQUENCE, 1)])
def test_what_is_broken_never_gets_into_a_batch(name, policy, category, intact):
    kind, file, frame = damaged(category, name)
    for error in refusals(category, intact[1], policy):
        assert_place(error, kind, file, frame)


@pytest.mark.parametrize(
    ("name", "policy"), [(n, "raise") for n in OF_ALL] + [(n, "skip") for n in one_of_each_kind(OF_ALL, 2)]
)
def test_a_set_without_any_use_is_raised_under_either_policy(name, policy, category):
    damage, settings, kind, part = OF_ALL[name]
    damage(category)
    with pytest.raises(kind) as caught:
        module(category.parent, policy, **settings).setup("fit")
    assert type(caught.value) is kind
    assert part in str(caught.value)


@POLICIES
def test_one_sequence_of_one_frame_is_left_out_under_either_policy(policy, category, intact):
    change(category / SET_LIST, lambda splits: splits.update(train=splits["train"][1:]))
    data = module(category.parent, policy)
    assert {sequence for sequence, _ in epoch(data.train_dataloader(), intact[1])} == {"b"}
    assert data.source("train").left_out == {"fewer than 2 frames": ["a"]}
    assert data.source("train").refused == []


def test_evaluation_of_nothing_but_a_bad_sequence_is_no_evaluation(category):
    (category / "c/images/frame000002.png").write_text("picture")
    with pytest.raises(BadPicture):
        list(module(category.parent, "raise").val_dataloader())
    loader = module(category.parent, "skip").val_dataloader()
    with pytest.raises(DataError, match="1 of 1 items cannot be read"):
        list(loader)
    assert [(error.sequence, error.frame) for error in loader.refused] == [("c", 1)]


@pytest.mark.parametrize("workers", [0, 2])
def test_too_large_a_share_of_bad_pictures_ends_training(category, workers):
    (category / "a/images/frame000002.png").write_text("picture")
    data = module(category.parent, "skip", max_bad_fraction=0.1, workers=workers)
    with pytest.raises(DataError, match=r"data\.max_bad_fraction=0\.1"):
        list(data.train_dataloader())


def test_impossible_mask_thresholds_are_refused(tmp_path):
    for threshold in (0, -0.5, 1.5, float("nan"), float("inf")):
        with pytest.raises(CompleteSplatError, match=r"data\.mask_threshold"):
            module(tmp_path, "skip", mask_threshold=threshold)


def test_an_unknown_policy_is_refused(category):
    with pytest.raises(CompleteSplatError, match=r"data\.on_bad=ignore: choose one of skip, raise"):
        module(category.parent, "ignore").train_dataloader()


def test_the_catalogues_are_complete():
    assert (len(BAD_IMAGES), len(BAD_DEPTHS)) == (46, 13)
    assert (len(BAD_FRAMES), len(BAD_ENTRIES), len(BAD_FILES)) == (49, 22, 5)
    assert (len(OF_A_FRAME), len(OF_A_SEQUENCE), len(OF_ALL)) == (9, 18, 18)
