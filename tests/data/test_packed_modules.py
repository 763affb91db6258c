import json
import logging
import shutil
from pathlib import Path

import pytest
import torch
from packed_sequences import prepared
from realestate10k_trees import equal, make_clip, write_tree

from completesplat.data.co3d.module import CO3DDataModule
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.realestate10k.module import RE10KDataModule
from completesplat.data.tolerance import ErrorTolerance
from completesplat.data.toy.data_sets import SUBSET
from completesplat.errors import DataError


def objects(root: Path, **settings) -> CO3DDataModule:
    defaults = {"subset": SUBSET, "image_size": 16, "batch_size": 2, "targets": 2}
    return CO3DDataModule(str(root), "toy_objects", **defaults | settings)


def clips(root: Path, **settings) -> RE10KDataModule:
    small = {"image_size": 8, "batch_size": 2, "targets": 2, "val_fraction": 0.3}
    return RE10KDataModule(str(root), **small | settings)


def assert_same_batches(raw: SceneDataModule, packed: SceneDataModule) -> None:
    for loader in ("train_dataloader", "val_dataloader", "test_dataloader"):
        one, other = list(getattr(raw, loader)()), list(getattr(packed, loader)())
        assert one
        assert equal(one, other)


@pytest.fixture(scope="module")
def packed_objects(toy_root, tmp_path_factory) -> Path:
    return prepared(objects(toy_root), tmp_path_factory.mktemp("objects") / "store")


def write_tours(root: Path) -> Path:
    made = {split: [make_clip(f"{split}{number}", seed=number) for number in range(5)] for split in ("train", "test")}
    return write_tree(root, "text", **made)


@pytest.fixture(scope="module")
def tours(tmp_path_factory) -> Path:
    return write_tours(tmp_path_factory.mktemp("tours"))


def test_packed_objects_give_the_same_batches(toy_root, packed_objects):
    assert_same_batches(objects(toy_root), objects(packed_objects))
    assert objects(toy_root).typical_camera() == objects(packed_objects).typical_camera()
    assert torch.equal(objects(toy_root).mean_image(), objects(packed_objects).mean_image())


def test_packed_tours_give_the_same_batches(tours, tmp_path):
    store = prepared(clips(tours), tmp_path / "store")
    assert_same_batches(clips(tours), clips(store))
    index = {"test0": {"context": [4, 0], "target": [1, 5]}, "test3": {"context": [0, 5], "target": [3]}, "test4": None}
    (tmp_path / "index.json").write_text(json.dumps(index))
    chosen = {"evaluation_index": str(tmp_path / "index.json")}
    assert_same_batches(clips(tours, **chosen), clips(store, **chosen))


def test_an_evaluation_index_uses_original_frame_numbers_even_if_frames_were_left_out(tours, tmp_path):
    root = write_tours(tmp_path / "broken")
    sorted((root / "test/test0").glob("*.jpg"), key=lambda path: int(path.stem))[2].write_bytes(b"")
    store = prepared(clips(root), tmp_path / "store", tolerance=ErrorTolerance("skip", 0.5))
    (tmp_path / "index.json").write_text(json.dumps({"test0": {"context": [0, 5], "target": [1, 3, 4]}}))
    chosen = {"evaluation_index": str(tmp_path / "index.json")}
    assert equal(*(list(clips(place, **chosen).test_dataloader()) for place in (tours, store)))
    (tmp_path / "index.json").write_text(json.dumps({"test0": {"context": [0, 5], "target": [2]}}))
    with pytest.raises(DataError, match="test0, frame 2"):
        list(clips(store, on_bad="raise", **chosen).test_dataloader())


def test_only_settings_that_do_not_affect_prepared_data_may_change(packed_objects):
    for name, value in (("image_size", 99), ("subset", None), ("split_seed", 1)):
        with pytest.raises(DataError, match=name):
            objects(packed_objects, **{name: value}).setup("fit")
    data = objects(packed_objects, targets=1, seed=3, mask_threshold=0.5, evaluation_targets=1)
    targets = next(iter(data.train_dataloader())).targets
    assert targets.images.shape[1] == 1
    assert set(targets.masks.unique().tolist()) == {0.0, 1.0}


def test_resuming_on_other_data_is_refused_but_prepared_data_count_as_the_same(toy_root, packed_objects, tours, caplog):
    state = objects(toy_root).state_dict()
    with caplog.at_level(logging.WARNING):
        objects(packed_objects).load_state_dict(state)
        objects(packed_objects).load_state_dict({"fingerprint": state["fingerprint"]})
        assert caplog.messages == []
        with pytest.raises(DataError, match=r"tours.*: not the training data that this run had before \(2 seq"):
            clips(tours).load_state_dict(state)
        clips(tours, allow_changed=True).load_state_dict(state)
    assert len(caplog.messages) == 1
    assert "not the training data that this run had before (2 sequences then" in caplog.messages[0]


def test_the_state_of_a_run_describes_the_data_that_it_started_with(toy_root, tmp_path):
    root = shutil.copytree(toy_root, tmp_path / "toys")
    state = objects(root).state_dict()
    data = objects(root)
    data.setup("fit")
    for path in root.glob("*/frame_annotations.jgz"):
        path.write_bytes(path.read_bytes() + b"more")
    assert data.state_dict() == state
    assert objects(toy_root).state_dict() == state
