import json
import shutil
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import co3d_trees as trees
import numpy as np
import pytest
from support import change_json

from completesplat.commands.data import prepare
from completesplat.data.co3d.category import Category, Filters, read_category
from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.splits import SeededSplit
from completesplat.errors import BadCamera, DataError, OutsidePath

SPLITS = ("train", "val", "test")


def annotate(
    root: Path,
    counts: Mapping[str, int],
    splits: Mapping[str, Sequence[str]] | None = None,
    qualities: Mapping[str, tuple[float | None, float | None]] | None = None,
) -> None:
    """Annotations without any image."""
    viewpoints = [trees.look(eye, np.zeros(3)) for eye in trees.orbit(max(counts.values(), default=0))]
    frames = [trees.frame_entry(name, i, viewpoints[i]) for name, count in counts.items() for i in range(count)]
    sequences = [trees.sequence_entry(name, *(qualities or {}).get(name, (1.0, 1.0))) for name in counts]
    trees.write_annotations(root, frames, sequences, splits)


def read(root: Path, subset: str | None = trees.SUBSET, rule: SeededSplit | None = None, **filters) -> Category:
    return read_category(root, trees.CATEGORY, subset, rule or SeededSplit(0.2, 0.3, 0), Filters(**filters), True)


def names(category: Category) -> dict[str, set[str]]:
    return {split: set(category.splits[split].frames) for split in SPLITS}


def many(count: int) -> dict[str, int]:
    return {f"{i:03}_{i * i}": 2 for i in range(count)}


def test_frames_come_in_order_whatever_the_file_says(tmp_path):
    annotate(tmp_path, {"a": 4, "b": 4, "c": 4}, {"train": ["a"], "val": ["b"], "test": ["c"]})
    change_json(tmp_path / trees.CATEGORY / trees.FRAMES, lambda entries: entries.reverse())
    change_json(tmp_path / trees.CATEGORY / trees.SET_LIST, lambda splits: splits["train"].reverse())
    frames = [read(tmp_path).splits[split].frames[name] for split, name in zip(SPLITS, "abc", strict=True)]
    assert [[frame.number for frame in each] for each in frames] == [[0, 1, 2, 3]] * 3
    assert frames[0][0].camera.image_size == (24, 32)


def test_whole_sequences_are_split_by_seed_also_where_there_are_set_lists(tmp_path):
    annotate(tmp_path, many(60), {"train": list(many(60)), "val": [], "test": []})
    assert names(read(tmp_path))["test"] == set()
    category = read(tmp_path, None)
    taken = names(category)
    assert taken["train"] | taken["val"] | taken["test"] == set(many(60))
    assert sum(map(len, taken.values())) == 60
    assert all(len(frames) == 2 for split in SPLITS for frames in category.splits[split].frames.values())
    assert taken != names(read(tmp_path, subset=None, rule=SeededSplit(0.2, 0.3, 1)))
    assert taken == names(read(tmp_path, subset=None))


def test_sequences_stay_in_their_split_when_others_come(tmp_path):
    annotate(tmp_path / "few", many(40))
    annotate(tmp_path / "more", many(100))
    few, more = names(read(tmp_path / "few", subset=None)), names(read(tmp_path / "more", subset=None))
    assert all(few[split] == more[split] & set(many(40)) for split in SPLITS)
    assert all(few.values())


def test_three_sequences_are_one_for_each_split_and_fewer_are_refused(tmp_path):
    annotate(tmp_path / "3", many(3))
    assert [len(taken) for taken in names(read(tmp_path / "3", None, SeededSplit(0, 0, 0))).values()] == [1, 1, 1]
    for seed in range(30):  # none is empty, whatever the hashes are
        parts = read(tmp_path / "3", None, SeededSplit(0.05, 0.3, seed))
        assert [len(taken) for taken in names(parts).values()] == [1, 1, 1]
    annotate(tmp_path / "2", many(2))
    with pytest.raises(DataError, match="2 sequences cannot be split"):
        read(tmp_path / "2", subset=None)


def test_unknown_subsets_and_missing_and_outside_categories_are_refused(tmp_path):
    annotate(tmp_path / "root", many(3), {"train": list(many(3)), "val": [], "test": []})
    annotate(tmp_path, many(3))
    lists = tmp_path / "root" / trees.CATEGORY / "set_lists"
    (lists / "set_lists_manyview_dev_0.json").write_text("{}")
    with pytest.raises(DataError, match=r"'other'.*fewview_dev, manyview_dev_0") as caught:
        read(tmp_path / "root", subset="other")
    assert caught.value.file == str(lists)
    for path in lists.iterdir():
        path.unlink()
    nothing = r"no set list 'other' there; nor any other; give data.subset=null, which splits"
    with pytest.raises(DataError, match=nothing):
        read(tmp_path / "root", subset="other")
    with pytest.raises(DataError, match="no such CO3D category") as caught:
        read_category(tmp_path / "root", "none", trees.SUBSET, SeededSplit(0.1, 0.1, 0), Filters())
    assert caught.value.file == str(tmp_path / "root/none")
    for outside in (f"{trees.CATEGORY}/../../{trees.CATEGORY}", str(tmp_path / trees.CATEGORY), ""):
        with pytest.raises(OutsidePath):
            read_category(tmp_path / "root", outside, trees.SUBSET, SeededSplit(0.1, 0.1, 0), Filters())


def test_the_single_sequence_form_divides_the_frames_of_one_sequence(tmp_path):
    """This form has only many-view lists. Each list divides the frames of one sequence."""
    category = trees.write_tree(tmp_path, {"one": 9, "two": 3}, None)
    parts = {"train": [0, 1, 3, 4], "val": [2, 5], "test": [6, 7, 8]}
    listed = {split: [["one", i, f"{trees.CATEGORY}/one/images/x"] for i in part] for split, part in parts.items()}
    (category / "set_lists").mkdir()
    (category / "set_lists/set_lists_manyview_dev_0.json").write_text(json.dumps(listed))
    which = {"subset": "manyview_dev_0", "allow_shared_sequences": True}
    data = CO3DDataModule(str(tmp_path), trees.CATEGORY, **which, image_size=8, batch_size=1, on_bad="raise")
    data.setup("fit")
    data.setup("test")
    assert {s: {n: data.source(s).read(n).frames for n in data.source(s).names} for s in SPLITS} == {
        split: {"one": tuple(part)} for split, part in parts.items()
    }
    assert [batch.names for batch in data.train_dataloader()] == [("one",)]
    with pytest.raises(DataError, match="among manyview_dev_0"):
        CO3DDataModule(str(tmp_path), trees.CATEGORY).setup("fit")


def test_sequences_with_few_frames_are_left_out_and_named(tmp_path):
    annotate(tmp_path, {"a": 1, "b": 2, "c": 5, "d": 5}, {"train": "abc", "val": ["d"], "test": ["a", "d"]})
    category = read(tmp_path)
    assert names(category) == {"train": {"b", "c"}, "val": {"d"}, "test": {"d"}}
    assert [category.splits[s].left_out for s in SPLITS] == [
        {"fewer than 2 frames": ["a"]}, {}, {"fewer than 2 frames": ["a"]},
    ]  # fmt: skip
    assert category.refused == []
    assert read(tmp_path, min_frames=5).splits["train"].left_out == {"fewer than 5 frames": ["a", "b"]}


def test_scores_below_the_least_or_not_given_leave_a_sequence_out(tmp_path):
    qualities = {"a": (0.5, 0.2), "b": (0.49, 0.9), "c": (float("nan"), 0.9), "d": (0.9, None), "e": (-1.0, 0.9)}
    everything = {"train": "abcde", "val": "abcde", "test": "abcde"}
    annotate(tmp_path, dict.fromkeys("abcde", 2), everything, qualities)
    for split in SPLITS:
        assert read(tmp_path).splits[split].left_out == {}
        by_views = read(tmp_path, min_viewpoint_quality=0.5).splits[split]
        assert set(by_views.frames) == set(by_views.point_clouds) == {"a", "d"}
        assert by_views.left_out == {"viewpoint quality below 0.5, or not given": ["b", "c", "e"]}
        both = read(tmp_path, min_viewpoint_quality=0.0, min_point_cloud_quality=0.3, min_frames=2).splits[split]
        assert set(both.frames) == {"b"}
        assert both.left_out == {
            "viewpoint quality below 0, or not given": ["c", "e"],
            "point cloud quality below 0.3, or not given": ["a", "d"],
        }


def test_of_the_training_sequences_the_best_are_kept(tmp_path):
    """Ties go by name; a sequence without a score is the last; validation and test keep all."""
    qualities = {"a": (0.1, 1), "b": (0.9, 1), "c": (None, 1), "d": (0.7, 1), "e": (0.9, 1)}
    annotate(tmp_path, dict.fromkeys("abcde", 2), {"train": "abcde", "val": "abcde", "test": "abc"}, qualities)
    for most, kept in ((1, "b"), (3, "bde"), (4, "abde"), (9, "abcde")):
        category = read(tmp_path, most_training_sequences=most)
        assert names(category) == {"train": set(kept), "val": set("abcde"), "test": set("abc")}
        gone = [name for reason in category.splits["train"].left_out.values() for name in reason]
        assert sorted(gone) == sorted(set("abcde") - set(kept))


def test_cameras_that_do_not_move_are_refused(tmp_path):
    """Within a hundredth of their distance to the object, also where they turn."""
    category = trees.write_tree(tmp_path, {"a": 3, "b": 3, "c": 3}, {"train": ["a"], "val": ["b"], "test": ["c"]})

    def stand(entries):
        for i in range(3):
            target = np.array([0.3 * i, 0, 0])
            entries[i]["viewpoint"] = trees.look(np.array([0.019 * i, 0, -4]), target)
            entries[3 + i]["viewpoint"] = trees.look(np.array([0.022 * i, 0, -4]), target)

    change_json(category / trees.FRAMES, stand)
    data = CO3DDataModule(str(tmp_path), trees.CATEGORY, image_size=8)
    with pytest.raises(BadCamera, match="do not move") as caught:
        data.source("train").read("a")
    assert (caught.value.file, caught.value.sequence) == (str(category / trees.FRAMES), "a")
    assert data.source("val").read("b").frames == (0, 1, 2)


COUNTS = dict.fromkeys("abcdefgh", 3)
APART = {"train": "abcdef", "val": "g", "test": "h"}
SHARED = {"train": "abcdef", "val": "", "test": "abcdefgh"}
"""As `set_lists_fewview_train.json`: all of training is tested too (facebookresearch/co3d issue 49)."""


def module(root: Path, **settings) -> CO3DDataModule:
    return CO3DDataModule(str(root), trees.CATEGORY, image_size=8, **settings)


def listed_names(data: CO3DDataModule) -> dict[str, list[str]]:
    return {split: data.source(split).names for split in SPLITS}


def test_few_views_of_sequences_never_seen_are_the_default_and_a_split_by_seed_must_be_asked_for(tmp_path):
    """Splatter Image takes `fewview_dev` (`data_preprocessing/preprocess_co3d.py`)."""
    trees.write_tree(tmp_path / "lists", COUNTS, APART)
    data = module(tmp_path / "lists")
    assert listed_names(data) == {split: list(listed) for split, listed in APART.items()}
    assert data.describe()["subset"] == "fewview_dev"
    trees.write_tree(tmp_path / "none", COUNTS, None)
    with pytest.raises(DataError, match=r"data\.subset=null"):
        module(tmp_path / "none").setup("fit")
    by_seed = module(tmp_path / "none", subset=None, batch_size=2, targets=1)
    by_seed.setup("fit")
    assert by_seed.describe()["subset"] is None
    assert "seed 0" in by_seed.describe()["split"]


TESTS_ON_TRAINING = r"6 sequences .* a, b, c, d, e, .*allow_shared_sequences=true"
CHOOSES_BY_TEST = r"1 sequences are in both val and test: h; .*allow_shared"
# Each list: (its splits, refusal, a split, its names where shared sequences are allowed)
OVERLAPS = {
    "training is tested": (SHARED, TESTS_ON_TRAINING, "test", "abcdefgh"),
    "the test validates": (APART | {"val": "h"}, CHOOSES_BY_TEST, "val", "h"),
    "the test validates too": (APART | {"val": "gh"}, CHOOSES_BY_TEST, "val", "gh"),
}


@pytest.mark.parametrize(("splits", "message", "split", "allowed"), OVERLAPS.values(), ids=OVERLAPS)
def test_a_list_whose_splits_share_sequences_is_refused_unless_asked_for(tmp_path, splits, message, split, allowed):
    category = trees.write_tree(tmp_path, COUNTS, splits)
    for stage, on_bad in product(("fit", "test"), ("skip", "raise")):
        with pytest.raises(DataError, match=message) as caught:
            module(tmp_path, on_bad=on_bad).setup(stage)
        assert caught.value.file == str(category / trees.SET_LIST)
    shared = module(tmp_path, allow_shared_sequences=True)
    assert shared.source(split).names == list(allowed)
    assert ["allowed" in data.describe()["split"] for data in (shared, module(tmp_path))] == [True, False]


def test_validation_leaves_out_what_is_trained_on(tmp_path):
    trees.write_tree(tmp_path, COUNTS, APART | {"val": "abg"})
    source = module(tmp_path).source("val")
    assert (source.names, source.left_out) == (["g"], {"in training too": ["a", "b"]})
    assert module(tmp_path, allow_shared_sequences=True).source("val").names == ["a", "b", "g"]


@pytest.mark.parametrize("val", ["", "ab"])
def test_a_seeded_part_of_training_validates_where_nothing_else_does(tmp_path, caplog, val):
    trees.write_tree(tmp_path, COUNTS, APART | {"val": val})
    result = [listed_names(module(tmp_path, val_fraction=0.4, split_seed=seed)) for seed in (0, 0, 1)]
    assert result[0] == result[1] != result[2]
    for taken in result:
        assert taken["val"]
        assert sorted(taken["train"] + taken["val"]) == list("abcdef")
        assert taken["test"] == ["h"]
    assert f"{len(result[0]['val'])} of 6 training sequences validate" in caplog.text
    assert "validates" in module(tmp_path).describe()["split"]


def test_a_source_knows_how_many_sequences_its_list_has(tmp_path):
    """Also those that filters leave out or that cannot be read."""
    category = trees.write_tree(tmp_path, COUNTS, APART | {"train": "abcd", "test": "efh"})
    assert module(tmp_path, min_frames=4).source("test").listed == 3
    change_json(category / trees.SET_LIST, lambda splits: splits["test"].append(["gone", 0, "x"]))
    source = module(tmp_path).source("test")
    assert (len(source.names), source.listed) == (3, 4)


FEW = {"train": "ab", "val": "c", "test": "d"}


def test_what_nobody_reads_may_be_broken(tmp_path):
    """NaN in a number that is not used (Python's `json`, which wrote CO3D, writes it); frames that no list names."""
    category = trees.write_tree(tmp_path, dict.fromkeys("abcd", 4), FEW)
    change_json(category / trees.FRAMES, lambda entries: entries[2]["mask"].update(mass=float("nan")))
    change_json(category / trees.FRAMES, lambda entries: entries[2]["depth"].update(scale_adjustment=2))
    result = read(tmp_path)
    assert result.refused == []
    assert result.splits["train"].frames["a"][2].depth.scale_adjustment == 2.0
    change_json(category / trees.SET_LIST, lambda splits: splits["train"].remove(splits["train"][2]))
    change_json(category / trees.FRAMES, lambda entries: entries[2].update(viewpoint=None))
    result = read(tmp_path)
    assert [frame.number for frame in result.splits["train"].frames["a"]] == [0, 1, 3]
    assert result.refused == []


def test_a_partial_download_is_refused_at_once_with_the_setting_that_uses_what_is_there(tmp_path):
    category = trees.write_tree(tmp_path, dict.fromkeys("abcd", 4), FEW)
    for name in "bc":
        shutil.rmtree(category / name)
    message = f"{category}: 2 of 4 sequences have no images, as after a partial download; "
    message += "data.max_bad_fraction=1 uses the others"
    with pytest.raises(DataError, match=f"^{message}$"):
        module(tmp_path, batch_size=1).setup("fit")
    data = module(tmp_path, batch_size=1, max_bad_fraction=1.0)
    data.setup("test")
    source = data.source("train")
    assert (source.names, source.left_out) == (["a"], {"not downloaded": ["b"]})
    assert [batch.names for batch in data.train_dataloader()] == [("a",)]
    with pytest.raises(DataError, match="2 of 4 sequences have no images"):
        module(tmp_path, on_bad="raise").source("test")
    with pytest.raises(DataError, match="2 of 4 sequences have no images"):
        prepare(module(tmp_path), ["train", "test"], tmp_path / "STORE", "png", 4, 1, "skip", 0.1)
