"""Everything else that is broken in a CO3D tree, through the whole data module, under both policies.

45 cases by name: 9 files that a frame cannot do without, 18 sequences that cannot be placed, 18 sets without any use.
"""

import shutil
from pathlib import Path

import pytest
from bad_inputs import ITEMS, Seen, count_readings, epoch, intact_pictures, module, write_three
from bad_trees import OF_A_FRAME, OF_A_SEQUENCE, OF_ALL
from co3d_trees import CATEGORY, SET_LIST, change

from completesplat.errors import CompleteSplatError, DataError


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[bytes, Seen]]:
    """A tree of sequences of two frames, which are both in each of their scenes, and its pictures."""
    root = tmp_path_factory.mktemp("intact")
    write_three(root, 2)
    return root, intact_pictures(root)


@pytest.fixture
def category(intact: tuple[Path, dict[bytes, Seen]], tmp_path: Path) -> Path:
    shutil.copytree(intact[0], tmp_path / "root")
    return tmp_path / "root" / CATEGORY


@pytest.mark.parametrize("policy", ["raise", "skip"])
@pytest.mark.parametrize("name", [*OF_A_FRAME, *OF_A_SEQUENCE])
def test_what_is_broken_never_gets_into_a_batch(name, policy, category, intact):
    damage, kind, file, frame = OF_A_SEQUENCE[name] if name in OF_A_SEQUENCE else (*OF_A_FRAME[name], 1)
    damage(category)
    data = module(category.parent, policy)
    data.setup("fit")
    assert data.source("train").refused == []
    readings, loader = count_readings(data), data.train_dataloader()
    if policy == "raise":
        with pytest.raises(DataError) as caught:
            list(loader)
        refused = [caught.value]
    else:
        assert {sequence for sequence, _ in epoch(loader, intact[1])} == {"b"}
        assert len(loader.refused) == readings["a"] >= ITEMS
        refused = loader.refused
    for error in refused:
        assert (type(error), error.sequence, error.frame) == (kind, "a", frame)
        assert file is None or error.file == str(category / file)


@pytest.mark.parametrize("policy", ["raise", "skip"])
@pytest.mark.parametrize("name", OF_ALL)
def test_a_set_without_any_use_is_raised_under_either_policy(name, policy, category):
    damage, settings, kind, part = OF_ALL[name]
    damage(category)
    with pytest.raises(kind) as caught:
        module(category.parent, policy, **settings).setup("fit")
    assert type(caught.value) is kind
    assert part in str(caught.value)


@pytest.mark.parametrize("policy", ["raise", "skip"])
def test_one_sequence_of_one_frame_is_left_out_under_either_policy(policy, category, intact):
    change(category / SET_LIST, lambda splits: splits.update(train=splits["train"][1:]))
    data = module(category.parent, policy)
    assert {sequence for sequence, _ in epoch(data.train_dataloader(), intact[1])} == {"b"}
    assert data.source("train").left_out == {"fewer than 2 frames": ["a"]}
    assert data.source("train").refused == []


@pytest.mark.parametrize("threshold", [0, -0.5, 1.5, float("nan"), float("inf")])
def test_impossible_mask_thresholds_are_refused(threshold, tmp_path):
    with pytest.raises(CompleteSplatError, match=r"data\.mask_threshold"):
        module(tmp_path, "skip", mask_threshold=threshold)


def test_an_unknown_policy_is_refused(category):
    with pytest.raises(CompleteSplatError, match=r"data\.on_bad=ignore: choose one of skip, raise"):
        module(category.parent, "ignore").train_dataloader()


def test_the_catalogues_are_complete():
    assert (len(OF_A_FRAME), len(OF_A_SEQUENCE), len(OF_ALL)) == (9, 18, 18)
