import math
from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import imageio.v2 as imageio
import pandas
import pytest
import torch
from hydra.utils import instantiate
from image_sheets import cells
from PIL import Image
from scenes_for_training import SIZE, scene_batch
from support import SMALL, compose_config, round_gaussians

from completesplat.autoreconstructor.posterior import Posterior
from completesplat.errors import CompleteSplatError
from completesplat.export.placed_scene import PlacedScene
from completesplat.gaussians import Gaussians, merge_gaussians
from completesplat.geometry.cameras import pixel_rays
from completesplat.metrics.images import PSNR_LIMIT
from completesplat.metrics.sample_scores import diversity
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.scene import SceneBatch
from completesplat.training import fixed_scenes
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.viewer.sample import read_newest


def layer(scenes: SceneBatch, depth: float, opacity: float, colors: torch.Tensor) -> Gaussians:
    """A Gaussian on the ray of each pixel, smaller than the pixel, so that the rasterizer's blur alone widens it."""
    rays = pixel_rays(scenes.reference.cameras).flatten(1, 2)
    return round_gaussians(rays * depth, 1e-3, opacity, colors.flatten(2).mT.contiguous())


def two_layers(scenes: SceneBatch) -> Gaussians:
    red, blue = (torch.eye(3)[channel, :, None, None].expand_as(scenes.reference.images) for channel in (0, 2))
    return merge_gaussians([layer(scenes, 1.0, 0.9, red), layer(scenes, 3.0, 0.9, blue)])


def panels(gaussians: Gaussians, scenes: SceneBatch, background: float = 0.5) -> dict[str, torch.Tensor]:
    return fixed_scenes.scene_panels(ReferenceRasterizer(), gaussians, scenes, background)


def test_panels_are_input_target_error_and_layers():
    scenes = scene_batch()
    gaussians = two_layers(scenes)
    drawn = panels(gaussians, scenes, background=0.0)
    assert list(drawn) == ["input", "target", "render", "error x4", "depth", "opacity", "layer 1", "layer 2"]
    assert torch.equal(drawn["input"], scenes.reference.images)
    assert torch.equal(drawn["target"], scenes.targets.images[:, 0])
    for layer, channel in (("layer 1", 0), ("layer 2", 2)):
        assert ((drawn[layer] > 0.5).all((0, 2, 3)) == (torch.arange(3) == channel)).all()
        assert ((drawn[layer] == 0).all((0, 2, 3)) == (torch.arange(3) != channel)).all()
    rendering = ReferenceRasterizer()(gaussians, scenes.targets.cameras[:, :1])[:, 0]
    assert torch.equal(drawn["opacity"], rendering.alpha.clamp(0, 1).expand(-1, 3, -1, -1))
    assert "layer 1" not in panels(gaussians[:, :-1], scenes)  # as of a capture
    rendered = panels(gaussians, scenes)["render"]
    assert rendered.std() > 0
    for difference in (0.0, 0.1):
        targets = replace(scenes.targets, images=torch.stack([rendered, rendered], 1) - difference)
        error = panels(gaussians, replace(scenes, targets=targets))["error x4"]
        torch.testing.assert_close(error, torch.full_like(error, 4 * difference))


def test_near_depths_are_bright_on_a_scale_for_each_scene_and_unseen_pixels_are_grey():
    scenes = scene_batch(batch=2)
    rows = torch.arange(SIZE).repeat_interleave(SIZE)
    depths = torch.where(rows < 5, 3.0, 1.0) * torch.tensor([[1.0], [7.0]])
    flat = layer(scenes, 1.0, 0.9, scenes.reference.images)
    gaussians = replace(flat, means=flat.means * depths[..., None], opacities=flat.opacities * (rows < 10))
    depth = panels(gaussians, scenes)["depth"]
    assert (depth[..., 12:, :] == 0.5).all()
    lightness = depth.mean(1)
    assert (lightness[:, 6:9] > lightness[:, :4].max()).all()
    torch.testing.assert_close(depth[0], depth[1], atol=1e-3, rtol=0)


def test_percentiles_are_of_all_gaussians():
    scenes = scene_batch()
    gaussians = layer(scenes, 1.0, 0.9, scenes.reference.images)
    ranks = torch.linspace(0, 1, gaussians.opacities.numel())[torch.randperm(gaussians.opacities.numel())]
    figures = fixed_scenes.gaussian_figures(replace(gaussians, opacities=ranks.view_as(gaussians.opacities)))
    for p in (10, 50, 90):
        assert figures[f"gaussians/opacity_p{p}"] == pytest.approx(p / 100, abs=1e-5)
        assert figures[f"gaussians/log10_scale_p{p}"] == pytest.approx(-3, abs=1e-5)
        assert figures[f"gaussians/depth_p{p}"] == pytest.approx(1, abs=1e-5)
    assert len(figures) == 3 * 3


def test_figures_of_the_layers_are_those_of_the_reference_s_pixels():
    scenes = scene_batch(batch=2)
    masks = (torch.rand(2, 1, SIZE, SIZE) < 0.5).float()
    scenes = replace(scenes, reference=replace(scenes.reference, masks=masks))
    gaussians = two_layers(scenes)
    opacities = torch.rand(2, 2, SIZE, SIZE)
    gaussians = replace(gaussians, opacities=opacities.flatten(1) * 0.9)
    figures = fixed_scenes.layer_figures(gaussians, scenes)
    assert figures["layers/behind_2"] == pytest.approx(2)  # depths of 1 and 3
    for layer in (0, 1):
        mean = 0.9 * opacities[:, layer][masks[:, 0] > 0].mean()
        assert figures[f"layers/opacity_{layer + 1}"] == pytest.approx(mean.item())


def test_the_bits_of_the_channels_are_those_of_the_posterior():
    means = torch.randn(3, 4, 5, 6) * torch.tensor([0.0, 1, 0.05, 1])[:, None, None]  # 0.05^2 / 2 nats are 0.0018 bits
    posterior = Posterior(means, torch.zeros(3, 4, 5, 6))
    model = Mock(model=None, return_value=SimpleNamespace(posterior=posterior))
    logged = ReconstructionModule.latent_figures(model, scene_batch())
    bits = [logged[f"latent/bits_{channel}"] for channel in range(4)]
    assert logged["latent/bits"] == pytest.approx(sum(bits))
    assert sum(bits) == pytest.approx(posterior.kl().mean().item() / math.log(2), rel=1e-5)
    assert bits[0] == 0 < bits[2] < 1
    assert logged["latent/active_channels"] == 2


def test_the_newest_scenes_take_the_place_of_older_ones_and_read_back_with_their_cameras(tmp_path):
    up = torch.tensor([0.0, -0.8, -0.6])
    scenes = scene_batch(batch=2)
    gaussians = two_layers(scenes)
    for step in (500, 1000):
        fixed_scenes.write_newest(tmp_path / "newest", step, gaussians, scenes, up)
        step_of_files, samples, direction = read_newest(tmp_path / "newest")
        assert (step_of_files, direction) == (step, pytest.approx(up.tolist()))
    assert [sample.settings for sample in samples] == [{"scene": name, "step": 1000} for name in scenes.names]
    for index, sample in enumerate(samples):
        assert sample.layers == 2
        assert not sample.exact
        torch.testing.assert_close(sample.gaussians.means, gaussians.means[index])
        assert (sample.gaussians.scales > gaussians.scales[index]).all()  # as wide as the rasterizer's blur
        assert torch.equal(sample.reference.intrinsics, scenes.reference.cameras.intrinsics[index])
    broken = replace(gaussians, means=gaussians.means * torch.tensor([1.0, torch.nan])[:, None, None])
    fixed_scenes.write_newest(tmp_path / "newest", 1500, broken, scenes, up)  # training goes on
    assert len(read_newest(tmp_path / "newest")[1]) == 1


def test_a_turn_shows_the_back_after_half_of_its_frames(tmp_path):
    camera = scene_batch().reference.cameras[0]
    colors = torch.tensor([[1.0, 0, 0], [0, 0, 1.0]])
    ball = round_gaussians(torch.tensor([[0.0, 0, 2.0], [0, 0, 2.4]]), 0.2, 0.99, colors)
    scene = PlacedScene(ball, camera, pivot=torch.tensor([0.0, 0, 2.2]))
    fixed_scenes.write_turn(tmp_path / "turn.mp4", scene, ReferenceRasterizer(), 0.5)
    frames = imageio.mimread(tmp_path / "turn.mp4", memtest=False)
    assert len(frames) == fixed_scenes.TURN_FRAMES
    middle = [frame[frame.shape[0] // 2, frame.shape[1] // 2].argmax() for frame in frames]
    assert (middle[0], middle[fixed_scenes.TURN_FRAMES // 2]) == (0, 2)


def test_newest_scenes_that_are_not_there_are_refused(tmp_path):
    with pytest.raises(CompleteSplatError, match="no such file"):
        read_newest(tmp_path)
    (tmp_path / "scenes.json").write_text('{"step": 1, "scenes": [{"file": "../a.ply"}]}')
    with pytest.raises(CompleteSplatError, match="no reference_camera"):
        read_newest(tmp_path)


def test_scenes_are_the_first_of_validation():
    several = [scene_batch(2, targets=1, seed=0), scene_batch(1, targets=3, seed=1), scene_batch(2, targets=2, seed=2)]
    scenes = fixed_scenes.fixed_scenes(several, 4)
    assert [scene.names for scene in scenes] == ["scene 0 0", "scene 0 1", "scene 1 0", "scene 2 0"]
    assert torch.equal(scenes[2].targets.images, several[1].targets.images[0, :1])
    assert len(fixed_scenes.fixed_scenes(several, 10)) == 5


@pytest.mark.parametrize(("views", "chosen"), [(1, [0]), (3, [0, 2, 4]), (9, range(6))])
def test_targets_are_spread_over_all_that_a_scene_has(views, chosen):
    (whole,) = batch = [scene_batch(1, targets=6)]
    (scene,) = fixed_scenes.fixed_scenes(batch, 1, views)
    assert torch.equal(scene.targets.images, whole.targets.images[0, list(chosen)])


@pytest.mark.parametrize("stage", ["var", "diffusion"])
def test_a_run_writes_images_and_rows(pipeline, stage):
    run = getattr(pipeline, stage)
    assert {path.name for path in (run / "images").iterdir()} == {"step_000002.png", "newest"}
    # One validation scene in eight panels.
    assert cells(Image.open(run / "images/step_000002.png"), 32, 32).shape[:2] == (1, 8)
    layers = {column for column in pandas.read_csv(run / "metrics.csv") if column.startswith("layers/")}
    assert layers == {"layers/opacity_1", "layers/opacity_2", "layers/behind_2"}
    table = pandas.read_csv(run / "metrics.csv")
    (row,) = table[["step", *(c for c in table if c.startswith("gaussians/"))]].dropna().to_dict("records")
    assert row["step"] == 1
    assert 0 < row["gaussians/opacity_p10"] <= row["gaussians/opacity_p50"] <= row["gaussians/opacity_p90"] < 1
    assert len(row) == 1 + 3 * 3
    assert any(column.startswith("latent/bits_") for column in table) == (stage == "var")


SIDE = 32


def some_drawings(samples: int = 2, views: int = 3) -> fixed_scenes.SceneDrawings:
    images = torch.rand(1 + samples, views, 3, SIDE, SIDE)
    return fixed_scenes.SceneDrawings(images[0], images[1:], torch.ones(1, views, 1, SIDE, SIDE))


def assert_shows(result: torch.Tensor, expected: torch.Tensor) -> None:
    torch.testing.assert_close(result, expected, atol=0.5 / 255 + 1e-5, rtol=0)


def test_rows_are_true_images_samples_and_depths_scene_by_scene():
    drawn = [some_drawings(), some_drawings(views=2)]
    result = cells(fixed_scenes.samples_sheet(drawn), SIDE, SIDE)
    assert result.shape[:2] == (8, 3)
    for top, scene in zip((0, 4), drawn, strict=True):
        views = len(scene.true)
        assert_shows(result[top, :views], scene.true)
        assert_shows(result[top + 1 : top + 3, :views], scene.samples)
    assert (result[4:, 2] == 1).all()


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


def test_a_run_writes_samples_and_their_scores(pipeline):
    run = pipeline.diffusion
    assert {path.name for path in (run / "samples").iterdir()} == {"step_000002.png"}
    assert not (pipeline.var / "samples").exists()
    data = instantiate(compose_config("fit", f"data.root={pipeline.toy}", *SMALL).data, _convert_="all")
    data.setup("fit")
    # One validation scene with two targets, four samples.
    (scene,) = fixed_scenes.fixed_scenes(data.val_dataloader(), 2, 8)
    result = cells(Image.open(run / "samples/step_000002.png"), SIDE, SIDE)
    assert result.shape[:2] == (1 + 4 + 1, 3)
    assert_shows(result[0, 0], scene.reference.images)
    assert_shows(result[0, 1:], scene.targets.images)
    table = pandas.read_csv(run / "metrics.csv")
    columns = [column for column in table if column.startswith("samples/")]
    (row,) = table[["step", *columns]].dropna().to_dict("records")
    assert row["step"] == 1
    assert row["samples/diversity"] > 0
