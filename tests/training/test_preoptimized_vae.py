"""Gaussians fitted once to whole sequences, and the VAE that is trained on their Splatter Images."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from hydra.utils import instantiate
from scenes_for_training import opened
from support import SMALL, compose_config, some_gaussians, strict_json

from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import transform_points
from completesplat.scene import SceneBatch
from completesplat.training.per_scene import FittedScenes
from completesplat.weights.checkpoint_reading import read_checkpoint

MODEL = ["model=preoptimized_vae", "model.fitting.count=300", "model.fitting.steps=3"]
SETTINGS = ["experiment=toy_var", *MODEL, *SMALL]
MORE = ["trainer.max_steps=3", "test=false"]


def test_it_is_trained_continued_and_scored(command, toy_root, tmp_path):
    run = tmp_path / "run"
    settings = [*SETTINGS, f"data.root={toy_root}", f"model.folder={run}/fitted"]
    first = command.succeeds("fit", *settings, f"out={run}")
    assert "fitted Gaussians to 2 scenes" in first.out + first.err
    files = {path: path.stat().st_mtime_ns for path in (run / "fitted").iterdir()}
    assert len(files) == 3  # two sequences of training, one of validation
    checkpoint = run / "checkpoints/last.ckpt"
    state = read_checkpoint(checkpoint)["state_dict"]
    assert state["vae.std"].shape == (2, 15, 1, 1)
    assert not torch.equal(state["vae.std"], torch.ones(2, 15, 1, 1))
    again = command.succeeds("fit", *settings, f"ckpt_path={checkpoint}", *MORE, f"out={tmp_path / 'more'}")
    assert strict_json(tmp_path / "more/metrics.json")["steps"] == 3
    assert "fitted Gaussians" not in again.out + again.err
    assert {path: path.stat().st_mtime_ns for path in (run / "fitted").iterdir()} == files

    metrics = strict_json(run / "metrics.json")
    assert metrics["upper_bound"]
    assert metrics["test"]["model"]["empty_pixels"] > 1 - 300 / 1024
    assert {f"train/{n}" for n in ("depth", "offset", "opacity", "scale", "rotation", "color", "kl")} < metrics.keys()
    assert 0 < metrics["test"]["model"]["full"]["novel"]["psnr"] < 100


@pytest.mark.parametrize(("ablation", "layers"), [("skips_first_two", 2), ("m1", 1)])
def test_ablations_change_the_layers_and_bring_no_skips(ablation, layers):
    config = compose_config("fit", *SETTINGS, f"ablation={ablation}")
    vae = instantiate(config.model, _convert_="all").vae
    assert len(vae.reconstructor.skips) == 0
    # 15 raw values of each layer, and whether it is occupied.
    assert vae.encoder.network.conv_in.in_channels == 16 * layers
    assert vae.reconstructor.network.conv_out.out_channels == 15 * layers


def test_the_decoder_is_all_that_the_test_sees(toy_root):
    torch.manual_seed(0)
    data, module = opened(toy_root, *MODEL)
    module.eval()
    data.setup("test")
    scenes = next(iter(data.test_dataloader()))
    with torch.inference_mode():
        result = module.reconstruct(scenes)
        decoded = module.vae(module.splatter_image(scenes)).splatter_image
    assert torch.equal(result.means, decoded.gaussians(scenes.reference.cameras, scenes.depth_range).means)
    assert result.count == 2 * 32 * 32


@pytest.fixture
def store(toy_root):
    return opened(toy_root, *MODEL)[0].store("train")


MEANS = torch.tensor([[0.0, 0.0, 2.0], [0.1, -0.2, 2.5]])
KNOWN = replace(some_gaussians(1), means=MEANS[None])  # of one scene, in the frame of its reference


def test_a_scene_is_fitted_once_to_all_its_images_and_seen_from_any_of_its_cameras(store, tmp_path):
    calls = []

    def fit(scenes: SceneBatch) -> Gaussians:
        calls.append((scenes.names, len(scenes.targets.images[0]), int(scenes.reference_frame)))
        return KNOWN

    name = store.names[0]
    cameras = store.source.read(name).cameras.to(torch.float32)
    kept = FittedScenes(tmp_path / "fitted", [store], fit, "settings")
    world = transform_points(cameras[0].camera_to_world, MEANS)
    for frame in range(4):
        expected = transform_points(cameras[frame].world_to_camera, world)
        torch.testing.assert_close(kept.seen_from(name, frame).means, expected, atol=1e-5, rtol=1e-5)
    assert calls == [((name,), 3, 0)]


def test_files_that_are_there_are_taken_unless_the_settings_are_others(store, tmp_path):
    calls = []
    for settings in ("one", "one", "other"):
        fit = lambda scenes: calls.append(scenes.names[0]) or KNOWN  # noqa: E731
        FittedScenes(tmp_path, [store], fit, settings).complete(store.names, progress=False)
    assert calls == [*store.names, *store.names]
    assert len(list(tmp_path.iterdir())) == len(calls)


@pytest.mark.parametrize("settings", [["experiment=toy_var", *SMALL], SETTINGS])
def test_encoded_images_are_refused(monkeypatch, settings):
    module = instantiate(compose_config("fit", *settings).model, _convert_="all")
    data = SimpleNamespace(latent_cache="folder", targets=3, image_size=32)
    monkeypatch.setattr(type(module), "data", data)
    monkeypatch.setattr(type(module), "trainer", SimpleNamespace(datamodule=data))
    with pytest.raises(CompleteSplatError, match=r"data\.latent_cache is for model=latent_diffusion"):
        module.on_fit_start()
