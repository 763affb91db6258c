"""Splatter Image's published files: which ones are meant. `test_damaged_files.py` has what is refused."""

import re

import pytest
import yaml
from published_weights import config, write_published
from support import hub_snapshot

from completesplat.baselines.splatter_image.model import find_published, is_published
from completesplat.errors import WeightsError


def test_a_file_a_folder_and_a_name_of_the_hub_are_known(tmp_path, tiny_weights):
    path = write_published(tmp_path, "hydrants")
    for weights in ("splatter_image:hydrants", str(path), str(tmp_path)):
        assert is_published(weights)
    for weights in ("toy_objects", str(tiny_weights), "some/splats"):
        assert not is_published(weights)
    for weights in (path, tmp_path):
        assert find_published(str(weights)).weights == path
    assert find_published(str(path)).data["znear"] == -2
    write_published(tmp_path, "objaverse")
    assert find_published(str(tmp_path / "model_latest.pth")).data["white_background"]
    with pytest.raises(WeightsError, match=r"holds model_hydrants.pth, model_latest.pth; give one of these files"):
        find_published(str(tmp_path))
    # What else a file holds (the optimizer, `_target_`s) is not looked at.
    described = config("hydrants") | {"opt": {"_target_": "os.system"}}
    (tmp_path / "config_hydrants.yaml").write_text(yaml.safe_dump(described))
    assert find_published(str(path)).model["base_dim"] == 16


def test_the_hub_is_asked_once_and_without_it_a_line_says_what_to_fetch(tmp_path, monkeypatch):
    snapshot = hub_snapshot(monkeypatch, tmp_path / "hub", "szymanowiczs/splatter-image-v1")
    path = write_published(snapshot, "objaverse")
    assert find_published("splatter_image:objaverse").weights == path
    fetched = "config_cars.yaml model_cars.pth --local-dir DIR` fetches it; then give weights=DIR/model_cars.pth"
    with pytest.raises(
        WeightsError, match=re.escape(f"hf download szymanowiczs/splatter-image-v1 {fetched}")
    ) as caught:
        find_published("splatter_image:cars")
    assert "\n" not in str(caught.value)
    with pytest.raises(WeightsError, match=r"give NAME of a config_NAME.yaml"):
        find_published("splatter_image:../cars")
