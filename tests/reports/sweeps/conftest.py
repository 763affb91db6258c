"""Folders of sweeps, as `completesplat fit -m` leaves them, with known figures."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
from omegaconf import OmegaConf

COMMAND = ["completesplat fit", "-m", "experiment=small", "ablation=full,no_skips", "data.root=/home/someone/data/set"]
CONFIG = {
    "seed": 0,
    "batch": 1,
    "ckpt_path": None,
    "out": "",
    "data": {"root": ""},
    "model": {},
    "trainer": {"max_steps": 9},
}
NAIVE = {"mean_image": 15.0, "copy_reference": 12.0}


def predictor(full_novel_psnr: float, scenes: int = 40, **others: float) -> dict[str, Any]:
    """An entry of `Evaluation.results`, given by `region_view_metric`."""
    entry: dict[str, Any] = {"scenes": scenes, "views": 4 * scenes}
    for name, value in ({"full_novel_psnr": full_novel_psnr} | others).items():
        region, view, metric = name.split("_")
        entry.setdefault(region, {}).setdefault(view, {})[metric] = value
    return entry


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
        given = [
            "experiment=small",
            *overrides,
            "data.root=/home/someone/data/set",
            f"out={self.folder}",
            "ckpt_path=last",
        ]
        record = {"command": COMMAND, "commit": commit, "overrides": given}
        (job / "run.json").write_text(json.dumps(record))
        if test is not None:
            summary = {"steps": steps, "epochs": 1, "val/psnr_novel": 20.0, "test": test}
            (job / "metrics.json").write_text(json.dumps(summary))
        return job

    def scored(self, *overrides: str, psnr: float, scenes: int = 40, steps: int = 9, **others: float) -> Path:
        """A finished job, with both naive predictors."""
        naive = {name: predictor(value, scenes) for name, value in NAIVE.items()}
        return self.add(*overrides, test={"model": predictor(psnr, scenes, **others)} | naive, steps=steps)

    def plan(self, overrides: Sequence[str]) -> None:
        """What hydra writes down when the sweep starts."""
        self.folder.mkdir(exist_ok=True)
        planned = {"hydra": {"overrides": {"task": list(overrides)}}, "out": "${somewhere:}"}
        OmegaConf.save(OmegaConf.create(planned), self.folder / "multirun.yaml")


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


@pytest.fixture
def written() -> Callable[[Sweep], str]:
    """Writes a sweep's summary and gives the Markdown."""

    def write(sweep: Sweep) -> str:
        from completesplat.results.sweeps import write_summary

        write_summary(sweep.folder)
        return (sweep.folder / "summary.md").read_text()

    return write
