"""Splatter Image's published files: which ones are meant, and what of them is refused."""

import re
from pathlib import Path

import pytest
import torch
import yaml
from published_weights import config, write_published

from completesplat.baselines.splatter_image.model import find_published, is_published, read_tensors
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
    (tmp_path / "config_hydrants.yaml").unlink()
    with pytest.raises(WeightsError, match=r"config_hydrants.yaml is missing beside it"):
        find_published(str(path))
    with pytest.raises(WeightsError, match=r"model_x.pth: no such file"):
        find_published(str(tmp_path / "model_x.pth"))


def test_the_hub_is_asked_once_and_without_it_a_line_says_what_to_fetch(tmp_path, monkeypatch):
    import huggingface_hub.constants

    snapshot = tmp_path / "hub/models--szymanowiczs--splatter-image-v1/snapshots" / ("0" * 40)
    refs = snapshot.parents[1] / "refs"
    refs.mkdir(parents=True)
    (refs / "main").write_text("0" * 40)
    path = write_published(snapshot, "objaverse")
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    assert find_published("splatter_image:objaverse").weights == path
    fetched = "config_cars.yaml model_cars.pth --local-dir DIR` fetches it; then give weights=DIR/model_cars.pth"
    with pytest.raises(
        WeightsError, match=re.escape(f"hf download szymanowiczs/splatter-image-v1 {fetched}")
    ) as caught:
        find_published("splatter_image:cars")
    assert "\n" not in str(caught.value)
    with pytest.raises(WeightsError, match=r"give NAME of a config_NAME.yaml"):
        find_published("splatter_image:../cars")


REFUSED = {
    "two images": ({"data": {"input_images": 2}}, "data.input_images is 2"),
    "embedded cameras": ({"cam_embd": {"embedding": "pose"}}, "cam_embd.embedding is pose"),
    "another network": ({"model": {"name": "TwoUNets"}}, "model.name is TwoUNets"),
    "no harmonics": ({"model": {"max_sh_degree": 0}}, "model.max_sh_degree is 0"),
    "a width beyond bounds": ({"model": {"base_dim": 10**6}}, "model.base_dim is 1000000"),
    "no size": ({"data": {"training_resolution": None}}, "data.training_resolution is None"),
    "depths the wrong way round": ({"data": {"znear": 5.0}}, "data.znear must be below data.zfar"),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_other_settings_than_those_of_published_weights_are_refused(kind, tmp_path):
    settings, message = REFUSED[kind]
    path = write_published(tmp_path, "hydrants", settings=settings)
    with pytest.raises(WeightsError, match=rf"config_hydrants.yaml: {re.escape(message)}"):
        find_published(str(path))


class Called:
    """What a checkpoint must not call when it is read."""

    def __reduce__(self):
        return Path.touch, (Path("called"),)


def test_files_are_read_as_data_only(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write_published(tmp_path, "hydrants")
    torch.save({"model_state_dict": {"ray_dirs": Called()}}, path)
    with pytest.raises(WeightsError, match=r"model_hydrants.pth: damaged, or not plain numbers"):
        read_tensors(path)
    for content, message in (
        ("model: !!python/object/apply:pathlib.Path.touch [called]", "not readable as YAML"),
        ("a: &a [1, 2]\nb: [*a, *a]", "has aliases"),
        ("just text", "data.training_resolution is None"),
    ):
        (tmp_path / "config_hydrants.yaml").write_text(content)
        with pytest.raises(WeightsError, match=f"config_hydrants.yaml: {message}"):
            find_published(str(path))
    assert not Path("called").exists()
    # What else the file holds (the optimizer, `_target_`s) is not looked at.
    described = config("hydrants") | {"opt": {"_target_": "os.system"}}
    (tmp_path / "config_hydrants.yaml").write_text(yaml.safe_dump(described))
    assert find_published(str(path)).model["base_dim"] == 16
    for content in (b"", path.read_bytes()[:100]):
        path.write_bytes(content)
        with pytest.raises(WeightsError, match="damaged"):
            read_tensors(path)
    torch.save({"state_dict": {}}, path)
    with pytest.raises(WeightsError, match="no model_state_dict in it"):
        read_tensors(path)
