"""Averages of scores over views and scenes, choice of samples, and metrics of the user's own."""

import math
from dataclasses import replace
from itertools import product

import pytest
import torch
from torchmetrics.image import PeakSignalNoiseRatio

from completesplat.errors import CompleteSplatError
from completesplat.evaluation.scene_scores import SceneScores
from completesplat.geometry.cameras import Cameras
from completesplat.metrics.image_sets import Inception
from completesplat.metrics.images import MissingMetrics, psnr, ssim
from completesplat.metrics.sample_scores import best_sample
from completesplat.scene import SceneBatch, Views

OURS = {"psnr": psnr, "ssim": ssim}
ABSENT = OURS | {"lpips": MissingMetrics("no weights", ("lpips",))}


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


def evaluated(images: torch.Tensor, **settings) -> dict:
    """Results of one scene's views, [view 3 height width], of which the first is the reference."""
    evaluation = SceneScores(**settings)
    evaluation.update("model", images[None], scenes(1, len(images) - 1))
    return evaluation.results()["model"]


def test_views_are_averaged_within_scenes_before_scenes_are():
    evaluation = SceneScores()
    for targets, error in ((1, 0.1), (3, 0.01)):
        images = torch.full((1, 1 + targets, 3, 16, 16), 0.5 + error)
        evaluation.update("model", images, scenes(1, targets, first=targets))
    results = evaluation.results()["model"]
    assert results["full"]["novel"]["psnr"] == pytest.approx(30, abs=1e-3)
    assert (results["scenes"], results["views"]) == (2, 4)


def test_reference_and_novel_views_are_apart_and_values_out_of_range_are_clipped():
    images = torch.full((3, 3, 16, 16), 0.5)
    images[0] = 7.0
    results = evaluated(images)["full"]
    assert results["reference"]["psnr"] == pytest.approx(-10 * math.log10(0.25), abs=1e-3)
    assert results["novel"]["psnr"] == 100


def test_without_a_given_view_all_views_are_novel():
    images = torch.full((3, 3, 16, 16), 0.5)
    images[0] = 0.6
    evaluation = SceneScores()
    evaluation.first_novel = 0
    evaluation.update("model", images[None], scenes(1, 2))
    results = evaluation.results()["model"]
    assert (results["views"], set(results["full"])) == (3, {"novel"})
    assert results["full"]["novel"]["psnr"] == pytest.approx((20 + 100 + 100) / 3, abs=1e-3)


def test_object_scores_ignore_the_background():
    images = torch.full((2, 3, 16, 16), 0.6)
    images[..., 8:, :] = 0.0
    results = evaluated(images)
    # An error of 0.1 on the object's half of the image, both backgrounds black.
    assert results["object"]["novel"]["psnr"] == pytest.approx(-10 * math.log10(0.01 / 2), abs=1e-3)
    assert results["full"]["novel"]["psnr"] == pytest.approx(-10 * math.log10((0.01 + 0.25) / 2), abs=1e-3)


def test_the_precision_of_networks_is_not_that_of_metrics():
    batch = scenes(1, 1)
    images = 0.5 + 0.02 * torch.rand(1, 2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    evaluation = SceneScores()
    with torch.autocast("cpu", torch.bfloat16):
        evaluation.update("model", images, replace(batch, targets=replace(batch.targets, images=images[:, 1:])))
    assert evaluation.results()["model"]["full"]["novel"]["ssim"] == pytest.approx(1, abs=1e-4)


def off_by(*errors: float) -> torch.Tensor:
    """Samples of one scene, [sample view 3 height width]; the truth is 0.5 everywhere."""
    return torch.stack([torch.full((3, 3, 16, 16), 0.5 + error) for error in errors])


def test_several_samples_have_rows_for_the_first_the_best_and_the_mean():
    evaluation = SceneScores(samples=3)
    evaluation.update_samples("scene", off_by(0.1, 0.01, 0.001), scenes(1, 2).all_views()[0])
    results = evaluation.results()
    psnr = {row: results[row]["full"]["novel"]["psnr"] for row in results}
    assert psnr == {key: pytest.approx(value, abs=1e-2) for key, value in zip(psnr, (20, 60, 60, 40), strict=True)}
    assert list(psnr) == ["model", "best_of_k", "best_of_k_by_metric", "mean_of_k"]
    # Of two of the three samples the better one has 40 dB once and 60 dB twice.
    assert results["best_of_k"]["curve"] == pytest.approx([40, (40 + 60 + 60) / 3, 60], abs=1e-2)
    assert results["mean_of_k"]["diversity"] == pytest.approx((0.09 + 0.099 + 0.009) / 3, abs=1e-5)


def test_noise_gains_in_the_best_of_k_what_a_noisy_mean_does_and_samples_that_differ_gain_more():
    truth, noise = scenes(1, 2).all_views()[0], 0.1 * torch.randn(8, 3, 3, 16, 16)
    for name, samples in {"noise": 0.5 + noise, "samples": off_by(*noise[:, 0, 0, 0, 0].tolist())}.items():
        evaluation = SceneScores(samples=8)
        evaluation.update_samples(name, samples, truth)
        row = evaluation.results()["best_of_k"]
        gain, noisy = row["curve"][-1] - row["curve"][0], row["curve_noisy_mean"][-1] - row["curve_noisy_mean"][0]
        assert len(row["curve_noisy_mean"]) == 8
        assert 0 < noisy < 0.5
        if name == "noise":  # the noisy mean is as far off as a sample
            assert row["curve_noisy_mean"][0] == pytest.approx(row["curve"][0], abs=1)
        assert gain < 0.5 if name == "noise" else gain > 3


def test_the_best_is_chosen_by_the_criterion():
    truth = scenes(1, 1).all_views()[0]
    texture = 0.2 * torch.rand(2, 3, 16, 16, generator=torch.Generator().manual_seed(0))
    truth = replace(truth, images=truth.images + texture)
    flat, brighter = torch.full((2, 3, 16, 16), 0.6), truth.images + 0.15
    chosen = {}
    for criterion in ("psnr", "ssim"):
        evaluation = SceneScores(samples=2, criterion=criterion)
        evaluation.update_samples("scene", torch.stack([flat, brighter]), truth)
        results = evaluation.results()
        chosen[criterion] = results["best_of_k"]["full"]["novel"]["psnr"] == results["model"]["full"]["novel"]["psnr"]
    assert chosen == {"psnr": True, "ssim": False}


class Brightness:
    """A set metric: the difference of the sets' mean values."""

    regions = ("full", "object")

    def describe(self, images):
        return images.mean((1, 2, 3))[:, None]

    def distances(self, true, predicted):
        return {"brightness": (true.mean() - predicted.mean()).abs().item()}

    def settings(self):
        return {}


def test_the_best_sample_is_that_of_a_region_for_all_metrics_or_that_of_each_metric():
    truth = scenes(1, 2).all_views()[0]  # the object is the upper half
    samples = torch.full((3, 3, 3, 16, 16), 0.5)
    samples[0, ..., :8, :] += 0.2
    samples[1, ..., :8, :] += 0.1
    samples[1, ..., 8:, :] += 0.4
    samples[2] += 0.3

    def far_from_0_8(predicted, true):
        return (predicted.amax((1, 2, 3)) - 0.8).abs()

    chosen = {"metrics": OURS | {"lpips": far_from_0_8}, "sets": {"brightness": Brightness()}}
    evaluation = SceneScores(samples=3, **chosen)
    evaluation.update_samples("scene", samples, truth)
    alone = []
    for sample in samples:
        single = SceneScores(**chosen)
        single.update("model", sample[None], scenes(1, 2))
        alone.append(single.results()["model"])
    results = evaluation.results()
    by_psnr = {region: [single[region]["novel"]["psnr"] for single in alone] for region in ("full", "object")}
    assert (best_sample(by_psnr["full"]), best_sample(by_psnr["object"])) == (0, 1)
    # By PSNR in the region: LPIPS, the sets and the reference view are that sample's.
    assert results["best_of_k"]["full"] == alone[0]["full"]
    assert results["best_of_k"]["object"] == alone[1]["object"]
    each = results["best_of_k_by_metric"]
    assert each["full"]["novel"].keys() == {"psnr", "ssim", "lpips"}  # a set of images has no best of a scene
    for region, by in ((region, metric) for region in by_psnr for metric in ("psnr", "ssim", "lpips")):
        values = [single[region]["novel"][by] for single in alone]
        assert each[region]["novel"][by] == (min if by == "lpips" else max)(values)
    assert each["full"]["novel"]["lpips"] < results["best_of_k"]["full"]["novel"]["lpips"]


def textured(targets: int) -> SceneBatch:
    """A scene of `scenes` whose views have noise on the object, the upper half, and an edge below it."""
    batch = scenes(1, targets)
    images = batch.targets.images.clone()
    images[..., :8, :] = torch.rand(1, targets, 3, 8, 16, generator=torch.Generator().manual_seed(0))
    images[..., 8:, :] = 0
    return replace(batch, targets=replace(batch.targets, images=images))


def test_sharpness_is_of_novel_views_and_leaves_out_the_objects_silhouette():
    batch, evaluation = textured(2), SceneScores(samples=2)
    truth = batch.all_views()[0]
    flat = truth.images.clone()
    flat[..., :8, :] = truth.images[..., :8, :].mean()  # no texture, the silhouette as it is
    evaluation.update_samples("scene", torch.stack([flat, truth.images]), truth)
    results = evaluation.results()
    assert results["model"]["object"]["novel"]["sharpness"] == 0
    assert results["model"]["full"]["novel"]["sharpness"] > 0  # of the silhouette alone
    assert results["best_of_k"]["object"]["novel"]["sharpness"] == 1
    assert results["mean_of_k"]["object"]["novel"]["sharpness"] == 0.5
    assert "sharpness" not in results["best_of_k_by_metric"]["full"]["novel"]  # no sample is the best by it
    assert "sharpness" not in results["model"]["full"]["reference"]


def test_missing_metrics_are_named_and_have_no_figure():
    absent = {"inception": MissingMetrics("none here", ("fid", "kid"))}
    evaluation = SceneScores(metrics=ABSENT, sets=absent)
    evaluation.update("model", torch.full((1, 2, 3, 16, 16), 0.5), scenes(1, 1))
    assert evaluation.missing == {"lpips": "missing: no weights"} | dict.fromkeys(("fid", "kid"), "missing: none here")
    assert set(evaluation.results()["model"]["full"]["novel"]) == {"psnr", "ssim"}


class Darker:
    """A metric of the user's own: the share of the counted pixels that are darker than the truth."""

    higher_is_better, heading, decimals = False, "darker", 1

    def __call__(self, predicted, true, masks):
        darker = (predicted < true).any(1, keepdim=True) & masks
        return darker.sum((1, 2, 3)) / masks.sum((1, 2, 3))


def darkness(predicted, true):
    return (true - predicted).mean((1, 2, 3))


def test_own_metrics_are_scored_for_each_region_and_view_beside_the_others_which_stay_as_they_are():
    truth = scenes(1, 2).all_views()[0]  # the object is the upper half
    samples = torch.full((2, 3, 3, 16, 16), 0.5)
    samples[0, 1:, :, :4] = 0.4
    samples[1, 1, :, 8:] = 0.4
    theirs = PeakSignalNoiseRatio(data_range=1.0)
    own = {"darker": Darker(), "of_darkness": darkness, "theirs": theirs, "left_out": None}
    evaluation, plain = SceneScores(samples=2, metrics=OURS | own), SceneScores(samples=2)
    for each in (evaluation, plain):
        each.update_samples("scene", samples, truth)
    results, known = evaluation.results(), plain.results()
    first, best = results["model"], results["best_of_k_by_metric"]
    assert first["full"]["novel"]["darker"] == 0.25
    assert first["object"]["novel"]["darker"] == 0.5
    assert first["full"]["reference"]["darker"] == 0
    assert best["full"]["novel"]["darker"] == 0.25  # of both samples
    assert best["object"]["novel"]["darker"] == 0
    assert first["full"]["novel"]["of_darkness"] == pytest.approx(0.1 / 4)
    assert "of_darkness" not in best["full"]["novel"]  # nobody said what is better
    assert first["full"]["novel"]["theirs"] == pytest.approx(first["full"]["novel"]["psnr"], abs=1e-4)
    assert theirs.total == 0  # nothing is kept between the scenes
    for predictor, region, view in product(known, ("full", "object"), ("novel", "reference")):
        scores = results[predictor][region][view]
        assert {name: x for name, x in scores.items() if name not in own} == known[predictor][region][view]
    formats = {name: (x.heading, x.better, x.decimals) for name, x in evaluation.formats.items()}
    assert formats == {
        "psnr": ("PSNR", "↑", 2),
        "ssim": ("SSIM", "↑", 3),
        "darker": ("darker", "↓", 1),
        "of_darkness": ("of_darkness", "", 3),
        "theirs": ("theirs", "↑", 3),
    }


def test_a_metric_without_a_number_has_no_best_sample_and_the_others_keep_theirs():
    class Undefined(Darker):
        def __call__(self, predicted, true):
            return torch.full((3,), math.nan)

    evaluation = SceneScores(samples=2, metrics=OURS | {"darker": Undefined()})
    evaluation.update_samples("scene", off_by(0.1, 0.01), scenes(1, 2).all_views()[0])
    results = evaluation.results()
    assert math.isnan(results["model"]["full"]["novel"]["darker"])
    assert results["best_of_k_by_metric"]["full"]["novel"].keys() == {"psnr", "ssim"}


def test_a_metric_that_gives_no_value_for_each_view_is_refused():
    evaluation = SceneScores(metrics={"psnr": psnr, "mean": lambda predicted, true: (predicted - true).mean()})
    with pytest.raises(CompleteSplatError, match=r"evaluation.metrics.mean: its values are \[\], not one .* 2 images"):
        evaluation.update("model", torch.full((1, 2, 3, 16, 16), 0.5), scenes(1, 1))


class Channels(torch.nn.Module):
    """A network in the place of Inception, whose features are the means of the channels."""

    def forward(self, pixels: torch.Tensor, return_features: bool) -> torch.Tensor:
        return pixels.float().mean((2, 3))


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_distances_of_a_single_image_are_missing_with_the_reason():
    for targets in (1, 2):
        evaluation = SceneScores(sets={"inception": Inception(torch.jit.script(Channels()))})
        evaluation.update("model", torch.full((1, 1 + targets, 3, 16, 16), 0.5), scenes(1, targets))
        distances = {"fid", "kid"} & evaluation.results()["model"]["full"]["novel"].keys()
        assert distances == (set() if targets == 1 else {"fid", "kid"})
        assert evaluation.missing.keys() == (set() if distances else {"fid", "kid"})
        assert all(x.startswith("missing: More than one sample is required") for x in evaluation.missing.values())


def test_a_set_metric_that_fails_or_gives_no_number_is_missing_and_the_others_are_kept():
    broken, endless = Brightness(), Brightness()
    broken.distances, broken.settings = lambda *_: 1 / 0, lambda: {"broken": {}}
    endless.distances = lambda *_: {"endless": math.nan}
    evaluation = SceneScores(sets={"a": broken, "b": endless, "c": Brightness()})
    evaluation.update("model", torch.full((1, 2, 3, 16, 16), 0.5), scenes(1, 1))
    assert set(evaluation.results()["model"]["full"]["novel"]) == {"psnr", "ssim", "brightness"}
    assert evaluation.missing == {"broken": "missing: division by zero", "endless": "missing: not finite (nan)"}


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"samples": 0}, "samples=0: must be at least 1"),
        ({"criterion": "beauty"}, "criterion=beauty: choose one of psnr, ssim"),
        ({"criterion": "lpips", "metrics": ABSENT}, "criterion=lpips: missing"),
        ({"criterion": "mine", "metrics": {"mine": darkness}}, "criterion=mine: the metric needs `higher_is_better`"),
        ({"metrics": OURS | {"sharpness": darkness}}, "metrics.sharpness: choose another name"),
        ({"metrics": OURS | {"a/b": darkness}}, "metrics.a/b: choose another name"),
        ({"metrics": OURS | {"mine": "mine.Mine"}}, "metrics.mine=mine.Mine: give evaluation.metrics.mine._target_"),
    ],
)
def test_settings_without_a_meaning_are_refused(settings, reason):
    with pytest.raises(CompleteSplatError, match=reason):
        SceneScores(**settings)


def test_depth_is_scored_where_the_truth_is_known():
    evaluation = SceneScores()
    true, masks, predicted = torch.full((3, 1, 16, 16), 2.0), torch.zeros(3, 1, 16, 16), torch.full((3, 1, 16, 16), 2.2)
    true[1, :, :, 8:] = 0  # unknown
    true[2] = 0
    masks[..., :8, :] = 1
    predicted[:, :, 8:] = 4.0
    predicted[1, :, :, 8:] = 99.0
    evaluation.update("model", torch.full((1, 3, 3, 16, 16), 0.5), scenes(1, 2))
    evaluation.update_depth("scene 0", predicted, replace(scenes(1, 2).all_views()[0], depths=true, masks=masks))
    full, of_object = (evaluation.results()["model"][region]["novel"] for region in ("full", "object"))
    assert (full["depth_abs_rel"], of_object["depth_abs_rel"]) == pytest.approx(((0.1 + 1) / 2, 0.1))
    assert (full["depth_delta1"], of_object["depth_delta1"]) == pytest.approx((0.5, 1))
    assert evaluation.results()["model"]["object"]["reference"]["depth_rmse"] == pytest.approx(0.2)
