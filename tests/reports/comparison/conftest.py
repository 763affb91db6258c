"""Folders of results with known figures, as `test` and `fit` write them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

PROTOCOL = {
    "name": "images",
    "method": "VariationalAutoReconstructor",
    "data_set": "toy_objects",
    "image_size": 64,
    "resolution": 64,
    "scenes": 20,
    "skipped": 0,
    "views": 80,
    "samples": 1,
    "sampler": None,
    "checkpoint": {"path": "somewhere/last.ckpt", "sha256": "c0ffee" * 10, "step": 900},
    "data_fingerprint": "f00d" * 8,
    "commit": "badcafe",
    "missing": {"lpips": "missing: no weights of VGG"},
}


def entry(psnr: float, **others: Any) -> dict[str, Any]:
    """A predictor's scores, PSNR of novel views given."""
    full = {"novel": {"psnr": psnr, "ssim": 0.5}, "reference": {"psnr": psnr + 5, "ssim": 0.75}}
    same = {"novel": {"psnr": psnr + 1, "ssim": 0.625}, "reference": {"psnr": psnr + 6, "ssim": 0.875}}
    return {"scenes": 20, "views": 80, "full": full, "object": same} | others


Write = Callable[..., Path]


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    folder = tmp_path / "runs"
    folder.mkdir()
    return folder


@pytest.fixture
def run(runs: Path) -> Write:
    """Writes the results of one test; the model's PSNR, entries of other predictors, and changes to the protocol."""

    def write(folder: str, psnr: float, others: dict[str, Any] | None = None, /, **protocol: Any) -> Path:
        seconds = {"inference": 0.0157, "rendering": 246.0}
        results = {"protocol": PROTOCOL | protocol, "model": entry(psnr, seconds=seconds), **(others or {})}
        path = runs / folder / "metrics.json"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps(results))
        return path

    return write
