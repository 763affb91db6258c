"""The stored notebooks are what `make notebooks` stores: run whole, in order, from the code that they have."""

import base64
import io
import json
import re
import runpy
from copy import deepcopy
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from PIL import Image
from safetensors.torch import save_file
from stored_notebooks import HASH, NOTEBOOKS, ROOT, WIDEST, code_cells, hash_of, slimmed
from support import compose_config

from completesplat import compose
from completesplat.commands import fit
from completesplat.data.toy import write_objects

MOST_BYTES = 1_000_000
IMPORT = re.compile(r"^from (completesplat[\w.]*) import ([\w, ]+)", re.MULTILINE)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_has_the_outputs_of_its_code_and_nothing_of_the_machine(path):
    notebook = json.loads(path.read_text())
    assert notebook["metadata"]["completesplat"][HASH] == hash_of(notebook), "the code has changed: make notebooks"
    cells = code_cells(notebook)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    kinds = {(output["output_type"], output.get("name")) for output in outputs}
    assert kinds <= {("stream", "stdout"), ("execute_result", None), ("display_data", None)}
    assert any("image/jpeg" in output.get("data", {}) for output in outputs)
    assert path.stat().st_size <= MOST_BYTES
    assert not any(place in path.read_text() for place in (str(ROOT), str(Path.home()) + "/", "site-packages"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_what_a_notebook_imports_from_the_package_exists(path):
    code = "\n".join(line for cell in code_cells(json.loads(path.read_text())) for line in cell["source"])
    names = [(module, name) for module, names in IMPORT.findall(code) for name in names.split(", ")]
    assert names
    assert [name for module, name in names if not hasattr(import_module(module), name)] == []


def test_the_first_notebook_installs_the_package_before_anything_needs_it():
    first, second = (["".join(cell["source"]) for cell in code_cells(json.loads(NOTEBOOKS[0].read_text()))])[:2]
    assert "%pip install" in first
    assert "import completesplat" not in first
    assert "import completesplat" in second


def test_outputs_are_made_small_and_a_change_of_the_code_is_noticed():
    noise = np.random.default_rng(0).integers(0, 255, (600, 2 * WIDEST, 3), np.uint8)
    buffer = io.BytesIO()
    Image.fromarray(noise).save(buffer, "PNG")
    image = {"image/png": base64.b64encode(buffer.getvalue()).decode(), "text/plain": "<an image>"}
    message = [{"output_type": "stream", "name": "stdout", "text": [f"{i}\n"]} for i in range(2)]
    outputs = [*message, {"output_type": "display_data", "data": {"text/plain": "a bar"}}]
    outputs.append({"output_type": "execute_result", "data": image})
    cell = {"cell_type": "code", "source": ["1 +\n", "1"], "outputs": outputs}
    notebook = slimmed({"cells": [{"cell_type": "markdown", "source": ["text"]}, cell], "metadata": {}})
    stream, result = cell["outputs"]
    assert stream["text"] == ["0\n", "1\n"]
    assert result["data"].keys() == {"image/jpeg", "text/plain"}
    assert Image.open(io.BytesIO(base64.b64decode(result["data"]["image/jpeg"]))).size == (WIDEST, 300)
    assert notebook["metadata"]["completesplat"][HASH] == hash_of(notebook)
    changed = deepcopy(notebook)
    code_cells(changed)[0]["source"] = ["1 + 1"]
    assert hash_of(changed) != hash_of(notebook)


def test_an_autoreconstructor_of_twice_the_channels_computes_the_same(tmp_path):
    """Posterior and Splatter Image, with a skip that passes something on."""

    def network(channels: str):
        torch.manual_seed(0)
        sizes = [f"autoreconstructor.encoder.channels={channels}", "autoreconstructor.encoder.norm_groups=8"]
        return instantiate(compose_config("fit", *sizes).autoreconstructor, _convert_="all").eval()

    narrow = network("[8,8,16]")
    wide = network("[16,16,32]")
    torch.nn.init.normal_(narrow.reconstructor.skips["0"].weight)
    save_file({f"autoreconstructor.{k}": v for k, v in narrow.state_dict().items()}, tmp_path / "model.safetensors")
    runpy.run_path(str(ROOT / "notebooks/starts.py"))["main"](str(tmp_path), tmp_path / "start.ckpt", "wider")
    state = torch.load(tmp_path / "start.ckpt", weights_only=True)["state_dict"]
    wide.load_state_dict({name.removeprefix("model."): value for name, value in state.items()})
    with torch.no_grad():
        images = torch.rand(2, 3, 32, 32)
        before = narrow(images)
        after = wide(images)
    torch.testing.assert_close(after.posterior.mean, before.posterior.mean, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(after.splatter_image.raw, before.splatter_image.raw, rtol=1e-4, atol=1e-4)


def test_odds_are_fitted_to_two_kinds_of_images_and_written_beside_the_weights(tmp_path, monkeypatch, capsys):
    """Red squares on white against blue ones: the odds of a red one are high, those of a blue one low."""
    rng = np.random.default_rng(0)
    for kind, channel in (("reds", 0), ("blues", 2)):
        for number in range(10):
            (tmp_path / kind / str(number)).mkdir(parents=True)
            pixels = np.full((20, 20, 3), 255, np.uint8)
            pixels[4:16, 4:16] = rng.integers(0, 100, (12, 12, 3))
            pixels[4:16, 4:16, channel] = 250
            Image.fromarray(pixels).save(tmp_path / kind / str(number) / "0.png")
    weights = tmp_path / "weights"
    weights.mkdir()
    (weights / "config.json").write_text(json.dumps({"image_size": 16, "training": {}}))
    (weights / "model.safetensors").write_bytes(b"")
    folders = [str(tmp_path / name) for name in ("weights", "reds", "blues")]
    monkeypatch.setattr("sys.argv", ["odds.py", *folders])
    runpy.run_path(str(ROOT / "notebooks/odds.py"))["main"]()
    assert capsys.readouterr().out == "held out: 100.0% of 2 of the kind, 100.0% of 2 others\n"
    training = json.loads((weights / "config.json").read_text())["training"]
    assert len(training["feature_odds"]) == 8
    assert training["feature_odds"][0] > 0 > training["feature_odds"][2]


def test_a_data_set_written_as_captures_has_the_same_views(tmp_path):
    """Six of eight frames: images up to JPEG, cameras, and the place of the object in the depth range."""
    write_objects(tmp_path / "toys", scenes=6, frames=8, size=32, seed=0, workers=1, progress=False)
    depths = ["data.image_size=32", "data.depth_before=1", "data.depth_after=3"]
    toys = ["data=toy_objects", f"data.root={tmp_path / 'toys'}", *depths]
    out = tmp_path / "captures"
    runpy.run_path(str(ROOT / "notebooks/as_captures.py"))["main"](str(out), "toy_", "6", "train", *toys)
    settings = ["data=captures", f"data.root={out}", "data.test_fraction=0", "data.val_fraction=0", *depths]
    source, written = (fit.instantiate(compose("fit", *given))[0].source("train") for given in (toys, settings))
    (name, *_) = written.names
    first = source.read(name.removeprefix("toy_"))
    again = written.read(name)
    kept = [0, 1, 2, 4, 5, 6]
    poses = [cameras.relative_to(cameras[0]).world_to_camera for cameras in (first.cameras[kept], again.cameras)]
    torch.testing.assert_close(poses[1], poses[0], atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(again.depth_ranges, first.depth_ranges[kept], atol=1e-3, rtol=1e-3)
    for place, frame in enumerate(kept):
        assert (again.read(place).image.float() - first.read(frame).image.float()).abs().mean() < 6
