import math
from dataclasses import replace

import pytest
import torch

from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import Cameras
from completesplat.metrics.image_sets import Patches
from completesplat.metrics.images import Missing
from completesplat.metrics.scoring import Evaluation
from completesplat.scene import SceneBatch, Views


def scenes(batch: int, targets: int, first: int = 0) -> SceneBatch:
    def views(*axes: int) -> Views:
        cameras = Cameras(torch.eye(4).expand(*axes, 4, 4), torch.eye(3).expand(*axes, 3, 3), (16, 16))
        mask = torch.zeros(*axes, 1, 16, 16)
        mask[..., :8, :] = 1
        return Views(torch.full((*axes, 3, 16, 16), 0.5), cameras, mask)

    names = tuple(f"scene {first + i}" for i in range(batch))
    depth_range, visible = torch.tensor([[1.0, 2.0]]).expand(batch, 2), torch.ones(batch, 1, 16, 16)
    frames = torch.zeros(batch, dtype=torch.int64)
    return SceneBatch(views(batch), views(batch, targets), depth_range, visible, frames, names)


def test_views_are_averaged_within_scenes_before_scenes_are():
    evaluation = Evaluation()
    for targets, error in ((1, 0.1), (3, 0.01)):
        images = torch.full((1, 1 + targets, 3, 16, 16), 0.5 + error)
        evaluation.update("model", images, scenes(1, targets, first=targets))
    results = evaluation.results()["model"]
    assert results["full"]["novel"]["psnr"] == pytest.approx(30, abs=1e-3)
    assert (results["scenes"], results["views"]) == (2, 4)


def test_reference_and_novel_views_are_apart():
    images = torch.full((1, 3, 3, 16, 16), 0.5)
    images[:, 0] += 0.1
    evaluation = Evaluation()
    evaluation.update("model", images, scenes(1, 2))
    results = evaluation.results()["model"]["full"]
    assert results["reference"]["psnr"] == pytest.approx(20, abs=1e-3)
    assert results["novel"]["psnr"] == 100


def test_object_scores_ignore_the_background():
    images = torch.full((1, 2, 3, 16, 16), 0.6)
    images[..., 8:, :] = 0.0
    evaluation = Evaluation()
    evaluation.update("model", images, scenes(1, 1))
    results = evaluation.results()["model"]
    # An error of 0.1 on the object's half of the image, both backgrounds black.
    assert results["object"]["novel"]["psnr"] == pytest.approx(-10 * math.log10(0.01 / 2), abs=1e-3)
    assert results["full"]["novel"]["psnr"] == pytest.approx(-10 * math.log10((0.01 + 0.25) / 2), abs=1e-3)


def test_values_out_of_range_are_clipped():
    images = torch.full((1, 2, 3, 16, 16), 7.0)
    evaluation = Evaluation()
    evaluation.update("model", images, scenes(1, 1))
    assert evaluation.results()["model"]["full"]["novel"]["psnr"] == pytest.approx(-10 * math.log10(0.25), abs=1e-3)


def test_the_precision_of_networks_is_not_that_of_metrics():
    generator = torch.Generator().manual_seed(0)
    batch = scenes(1, 1)
    images = 0.5 + 0.02 * torch.rand(1, 2, 3, 16, 16, generator=generator)
    seen = SceneBatch(**{**vars(batch), "targets": Views(images[:, 1:], batch.targets.cameras, batch.targets.masks)})
    evaluation = Evaluation()
    with torch.autocast("cpu", torch.bfloat16):
        evaluation.update("model", images, seen)
    assert evaluation.results()["model"]["full"]["novel"]["ssim"] == pytest.approx(1, abs=1e-4)


def off_by(*errors: float) -> torch.Tensor:
    """Samples of one scene, [sample view 3 height width]; the truth is 0.5 everywhere."""
    return torch.stack([torch.full((3, 3, 16, 16), 0.5 + error) for error in errors])


def test_of_several_samples_the_first_the_best_and_the_mean_are_told():
    evaluation = Evaluation(samples=3)
    evaluation.update_samples("scene", off_by(0.1, 0.01, 0.001), scenes(1, 2).all_views()[0])
    results = evaluation.results()
    psnr = {row: results[row]["full"]["novel"]["psnr"] for row in results}
    assert psnr == {key: pytest.approx(value, abs=1e-2) for key, value in zip(psnr, (20, 60, 40), strict=True)}
    assert list(psnr) == ["model", "best_of_k", "mean_of_k"]
    # Of two of the three samples the better one has 40 dB once and 60 dB twice.
    assert results["best_of_k"]["curve"] == pytest.approx([40, (40 + 60 + 60) / 3, 60], abs=1e-2)
    assert results["mean_of_k"]["diversity"] == pytest.approx((0.09 + 0.099 + 0.009) / 3, abs=1e-5)


def test_the_best_is_chosen_by_the_criterion():
    generator = torch.Generator().manual_seed(0)
    batch = scenes(1, 1)
    texture = 0.2 * torch.rand(1, 2, 3, 16, 16, generator=generator)
    truth = batch.all_views()[0]
    object.__setattr__(truth, "images", truth.images + texture[0])
    flat, brighter = torch.full((2, 3, 16, 16), 0.6), truth.images + 0.15
    chosen = {}
    for criterion in ("psnr", "ssim"):
        evaluation = Evaluation(samples=2, criterion=criterion)
        evaluation.update_samples("scene", torch.stack([flat, brighter]), truth)
        results = evaluation.results()
        chosen[criterion] = results["best_of_k"]["full"]["novel"]["psnr"] == results["model"]["full"]["novel"]["psnr"]
    assert chosen == {"psnr": True, "ssim": False}


@pytest.mark.parametrize("count", [1, 2, 5])
def test_scenes_that_two_processes_scored_count_once_and_as_in_one(monkeypatch, count):
    def scored(names: list[int]) -> Evaluation:
        evaluation = Evaluation(samples=2, sets={"swd": Patches(patches=2)})
        for index in names:
            images = torch.rand(2, 3, 3, 16, 16, generator=torch.Generator().manual_seed(index))
            evaluation.update_samples(f"scene {index}", images, scenes(1, 2).all_views()[0])
        return evaluation

    alone, first, second = (
        scored(list(range(count))),
        scored(list(range(0, count, 2))),
        scored(list(range(1, count, 2))),
    )
    second.skipped = 1
    second.update_samples("scene 0", torch.rand(2, 3, 3, 16, 16), scenes(1, 2).all_views()[0])  # padding, as it were
    states = [(e.scores, e.views, e.drawn, e.sets.kept, e.skipped) for e in (second, first)]
    monkeypatch.setattr("completesplat.metrics.scoring.gathered", lambda own: states)
    first.gather()
    assert first.results() == alone.results()
    assert first.results()["model"]["scenes"] == count
    assert first.skipped == 1


def test_the_same_pictures_have_the_same_scores_whatever_the_seed():
    images = torch.rand(1, 3, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    found = []
    for seed in (0, 1):
        evaluation = Evaluation(seed=seed, sets={"swd": Patches(patches=2)})
        evaluation.update("copy_reference", images, scenes(1, 2))
        found.append(evaluation.results())
    assert found[0] == found[1]


def test_what_is_missing_is_named_and_has_no_figure():
    evaluation = Evaluation(
        perceptual=Missing("no weights", ("lpips",)), sets={"inception": Missing("none here", ("fid", "kid"))}
    )
    evaluation.update("model", torch.full((1, 2, 3, 16, 16), 0.5), scenes(1, 1))
    assert evaluation.missing == {"lpips": "missing: no weights"} | dict.fromkeys(("fid", "kid"), "missing: none here")
    assert set(evaluation.results()["model"]["full"]["novel"]) == {"psnr", "ssim"}


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"samples": 0}, "samples=0: must be at least 1"),
        ({"criterion": "beauty"}, "criterion=beauty: choose one of psnr, ssim"),
        (
            {"criterion": "lpips", "perceptual": Missing("no weights", ("lpips",))},
            "criterion=lpips: missing: no weights",
        ),
    ],
)
def test_settings_without_a_meaning_are_refused(settings, said):
    with pytest.raises(CompleteSplatError, match=said):
        Evaluation(**settings)


def test_depth_is_scored_where_the_truth_is_known():
    evaluation = Evaluation()
    true = torch.full((3, 1, 16, 16), 2.0)
    true[1, :, :, 8:] = 0  # unknown
    true[2] = 0
    masks = torch.zeros(3, 1, 16, 16)
    masks[..., :8, :] = 1
    predicted = torch.full((3, 1, 16, 16), 2.2)
    predicted[:, :, 8:] = 4.0
    predicted[1, :, :, 8:] = 99.0
    evaluation.update("model", torch.full((1, 3, 3, 16, 16), 0.5), scenes(1, 2))
    evaluation.update_depth("scene 0", predicted, replace(scenes(1, 2).all_views()[0], depths=true, masks=masks))
    full, of_object = (evaluation.results()["model"][region]["novel"] for region in ("full", "object"))
    assert full["depth_abs_rel"] == pytest.approx((0.1 + 1) / 2)
    assert of_object["depth_abs_rel"] == pytest.approx(0.1)
    assert (full["depth_delta1"], of_object["depth_delta1"]) == (pytest.approx(0.5), pytest.approx(1))
    assert evaluation.results()["model"]["object"]["reference"]["depth_rmse"] == pytest.approx(0.2)
