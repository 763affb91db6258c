"""Fixtures that several folders of tests use."""

import os
from dataclasses import dataclass
from pathlib import Path

import pytest
from support import SMALL, call

from completesplat.data.toy import write_objects

# W&B would go on reading what later tests of the process print, and complain in their logs that its run has ended.
os.environ.setdefault("WANDB_CONSOLE", "off")


@pytest.fixture(scope="session")
def toy_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Root of a CO3D tree with the category `toy_objects`: 4 sequences (2 train, 1 val, 1 test), 4 frames, 32 px."""
    root = tmp_path_factory.mktemp("toy")
    write_objects(root, scenes=4, frames=4, size=32, seed=0, workers=1, progress=False)
    return root


@dataclass(frozen=True)
class Pipeline:
    """Both stages, trained for two steps: run directories of the real thing, with no skill."""

    toy: Path
    var: Path
    diffusion: Path

    @property
    def weights(self) -> Path:
        return self.diffusion / "weights"

    def photograph(self) -> Path:
        return sorted(self.toy.glob("*/*/images/*.jpg"))[0]


@pytest.fixture(scope="session")
def pipeline(toy_root, tmp_path_factory):
    runs = tmp_path_factory.mktemp("runs")
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(runs)
        fit = ["fit", f"data.root={toy_root}", *SMALL]
        assert call(monkeypatch, *fit, "experiment=toy_var", f"out={runs / 'var'}") == 0
        stage1 = runs / "var/checkpoints/last.ckpt"
        stage2 = ["experiment=toy_diffusion", f"model.autoreconstructor_checkpoint={stage1}", "sampler.steps=2"]
        assert call(monkeypatch, *fit, *stage2, f"out={runs / 'diffusion'}") == 0
    return Pipeline(toy_root, runs / "var", runs / "diffusion")


@pytest.fixture(scope="session")
def packed_toys(pipeline, tmp_path_factory) -> Path:
    """The pipeline's scenes, packed."""
    store = tmp_path_factory.mktemp("packed") / "store"
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(store.parent)
        given = ["data=toy_objects", f"data.root={pipeline.toy}", "data.image_size=32", "workers=1"]
        assert call(monkeypatch, "data", "prepare", *given, f"out={store}") == 0
    return store


@pytest.fixture(scope="session")
def latent_cache(pipeline, packed_toys, tmp_path_factory) -> Path:
    """The training set, encoded by the pipeline's stage 1."""
    cache = tmp_path_factory.mktemp("latents") / "cache"
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.chdir(cache.parent)
        given = [f"ckpt={pipeline.var / 'checkpoints/last.ckpt'}", f"overrides=['data.root={packed_toys}']"]
        assert call(monkeypatch, "data", "latents", *given, f"out={cache}") == 0
    return cache


@dataclass(frozen=True)
class Finished:
    """What a command left behind."""

    status: int
    out: str
    err: str


@pytest.fixture
def command(capfd, monkeypatch, tmp_path):
    """Run `completesplat` in this process, from an empty folder."""
    monkeypatch.chdir(tmp_path)

    def run(*arguments: str) -> Finished:
        capfd.readouterr()
        status = call(monkeypatch, *arguments)
        return Finished(status, *capfd.readouterr())

    return run
