"""The benchmark on constructed predictors, and samples of real models as renders."""

from dataclasses import replace

import pytest
import torch
from scenes_for_training import scene_batch
from support import tiny_generator

from completesplat.data.loading.hidden_modes import HiddenModes, HiddenModeScenes
from completesplat.errors import CompleteSplatError, DataError
from completesplat.evaluation.mode_benchmark import measure, predictors, usable_scenes
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras
from completesplat.losses import WeightedSum
from completesplat.losses.terms import MeanSquaredError
from completesplat.rasterizers import Rendering
from completesplat.scene import SceneBatch
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.reconstruction import ReconstructionModule

SIZE, MODES, SAMPLES = 32, 4, 8


def hidden_scene(seed: int) -> HiddenModes:
    """Three targets, of which the last two show modes of random colours in a square."""
    scene = scene_batch(1, targets=3, seed=seed, size=SIZE)
    images = scene.targets.images[0, 1:]
    region = torch.zeros(2, SIZE, SIZE, dtype=torch.bool)
    region[:, 4:9, 10:17] = True
    colors = torch.rand(MODES, 1, 3, 1, 1, generator=torch.Generator().manual_seed(seed + 2))
    truths = torch.where(region[:, None], colors, images)
    images[:] = truths[1]
    unseen = torch.zeros(3, SIZE, SIZE, dtype=torch.bool)
    unseen[1:] = region
    even = torch.full((MODES,), 1 / MODES)
    return HiddenModes(scene, (1, 2), truths, region, even, unseen, ("a", "b", "c", "d"), true_mode=1)


SCENES = [hidden_scene(seed) for seed in range(2)]
BY_NAME = {scene.scene.names[0]: scene for scene in SCENES}


def renders(scene: SceneBatch, modes: list[int]) -> torch.Tensor:
    """The true images, with one mode after the other where they can be seen."""
    images = scene.targets.images[0].repeat(SAMPLES, 1, 1, 1, 1)
    images[:, 1:] = BY_NAME[scene.names[0]].truths[(modes * SAMPLES)[:SAMPLES]]
    return images


def measured(modes: list[int], scenes=SCENES):
    return measure({"model": lambda scene, other, seed: renders(scene, modes)}, scenes, SAMPLES, 0, 1, 3)


def test_constructed_predictors_have_their_scores():
    perfect = measured([0, 1, 2, 3]).results(SAMPLES)
    full = {"coverage": 1, "total_variation": 0, "mode_distance": 0, "rejected": 0, "scenes": 2, "samples": SAMPLES}
    assert {name: value for name, value in perfect["model"].items() if "energy" not in name} == full
    # The truth is one of the samples' four modes: less than always another one, and than their mean.
    other, mean = measured([2]).results(SAMPLES)["model"], perfect["mean_predictor"]
    assert perfect["model"]["energy_hidden"] < mean["energy_hidden"] < other["energy_hidden"]
    assert perfect["model"]["energy_visible"] == pytest.approx(0, abs=1e-12)
    collapsed = measured([2]).results(SAMPLES)["model"]
    assert (collapsed["coverage"], collapsed["total_variation"]) == (1 / MODES, 1 - 1 / MODES)
    assert (collapsed["mode_distance"], collapsed["rejected"]) == (0, 0)
    mean, true = perfect["mean_predictor"], perfect["true_sampler"]
    assert (mean["coverage"], mean["total_variation"], mean["rejected"]) == (0, 1, 1)
    assert mean["mode_distance"] == pytest.approx(1)
    assert (true["mode_distance"], true["rejected"]) == (0, 0)
    assert 0 < true["total_variation"] < 0.6


def test_of_one_scene_there_is_no_other():
    predictors = {name: lambda scene, other, seed: renders(scene, [0]) for name in ("model", "other_scene")}
    for scenes in (SCENES, SCENES[:1]):
        results = measure(predictors, scenes, SAMPLES, 0, 1, 3).results(SAMPLES)
        assert ("other_scene" in results) == (len(scenes) > 1)


def test_shares_are_of_all_scenes_with_the_same_probabilities():
    often = replace(hidden_scene(1), probabilities=torch.tensor([0.5, 0.25, 0.25, 0.0]))
    modes = [0, 1, 2, 0]  # right for the second scene, and not for the first, whose modes are equally probable
    even, uneven = measured([*modes], [SCENES[0], often]).shares()["model"]
    assert (even["shares"], even["scenes"], even["total_variation"]) == ([0.5, 0.25, 0.25, 0], 1, 0.25)
    assert (uneven["probabilities"], uneven["total_variation"]) == ([0.5, 0.25, 0.25, 0], 0)
    (pooled,) = measured([2]).shares()["model"]
    assert (pooled["shares"], pooled["scenes"], pooled["rejected"]) == ([0, 0, 1, 0], 2, 0)
    (blurred,) = measured([2]).shares()["mean_predictor"]
    assert (blurred["rejected"], blurred["total_variation"]) == (1, 1)


def test_the_figure_shows_the_class_of_each_sample():
    (row,) = measured([3, 0, 1, 1]).rows
    assert [cell.label for cell in row] == ["scene 0 0", "a", "b (true)", "c", "d", "d", "a", "b"]
    assert torch.equal(torch.stack([cell.image for cell in row[1:]]), SCENES[0].truths[[0, 1, 2, 3, 3, 0, 1], 0])


def test_scenes_of_no_use_are_counted():
    class Broken(HiddenModeScenes):
        def __init__(self, scenes=()):
            self.scenes = list(scenes)

        def __len__(self):
            return len(self.scenes)

        def __getitem__(self, index):
            if index == 1:
                raise DataError("broken", sequence="bad")
            return self.scenes[index]

    scenes = Broken([SCENES[0], None, SCENES[1]])
    assert usable_scenes(scenes, None) == (SCENES, ["bad: broken"])
    assert usable_scenes(scenes, 1) == (SCENES[:1], [])
    with pytest.raises(CompleteSplatError, match="no test scene can be used"):
        usable_scenes(Broken(), None)


def flat(gaussians: Gaussians, cameras: Cameras) -> Rendering:
    """Images of one colour, the Gaussians' mean colour: all that is needed to tell samples apart."""
    shape = (*cameras.world_to_camera.shape[:2], 3, SIZE, SIZE)
    color = gaussians.colors.mean(1)[:, None, :, None, None].expand(shape)
    return Rendering(color, color[:, :, :1], torch.ones_like(color[:, :, :1]))


SURROUNDINGS = {"rasterizer": flat, "optimizer": torch.optim.SGD, "schedule": lambda *_: None}


def test_a_model_that_draws_gives_the_same_samples_in_batches_of_any_size():
    module = LatentDiffusion(tiny_generator(), **SURROUNDINGS).eval()
    with torch.no_grad():
        one, all_at_once = (
            predictors(module, 3, batch)["model"](SCENES[0].scene, SCENES[1].scene, 5) for batch in (1, 3)
        )
    assert one.shape == (3, 3, 3, SIZE, SIZE)
    assert torch.allclose(one, all_at_once, atol=1e-5)
    assert (one[0] - one[1]).abs().max() > 1e-4


def test_a_model_of_one_answer_repeats_it_and_its_posterior_does_not():
    loss = WeightedSum({"mse": {"weight": 1.0, "term": MeanSquaredError()}})
    module = ReconstructionModule(tiny_generator().autoreconstructor, loss, **SURROUNDINGS).eval()
    scene = SCENES[0].scene
    with torch.no_grad():
        several, at_once = (predictors(module, 3, batch) for batch in (2, 3))
        repeated, drawn = several["model"](scene, scene, 5), several["posterior_samples"](scene, scene, 5)
        expected = module.render(module.reconstruct(scene), scene.targets.cameras)[0].clamp(0, 1)
        together, others = (at_once["posterior_samples"](scene, scene, seed) for seed in (5, 6))
    assert torch.equal(repeated, expected.expand(3, -1, -1, -1, -1))
    assert torch.allclose(drawn, together, atol=1e-5)
    for other in (drawn[[1, 2, 0]], others, repeated):
        assert (drawn - other).abs().amax((1, 2, 3, 4)).min() > 1e-4
