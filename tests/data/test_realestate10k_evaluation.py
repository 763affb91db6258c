import json
import logging
from dataclasses import replace
from pathlib import Path

import pytest
from realestate10k_trees import make_clip, module, same, write_tree

from completesplat.data.realestate10k.module import RE10KDataModule
from completesplat.data.validation.audit import check
from completesplat.errors import DataError

PAIR = {"context": [2, 7], "target": [3, 5]}
PIXELSPLAT = {"test0": PAIR, "test1": None, "gone": PAIR}
MVSPLAT360 = {"test0": {"context": [2, 7], "target": [2, 3, 4, 5], "target_quantify": [3, 5]}, "test1": None}
LATENTSPLAT = {"test0": [PAIR], "test1": [], "test2": [PAIR, {"context": [1, 4], "target": [0, 6]}]}
FLASH3D = "test0 2 3 5 1\ntest2 2 3 5 2\n\ntest2 1 0 6 6\ngone 1 2 3 4"


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    test = [make_clip(f"test{i}", frames=8) for i in range(4)]
    return write_tree(tmp_path_factory.mktemp("rooms"), "chunks", [make_clip("a"), make_clip("b")], test)


def data_of(root: Path, content: object, folder: Path, setting: str = "evaluation_index") -> RE10KDataModule:
    path = folder / "list"
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return module(root, evaluation_batch_size=1, **{setting: str(path)})


FIRST, LAST = ("test0", "test0", 2, [3, 5]), ("test2#2", "test2", 1, [0, 6, 6])
# a format: (content, name of each test, its clip, reference and targets)
VIEWS = {
    "pixelSplat": (PIXELSPLAT, [FIRST]),
    "MVSplat360": (MVSPLAT360, [FIRST]),
    "latentSplat": (LATENTSPLAT, [FIRST, ("test2#1", "test2", 2, [3, 5]), ("test2#2", "test2", 1, [0, 6])]),
    "Flash3D": (FLASH3D, [(*FIRST[:3], [3, 5, 1]), ("test2#1", "test2", 2, [3, 5, 2]), LAST]),
}


@pytest.mark.parametrize("form", VIEWS)
def test_each_format_gives_its_views(root, tmp_path, form):
    content, tests = VIEWS[form]
    data = data_of(root, content, tmp_path)
    read, scene = data.source("test").read, data.store("test").scene
    for batch, (name, clip, reference, targets) in zip(data.test_dataloader(), tests, strict=True):
        assert same(batch[0], replace(scene(read(clip), reference, targets), names=name))
    assert f"in {form}'s format, SHA-256 " in data.describe()["protocol_views"]


def test_what_a_list_leaves_out_is_counted_and_named(root, tmp_path, caplog):
    missing = {f"gone{i}": PAIR for i in range(7)}
    data_of(root, {**PIXELSPLAT, **missing}, tmp_path).store("test")
    (line,) = [r.message for r in caplog.records if "to test" in r.message and r.levelno == logging.WARNING]
    assert "1 null in the index (test1)" in line
    assert "8 in the index, not in the data (gone, gone0, gone1, gone2, gone3, ...)" in line
    assert "2 not in the index (test2, test3)" in line


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"test0": {**PAIR, "overlap": 0.5}}, "test0: neither null"),
        ({"test0": 3}, "test0: neither null"),
        ({"test0": PAIR, "test1": [PAIR]}, "test1: formats of several works: pixelSplat, latentSplat"),
        ({"test0": {"context": [1], "target": [2.5]}}, "test0: context and target must be lists of frame numbers"),
        ({"test0": [{"context": [], "target": [1]}]}, "test0: context and target must be lists of frame numbers"),
        ({"test0": None}, "no clip with views"),
        ([PAIR], "not a table of clips"),
        ('{"test0": ', "not a JSON file"),
        ("test0 1 2 3 4\n\ntest1 1 2 3 x\n", "line 3: not `KEY source target target target`"),
        ("test0 247 r\n", "line 1: not `KEY source target target target`"),
        ("test0\ntest1\n", "data.scene_list"),
    ],
)
def test_what_is_not_understood_is_refused_with_its_place(root, tmp_path, content, message):
    with pytest.raises(DataError) as refusal:
        data_of(root, content, tmp_path).store("test")
    assert str(refusal.value).startswith(str(tmp_path / "list"))
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_a_list_of_keys_is_one_key_a_line(root, tmp_path):
    chosen = data_of(root, "test3\n\ntest1\n", tmp_path, "scene_list")
    assert chosen.store("test").names == ["test1", "test3"]
    assert chosen.describe()["scene_list"].startswith("SHA-256 ")
    assert "targets" in chosen.describe()["protocol_views"]
    with pytest.raises(DataError, match=r"list: line 2: 5 columns.*data.evaluation_index"):
        data_of(root, "test0\n" + FLASH3D, tmp_path, "scene_list").store("test")


def test_views_that_clips_lack_are_refused_before_training_and_by_the_check(root, tmp_path):
    index = {f"test{i}": PAIR if i < 2 else {"context": [2], "target": [3, 8]} for i in range(4)}
    data = data_of(root, index, tmp_path)
    found = check({"test": data.select_sequences("test", data.source("test"))}, workers=1, progress=False)
    assert (found.sequences, found.frames) == (2, 16)
    lacking = "test2, frame 8: the frame is in the evaluation index, not in the data"
    assert [str(error) for error in found.refused] == [lacking, lacking.replace("test2", "test3")]
    with pytest.raises(DataError, match=r"2 of 4 items cannot be read.*test3, frame 8: the frame is in the evaluation"):
        data.check_test()
    index["test2"] = PAIR  # one that is skipped is reported by the test
    data_of(root, index, tmp_path).check_test()
