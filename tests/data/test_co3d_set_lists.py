from pathlib import Path

import pytest
from co3d_trees import CATEGORY, SET_LIST, change, write_tree

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.errors import DataError

COUNTS = dict.fromkeys("abcdefgh", 3)
APART = {"train": "abcdef", "val": "g", "test": "h"}
SHARED = {"train": "abcdef", "val": "", "test": "abcdefgh"}
"""As `set_lists_fewview_train.json`: all of training is tested too (facebookresearch/co3d issue 49)."""


def module(root: Path, **settings) -> CO3DDataModule:
    return CO3DDataModule(str(root), CATEGORY, image_size=8, **settings)


def names(data: CO3DDataModule) -> dict[str, list[str]]:
    return {split: data.source(split).names for split in ("train", "val", "test")}


def test_few_views_of_sequences_never_seen_are_the_default_and_a_split_by_seed_must_be_asked_for(tmp_path):
    """Splatter Image takes `fewview_dev` (`data_preprocessing/preprocess_co3d.py`)."""
    write_tree(tmp_path / "lists", COUNTS, APART)
    data = module(tmp_path / "lists")
    assert names(data) == {split: list(listed) for split, listed in APART.items()}
    assert data.describe()["subset"] == "fewview_dev"
    write_tree(tmp_path / "none", COUNTS, None)
    with pytest.raises(DataError, match=r"data\.subset=null"):
        module(tmp_path / "none").setup("fit")
    by_seed = module(tmp_path / "none", subset=None, batch_size=2, targets=1)
    by_seed.setup("fit")
    assert by_seed.describe()["subset"] is None
    assert "seed 0" in by_seed.describe()["split"]


@pytest.mark.parametrize("on_bad", ["skip", "raise"])
def test_a_list_that_tests_on_training_sequences_is_refused_unless_asked_for(tmp_path, on_bad):
    category = write_tree(tmp_path, COUNTS, SHARED)
    for stage in ("fit", "test"):
        with pytest.raises(DataError, match=r"6 sequences .* a, b, c, d, e, .*allow_shared_sequences=true") as caught:
            module(tmp_path, on_bad=on_bad).setup(stage)
        assert caught.value.file == str(category / SET_LIST)
    allowed = module(tmp_path, allow_shared_sequences=True)
    assert allowed.source("test").names == list("abcdefgh")
    assert "allowed" in allowed.describe()["split"]
    assert "allowed" not in module(tmp_path).describe()["split"]


@pytest.mark.parametrize("val", ["h", "gh"])
def test_a_list_that_validates_on_test_sequences_is_refused_unless_asked_for(tmp_path, val):
    """Whoever chooses by validation would choose by the test."""
    category = write_tree(tmp_path, COUNTS, APART | {"val": val})
    for stage in ("fit", "test"):
        with pytest.raises(DataError, match=r"1 sequences are in both val and test: h; .*allow_shared") as caught:
            module(tmp_path).setup(stage)
        assert caught.value.file == str(category / SET_LIST)
    assert module(tmp_path, allow_shared_sequences=True).source("val").names == list(val)


def test_validation_leaves_out_what_is_trained_on(tmp_path):
    write_tree(tmp_path, COUNTS, APART | {"val": "abg"})
    source = module(tmp_path).source("val")
    assert (source.names, source.left_out) == (["g"], {"in training too": ["a", "b"]})
    assert module(tmp_path, allow_shared_sequences=True).source("val").names == ["a", "b", "g"]


@pytest.mark.parametrize("val", ["", "ab"])
def test_a_seeded_part_of_training_validates_where_nothing_else_does(tmp_path, caplog, val):
    write_tree(tmp_path, COUNTS, APART | {"val": val})
    result = [names(module(tmp_path, val_fraction=0.4, split_seed=seed)) for seed in (0, 0, 1)]
    assert result[0] == result[1] != result[2]
    for taken in result:
        assert taken["val"]
        assert sorted(taken["train"] + taken["val"]) == list("abcdef")
        assert taken["test"] == ["h"]
    assert f"{len(result[0]['val'])} of 6 training sequences validate" in caplog.text
    assert "validates" in module(tmp_path).describe()["split"]


def test_a_source_knows_how_many_sequences_its_list_has(tmp_path):
    """Also those that filters leave out or that cannot be read."""
    category = write_tree(tmp_path, COUNTS, APART | {"train": "abcd", "test": "efh"})
    assert module(tmp_path, min_frames=4).source("test").listed == 3
    change(category / SET_LIST, lambda splits: splits["test"].append(["gone", 0, "x"]))
    source = module(tmp_path).source("test")
    assert (len(source.names), source.listed) == (3, 4)
