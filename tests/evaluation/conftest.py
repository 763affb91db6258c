"""Folders of results with known figures: as `test` and `fit` write them, and sweeps as `fit -m` leaves them."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

PROTOCOL: dict[str, Any] = {"name": "images", "method": "VariationalAutoReconstructor", "data_set": "toy_objects"}
PROTOCOL |= {"image_size": 64, "resolution": 64, "scenes": 20, "skipped": 0, "views": 80, "samples": 1, "sampler": None}
PROTOCOL |= {"data_fingerprint": "f00d" * 8, "missing": {"lpips": "missing: no weights of VGG"}}


def entry(psnr: float) -> dict[str, Any]:
    """A predictor's scores with a PSNR of novel views."""
    full = {"novel": {"psnr": psnr, "ssim": 0.5}, "reference": {"psnr": psnr + 5, "ssim": 0.75}}
    same = {"novel": {"psnr": psnr + 1, "ssim": 0.625}, "reference": {"psnr": psnr + 6, "ssim": 0.875}}
    return {"scenes": 20, "views": 80, "full": full, "object": same}


Write = Callable[..., Path]


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    folder = tmp_path / "runs"
    folder.mkdir()
    return folder


@pytest.fixture
def run(runs: Path) -> Write:
    """Writes the results of one test: PSNR of the model and of other predictors, and changes to the protocol."""

    def write(folder: str, psnr: float, others: dict[str, float] | None = None, /, **protocol: Any) -> Path:
        model = entry(psnr) | {"seconds": {"inference": 0.0157, "rendering": 246.0}}
        predictors = {name: entry(value) for name, value in (others or {}).items()}
        path = runs / folder / "metrics.json"
        path.parent.mkdir(parents=True)
        path.write_text(json.dumps({"protocol": PROTOCOL | protocol, "model": model, **predictors}))
        return path

    return write


COMMAND = ["completesplat fit", "-m", "experiment=small", "ablation=full,no_skips", "data.root=/home/someone/data/set"]
CONFIG = {"seed": 0, "batch": 1, "out": "", "data": {"root": ""}, "model": {}, "trainer": {"max_steps": 9}}


def predictor(full_novel_psnr: float, scenes: int = 40, **others: float) -> dict[str, Any]:
    """An entry of `Evaluation.results`, given by `region_view_metric`."""
    entry: dict[str, Any] = {"scenes": scenes, "views": 4 * scenes}
    for name, value in ({"full_novel_psnr": full_novel_psnr} | others).items():
        region, view, metric = name.split("_")
        entry.setdefault(region, {}).setdefault(view, {})[metric] = value
    return entry


GROUPS = ("experiment", "ablation", "model", "data/source")


class Sweep:
    """A folder to which jobs are added."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.count = 0

    def add(self, *overrides: str, test: dict[str, Any] | None = None, commit: str = "c0ffee", steps: int = 9) -> Path:
        """A job; unfinished without results of its test."""
        job = self.folder / f"job={self.count}"
        job.mkdir(parents=True)
        self.count += 1
        OmegaConf.save(OmegaConf.create(CONFIG), job / "config.yaml")
        places = ["data.root=/home/someone/data/set", f"out={self.folder}", "ckpt_path=last"]
        given = ["experiment=small", *overrides, *places]
        choices = (override.lstrip("+").partition("=") for override in given)
        record = {
            "command": COMMAND,
            "commit": commit,
            "overrides": given,
            "verb": "fit",
            "groups": {key: option for key, _, option in choices if key in GROUPS},
            "sweep": {"folder": "..", "job": self.count - 1},
        }
        (job / "run.json").write_text(json.dumps(record))
        if test is not None:
            summary = {"steps": steps, "epochs": 1, "val/psnr_novel": 20.0, "test": test}
            (job / "metrics.json").write_text(json.dumps(summary))
        return job

    def scored(
        self, *overrides: str, psnr: float, scenes: int = 40, steps: int = 9, resolution: int = 64, **others: float
    ) -> Path:
        """A finished job, with both naive predictors."""
        protocol = PROTOCOL | {"scenes": scenes, "resolution": resolution}
        naive = {"mean_image": predictor(15.0, scenes), "copy_reference": predictor(12.0, scenes)}
        tested = {"model": predictor(psnr, scenes, **others), "protocol": protocol}
        return self.add(*overrides, test=tested | naive, steps=steps)


@pytest.fixture
def sweep(tmp_path: Path) -> Sweep:
    return Sweep(tmp_path / "sweep")


@pytest.fixture
def ablations(sweep: Sweep) -> Sweep:
    """Two ablations with three seeds each and the full method, better than both."""
    offsets = {"0": 0.0, "1": 0.25, "2": 1.25}
    for ablation, psnr in {"full": 22.0, "no_skips": 18.5, "m1": 20.0}.items():
        for seed, offset in offsets.items():
            figures = {"full_novel_ssim": 0.5 + psnr / 100, "object_novel_psnr": psnr - 2 + offset}
            sweep.scored(f"ablation={ablation}", f"seed={seed}", psnr=psnr + offset, **figures)
    return sweep
