"""Weights from the Hugging Face hub: huggingface_hub's own download, from a server that answers as the hub does."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hub_server import MODEL, hub_with


@pytest.fixture
def address(tiny_weights: Path, tmp_path: Path) -> Iterator[str]:
    with hub_with(tmp_path / "hub", tiny_weights) as (address, _):
        yield address


@pytest.mark.processes
def test_weights_are_downloaded_once_with_a_word_and_no_lines_of_requests(address, pipeline, tmp_path):
    def predict(name: str, **environment: str) -> subprocess.CompletedProcess:
        given = [f"image={pipeline.photograph()}", f"weights={MODEL}", "samples=1", "video=[]", "steps=1"]
        known = os.environ | {"HF_HOME": str(tmp_path / "cache"), "HF_ENDPOINT": address, "no_proxy": "127.0.0.1"}
        program = [sys.executable, "-m", "completesplat", "predict", *given, f"out={name}"]
        return subprocess.run(program, cwd=tmp_path, env=known | environment, capture_output=True, text=True)

    first, again = predict("first"), predict("again", HF_HUB_OFFLINE="1")
    assert (first.returncode, again.returncode) == (0, 0), first.stderr + again.stderr
    assert f"{MODEL}: not a folder here; asking the Hugging Face hub" in first.stdout
    assert "HTTP Request" not in first.stdout + first.stderr
    scenes = [next((tmp_path / name).glob("*/sample_00.ply")).read_bytes() for name in ("first", "again")]
    assert scenes[0] == scenes[1]
    missing = predict("other", HF_ENDPOINT=f"{address}/nowhere", HF_HOME=str(tmp_path / "empty"))
    assert (missing.returncode, missing.stderr.count("\n")) == (2, 1), missing.stderr
    assert f"error: {MODEL}: no folder here, and not to be had from the hub" in missing.stderr
