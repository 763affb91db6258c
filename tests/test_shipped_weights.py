"""The weights that come with the package: whole, small, and better than guessing on scenes never seen."""

import os

import pytest
import torch
from support import strict_json

from completesplat.data.toy.module import ToyObjectsDataModule
from completesplat.generator import CompleteSplat
from completesplat.metrics.images import psnr
from completesplat.opening import locate
from completesplat.rasterizers.tiled import TiledRasterizer
from completesplat.training.stage import copy_reference, repeat_image
from completesplat.weights import SHIPPED, SUMS_FILE, shipped

NAME = "toy_objects"


def test_they_are_small_and_complete():
    assert list(shipped()) == [NAME]
    assert sum(path.stat().st_size for path in SHIPPED.rglob("*") if path.is_file()) < 16e6
    assert (SHIPPED / NAME / SUMS_FILE).is_file()
    assert locate(NAME).parent == SHIPPED / NAME


def test_samples_fit_the_image_they_are_drawn_for(tmp_path, monkeypatch):
    """Two scenes of another seed than training's: the reference view is met, the naive answers are beaten."""
    monkeypatch.setattr(os, "cpu_count", lambda: 1)  # so that no process has to be started
    size = {"scenes": 20, "frames": 4, "image_size": 64}
    data = ToyObjectsDataModule(str(tmp_path), make=True, **size, data_seed=77, evaluation_batch_size=2)
    data.prepare_data()
    data.setup("test")
    scenes = next(iter(data.test_dataloader()))
    model, truth = CompleteSplat.from_pretrained(NAME), scenes.all_views()
    given = scenes.reference.images, scenes.reference.cameras, scenes.depth_range
    with torch.no_grad():
        images = TiledRasterizer()(model.generate(*given, steps=5), truth.cameras).over(0.5)
    drawn, mean, copied = (
        psnr(other.flatten(0, 1).clamp(0, 1), truth.images.flatten(0, 1)).unflatten(0, truth.images.shape[:2])
        for other in (images, repeat_image(data.mean_image(), scenes), copy_reference(scenes))
    )
    assert drawn[:, 0].min() > 21
    assert drawn[:, 1:].mean() > mean[:, 1:].mean() + 1
    assert drawn[:, 1:].mean() > copied[:, 1:].mean() + 1


@pytest.mark.slow
def test_they_score_as_the_card_says(command, tmp_path):
    """One sample of each of 12 scenes: all pixels and object pixels, against both naive answers."""
    given = [
        "data=toy_objects",
        f"data.root={tmp_path / 'data'}",
        "data.make=true",
        "data.scenes=120",
        "data.data_seed=77",
    ]
    assert command("test", f"weights={NAME}", *given, f"out={tmp_path / 'scores'}").status == 0
    scores = strict_json(tmp_path / "scores/metrics.json")
    for region in ("full", "object"):
        ours, mean, copied = (
            scores[name][region]["novel"]["psnr"] for name in ("model", "mean_image", "copy_reference")
        )
        assert ours > mean + 2
        assert ours > copied + 2
