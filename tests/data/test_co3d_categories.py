"""Several categories of CO3D as one data set."""

from pathlib import Path

import co3d_trees as trees
import numpy as np
import pytest
import torch
from realestate10k_trees import epoch, equal
from support import SMALL, change_json, strict_json

from completesplat.commands.data import prepare
from completesplat.data.co3d.module import CO3DDataModule
from completesplat.errors import CompleteSplatError, DataError

BOTH = ["hydrant", "teddybear"]
COUNTS = {"1_1": 4, "2_2": 4, "3_3": 4, "4_4": 4}
LISTS = {"train": ["1_1", "2_2"], "val": ["3_3"], "test": ["4_4"]}
TOTALS = {"train": 4, "val": 2, "test": 2}


@pytest.fixture
def root(tmp_path, monkeypatch) -> Path:
    """Two categories whose sequences have the same names, one with a sequence that is left out."""
    for name in BOTH:
        monkeypatch.setattr(trees, "CATEGORY", name)
        trees.write_tree(tmp_path, COUNTS, LISTS)
    return tmp_path


def opened(root: Path, category: str | list[str], **settings) -> CO3DDataModule:
    defaults = {"image_size": 8, "batch_size": 2, "targets": 2}
    return CO3DDataModule(str(root), category, **defaults | settings)


def test_their_sequences_are_one_set_under_names_of_their_own(root):
    data = opened(root, ["teddybear", "hydrant"])
    for split, names in LISTS.items():
        source = data.source(split)
        assert source.names == [f"{category}/{name}" for category in BOTH for name in names]
        assert source.listed == TOTALS[split]
        for category in BOTH:
            alone = opened(root, category).source(split).read(names[0])
            sequence = source.read(f"{category}/{names[0]}")
            assert sequence.name == f"{category}/{names[0]}"
            assert torch.equal(sequence.read(1).image, alone.read(1).image)
            assert torch.equal(sequence.cameras.world_to_camera, alone.cameras.world_to_camera)
    batches = list(data.test_dataloader())
    assert [name for batch in batches for name in batch.names] == ["hydrant/4_4", "teddybear/4_4"]
    assert opened(root, ["hydrant"]).source("test").names == opened(root, "hydrant").source("test").names == ["4_4"]


def test_what_is_said_of_the_data_names_all_categories(root):
    both = opened(root, BOTH)
    assert both.describe()["data_set"] == "co3d/hydrant,teddybear"
    assert both.packed_settings()["category"] == "hydrant,teddybear"
    before = both.trained_on
    assert before["sequences"] == 4
    assert opened(root, BOTH[::-1]).trained_on == before
    assert opened(root, "hydrant").trained_on["fingerprint"] != before["fingerprint"]
    change_json(root / "teddybear" / trees.SEQUENCES, lambda entries: entries[0].update(viewpoint_quality_score=0.5))
    assert opened(root, BOTH).trained_on["fingerprint"] != before["fingerprint"]


def test_each_category_is_split_and_filtered_for_itself(root):
    by_seed = opened(root, BOTH, subset=None, val_fraction=0.25, test_fraction=0.25)
    for split in LISTS:
        alone = opened(root, "hydrant", subset=None, val_fraction=0.25, test_fraction=0.25).source(split).names
        assert alone
        assert by_seed.source(split).names == [f"{category}/{name}" for category in BOTH for name in alone]
    few = opened(root, BOTH, most_training_sequences=1).source("train")
    assert few.names == ["hydrant/1_1", "teddybear/1_1"]
    assert list(few.left_out.values()) == [["hydrant/2_2", "teddybear/2_2"]]


def test_errors_name_the_category_and_its_files(root):
    def stretch(entries: list) -> None:
        entries[0]["viewpoint"]["R"] = (2 * np.eye(3)).tolist()

    change_json(root / "teddybear" / trees.FRAMES, stretch)
    (error,) = opened(root, BOTH).source("train").refused
    assert error.file == str(root / "teddybear" / trees.FRAMES)
    assert (error.sequence, error.frame) == ("teddybear/1_1", 0)
    with pytest.raises(DataError, match=r"chair: no such CO3D category; there are hydrant, teddybear$"):
        opened(root, ["hydrant", "chair"]).source("train")
    with pytest.raises(
        DataError, match=r"no such CO3D category; no folder there has frame_annotations.jgz: is data.ro"
    ):
        opened(root / "hydrant", ["hydrant", "chair"]).source("train")
    for wrong in ([], ["hydrant", "hydrant"]):
        with pytest.raises(CompleteSplatError, match=r"data\.category=\[.*\]: must name each category once"):
            opened(root, wrong)


def test_prepared_data_of_several_categories_give_the_same_batches(root, tmp_path):
    data = opened(root, BOTH)
    prepare(data, list(LISTS), tmp_path / "store", "png", 4, 1, "skip", 0.1)
    packed = opened(tmp_path / "store", BOTH[::-1])
    assert equal(epoch(packed.train_dataloader(), 0), epoch(data.train_dataloader(), 0))
    assert packed.source("test").names == ["hydrant/4_4", "teddybear/4_4"]
    with pytest.raises(DataError, match=r"prepared with category=hydrant,teddybear \(asked for: hydrant\)"):
        opened(tmp_path / "store", "hydrant").source("train")


@pytest.mark.slow
def test_a_run_trains_on_both_and_its_test_by_the_protocol_of_co3d_scores_both(command, root, tmp_path):
    given = ["experiment=toy_var", "data=co3d_category", "data.category=[hydrant,teddybear]", f"data.root={root}"]
    protocol = ["evaluation=co3d", "evaluation.metrics.lpips=null", "evaluation.scoring.sets=null"]
    run = tmp_path / "run"
    command.succeeds("fit", *given, *SMALL, *protocol, "data.targets=2", "data.workers=0", f"out={run}")
    test = strict_json(run / "metrics.json")["test"]
    described = [test["protocol"][name] for name in ("data_set", "subset", "scenes", "scenes_listed", "views")]
    assert described == ["co3d/hydrant,teddybear", "fewview_dev", 2, 2, 6]
