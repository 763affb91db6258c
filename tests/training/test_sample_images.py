from dataclasses import replace

import numpy as np
import pandas
import pytest
import torch
from hydra.utils import instantiate
from picture_sheets import cells
from PIL import Image
from support import SMALL, compose_config

from completesplat.metrics.images import PSNR_LIMIT, psnr
from completesplat.metrics.scoring import diversity
from completesplat.training.fixed_scenes import fixed_scenes
from completesplat.training.sample_images import SceneDrawings, evenly_spaced, samples_sheet, strip_sheet

SIDE = 32


@pytest.mark.parametrize(("count", "most"), [(50, 8), (50, 1), (3, 8)])
def test_what_is_kept_is_evenly_spaced_and_ends_with_the_last(count, most):
    chosen = evenly_spaced(count, most)
    assert (chosen[-1], len(chosen)) == (count - 1, min(count, most))
    assert most == 1 or (chosen[0] == 0 and np.ptp(np.diff(chosen)) <= 1)


def some_drawings(samples: int = 2, views: int = 3) -> SceneDrawings:
    pictures = torch.rand(1 + samples, views, 3, SIDE, SIDE)
    strip = torch.rand(4, 2, 3, SIDE, SIDE)
    return SceneDrawings(pictures[0], pictures[1:], torch.ones(1, views, 1, SIDE, SIDE), [999, 499, 0], strip)


def assert_shows(found: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(found, expected, atol=0.5 / 255 + 1e-5, rtol=0)


def test_rows_are_true_pictures_samples_and_depths_scene_by_scene_and_strips_of_two_views():
    drawn = [some_drawings(), some_drawings(views=2)]
    found, strips = (cells(sheet(drawn), SIDE, SIDE) for sheet in (samples_sheet, strip_sheet))
    assert (found.shape[:2], strips.shape[:2]) == ((8, 3), (4, 4))
    for top, scene, rows in zip((0, 4), drawn, strips.split(2), strict=True):
        views = len(scene.true)
        assert_shows(found[top, :views], scene.true)
        assert_shows(found[top + 1 : top + 3, :views], scene.samples)
        assert_shows(rows.transpose(0, 1), scene.strip)
    assert (found[4:, 2] == 1).all()


def test_scores_are_of_novel_views():
    scene = some_drawings()
    assert scene.scores()["diversity"] == diversity(scene.samples[:, 1:])
    symmetric = scene.true + torch.tensor([0.1, -0.1]).view(2, 1, 1, 1, 1)
    symmetric[:, 0] = 0
    scores = replace(scene, samples=symmetric).scores()
    assert scores["psnr"] == pytest.approx(20, abs=1e-3)
    assert scores["psnr_of_mean"] == PSNR_LIMIT
    assert scores["diversity"] == pytest.approx(0.2, abs=1e-5)
    assert "diversity" not in replace(scene, samples=symmetric[:1]).scores()


def test_a_run_leaves_samples_and_what_they_score(pipeline):
    run = pipeline.diffusion
    assert {path.name for path in (run / "samples").iterdir()} == {"step_000002.png", "strip_000002.png"}
    assert not (pipeline.var / "samples").exists()
    data = instantiate(compose_config("fit", f"data.root={pipeline.toy}", *SMALL).data, _convert_="all")
    data.setup("fit")
    # One validation scene with two targets, four samples, two denoising steps.
    (scene,) = fixed_scenes(data.val_dataloader(), 2, 8)
    found = cells(Image.open(run / "samples/step_000002.png"), SIDE, SIDE)
    assert found.shape[:2] == (1 + 4 + 1, 3)
    assert_shows(found[0, 0], scene.reference.images)
    assert_shows(found[0, 1:], scene.targets.images)
    strip = cells(Image.open(run / "samples/strip_000002.png"), SIDE, SIDE)
    assert strip.shape[:2] == (2, 3)
    assert_shows(strip[:, 0], torch.stack([scene.reference.images, scene.targets.images[1]]))
    # DDIM ends at its last estimate.
    torch.testing.assert_close(strip[:, -1], found[1, [0, 2]], atol=1.5 / 255, rtol=0)

    table = pandas.read_csv(run / "metrics.csv")
    columns = [column for column in table if column.startswith("samples/")]
    (row,) = table[["step", *columns]].dropna().to_dict("records")
    assert row["step"] == 1
    samples, true = found[1:5, 1:], scene.targets.images
    assert row["samples/diversity"] == pytest.approx(diversity(samples), abs=2e-3)
    assert row["samples/diversity"] > 0
    assert row["samples/psnr_of_mean"] == pytest.approx(psnr(samples.mean(0), true).mean().item(), abs=0.02)
    each = psnr(samples.flatten(0, 1), true.expand_as(samples).flatten(0, 1))
    assert row["samples/psnr"] == pytest.approx(each.mean().item(), abs=0.02)
