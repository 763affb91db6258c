"""Bad pictures, masks and depth maps through the whole data module: raised with their place, or skipped and counted.

59 cases by name (46 pictures and masks, 13 depth maps), each under both policies.
"""

import shutil
from pathlib import Path

import pytest
from bad_images import BAD_DEPTHS, BAD_IMAGES
from bad_inputs import ITEMS, Seen, count_readings, epoch, intact_pictures, module, write_three
from co3d_trees import FRAMES, SEQUENCES, change

from completesplat.data.validation import BadAnnotation, BadPicture
from completesplat.errors import DataError

PICTURES, DEPTHS = 46, 13


def test_the_catalogues_are_complete():
    assert (len(BAD_IMAGES), len(BAD_DEPTHS)) == (PICTURES, DEPTHS)
    assert PICTURES >= 40


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[bytes, Seen]]:
    """A tree of sequences of two frames, which are both in each of their scenes, and its pictures."""
    root = tmp_path_factory.mktemp("intact")
    write_three(root, 2)
    return root, intact_pictures(root)


@pytest.fixture
def category(intact: tuple[Path, dict[bytes, Seen]], tmp_path: Path) -> Path:
    shutil.copytree(intact[0], tmp_path, dirs_exist_ok=True)
    return tmp_path / "things"


def expect(category: Path, pictures: dict[bytes, Seen], policy: str, file: Path, part: str) -> None:
    """Sequence a is refused because of frame 1 whenever it is read, and nothing else."""
    data = module(category.parent, policy)
    data.setup("fit")
    readings, loader = count_readings(data), data.train_dataloader()
    if policy == "raise":
        with pytest.raises(BadPicture) as caught:
            list(loader)
        refused: list[DataError] = [caught.value]
    else:
        for number in (0, 1):
            readings.clear()
            assert {name for name, _ in epoch(loader, pictures, number)} == {"b"}
            # Its own items come every epoch; what is drawn in their place may be others of them.
            assert len(loader.refused) == readings["a"] >= ITEMS
        refused = loader.refused
    for error in refused:
        assert (type(error), error.file, error.sequence, error.frame) == (BadPicture, str(file), "a", 1)
        assert part in error.reason


@pytest.mark.parametrize("policy", ["raise", "skip"])
@pytest.mark.parametrize("name", BAD_IMAGES)
def test_a_bad_picture_never_gets_into_a_batch(name, policy, category, intact):
    make, mode, part = BAD_IMAGES[name]
    file = category / "a" / ("images" if mode == "RGB" else "masks") / "frame000002.png"
    file.write_bytes(make())
    expect(category, intact[1], policy, file, part)


@pytest.mark.parametrize("policy", ["raise", "skip"])
@pytest.mark.parametrize("name", BAD_DEPTHS)
def test_a_bad_depth_map_leaves_a_sequence_without_a_cloud_out(name, policy, category, intact):
    make, scale, part = BAD_DEPTHS[name]
    file = category / "a/depths/frame000002.png"
    file.write_bytes(make())
    change(category / FRAMES, lambda entries: entries[1]["depth"].update(scale_adjustment=scale))
    change(category / SEQUENCES, lambda entries: entries[0].update(point_cloud=None))
    if abs(scale) < float("inf"):
        expect(category, intact[1], policy, file, part)
        return
    # Factors that are no numbers are seen with the annotations; the sequence is left with one frame.
    data = module(category.parent, policy)
    if policy == "raise":
        with pytest.raises(BadAnnotation, match="a, frame 1: scale_adjustment is not finite"):
            data.setup("fit")
    else:
        data.setup("fit")
        assert [(error.sequence, error.frame) for error in data.source("train").refused] == [("a", 1)]
        assert data.source("train").left_out == {"fewer than 2 frames": ["a"]}
        assert {sequence for sequence, _ in epoch(data.train_dataloader(), intact[1])} == {"b"}


def test_a_bad_depth_map_is_not_looked_at_where_there_is_a_point_cloud(category, intact):
    (category / "a/depths/frame000002.png").write_text("depth")
    seen = epoch(module(category.parent, "raise").train_dataloader(), intact[1])
    assert set(seen) == {(name, number) for name in "ab" for number in (0, 1)}


def test_evaluation_of_nothing_but_a_bad_sequence_is_no_evaluation(category, intact):
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
