"""CO3D trees that cannot be used, partly downloaded, or damaged where nobody reads. `test_damage.py` has the rest."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from co3d_trees import CATEGORY, FRAMES, SET_LIST, SUBSET, change, write_tree

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.co3d.splits import Category, Filters, SeededSplit, read_category
from completesplat.data.validation import (
    BadAnnotation,
)
from completesplat.errors import DataError

POLICIES = pytest.mark.parametrize("policy", ["raise", "skip"])


@pytest.fixture(scope="module")
def intact(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Training sequences a and b, c for validation, d for testing, of four frames each."""
    splits = {"train": "ab", "val": "c", "test": "d"}
    return write_tree(tmp_path_factory.mktemp("intact"), dict.fromkeys("abcd", 4), splits)


@pytest.fixture
def category(intact: Path, tmp_path: Path) -> Path:
    """A category that a test may damage."""
    shutil.copytree(intact, tmp_path / "root" / CATEGORY)
    return tmp_path / "root" / CATEGORY


def read(category: Path) -> Category:
    return read_category(category.parent, category.name, SUBSET, SeededSplit(0.1, 0.1, 0), Filters())


@POLICIES
@pytest.mark.parametrize(
    ("file", "edit", "part"),
    [
        (FRAMES, lambda entries: {"frames": entries}, "must hold a list"),
        (SET_LIST, lambda splits: [splits], "no train"),
    ],
)
def test_a_file_that_says_nothing_is_raised_under_either_policy(policy, category, file, edit, part):
    change(category / file, edit)
    with pytest.raises(BadAnnotation, match=part) as caught:
        module(category.parent, policy).setup("fit")
    assert caught.value.file == str(category / file)


def test_what_nobody_reads_may_be_broken(category):
    """NaN in a number that is not used (Python's `json`, which wrote CO3D, writes it); frames that no list names."""
    change(category / FRAMES, lambda entries: entries[2]["mask"].update(mass=float("nan")))
    change(category / FRAMES, lambda entries: entries[2]["depth"].update(scale_adjustment=2))
    result = read(category)
    assert result.refused == []
    assert result.splits["train"].frames["a"][2].depth.scale_adjustment == 2.0
    change(category / SET_LIST, lambda splits: splits["train"].remove(next(m for m in splits["train"] if m[1] == 2)))
    change(category / FRAMES, lambda entries: entries[2].update(viewpoint=None))
    result = read(category)
    assert [frame.number for frame in result.splits["train"].frames["a"]] == [0, 1, 3]
    assert result.refused == []


def module(root: Path, policy: str, **settings: Any) -> CO3DDataModule:
    """Small images, one scene in a batch that shows all frames, and no limit on what is skipped."""
    defaults = {"image_size": 8, "batch_size": 1, "targets": 3, "subset": SUBSET}
    return CO3DDataModule(str(root), CATEGORY, **{**defaults, "on_bad": policy, "max_bad_fraction": 10.0, **settings})


def test_a_partial_download_is_refused_at_once_with_the_setting_that_uses_what_is_there(category):
    for name in "bc":
        shutil.rmtree(category / name)
    given = str(category.parent), CATEGORY
    with pytest.raises(DataError) as caught:
        CO3DDataModule(*given, batch_size=1).setup("fit")
    message = f"{category}: 2 of 4 sequences have no images, as after a partial download; "
    assert str(caught.value) == message + "data.max_bad_fraction=1 uses the others"
    data = CO3DDataModule(*given, batch_size=1, max_bad_fraction=1.0, image_size=16)
    data.setup("test")
    source = data.source("train")
    assert (source.names, source.left_out) == (["a"], {"not downloaded": ["b"]})
    assert [batch.names for batch in data.train_dataloader()] == [("a",)]
    with pytest.raises(DataError, match="2 of 4 sequences have no images"):
        CO3DDataModule(*given, on_bad="raise").source("test")
