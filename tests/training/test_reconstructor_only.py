"""The model without an encoder: trained, continued, and scored with codes that it finds at test time."""

import torch
from hydra.utils import instantiate
from scenes_for_training import opened
from support import SMALL, compose_config, strict_json

from completesplat.weights.checkpoint_reading import read_checkpoint

MODEL = "model=reconstructor_only"
SETTINGS = ["experiment=toy_var", MODEL, *SMALL, "model.code_steps=4"]


def test_it_is_trained_continued_and_scored(command, toy_root, tmp_path):
    run = tmp_path / "run"
    assert command("fit", *SETTINGS, f"data.root={toy_root}", f"out={run}").status == 0
    first = read_checkpoint(run / "checkpoints/last.ckpt")["state_dict"]
    # Only training images: validation and test have taken none.
    source = opened(toy_root, MODEL)[0].source("train")
    assert {name for name, _ in first["model._extra_state"]} <= set(source.names)
    frame_count = sum(len(source.read(name).frames) for name in source.names)
    assert len(first["model.codes"]) == frame_count == 8  # a row for every training image
    assert 2 <= len(first["model._extra_state"]) <= 4  # two steps of two images
    resume = [f"ckpt_path={run / 'checkpoints/last.ckpt'}", "trainer.max_steps=4"]
    resume += ["test=false", f"out={tmp_path / 'more'}"]
    assert command("fit", *SETTINGS, f"data.root={toy_root}", *resume).status == 0
    more = read_checkpoint(tmp_path / "more/checkpoints/last.ckpt")["state_dict"]
    assert more["model._extra_state"][: len(first["model._extra_state"])] == first["model._extra_state"]
    assert 0 < strict_json(run / "metrics.json")["test"]["model"]["full"]["novel"]["psnr"] < 100


def test_codes_have_no_average(command, toy_root):
    refused = command.refuses("fit", *SETTINGS, f"data.root={toy_root}", "callbacks=ema")
    assert "callbacks=ema: the number of this model's weights changes" in refused


def test_no_ablation_brings_skips():
    config = compose_config("fit", *SETTINGS, "ablation=skips_first_two")
    assert len(instantiate(config.model, _convert_="all").model.reconstructor.skips) == 0


def test_new_codes_lower_the_loss_of_the_reference_and_leave_the_weights(toy_root):
    torch.manual_seed(0)
    data, module = opened(toy_root, MODEL, "model.code_steps=30", "model.code_rate=0.1")
    module.eval()
    data.setup("test")
    scenes = next(iter(data.test_dataloader()))
    before = {name: p.clone() for name, p in module.named_parameters()}

    def loss(gaussians) -> float:
        images = module.render(gaussians, scenes.all_views().cameras)[:, 0]
        return torch.nn.functional.mse_loss(images, scenes.reference.images).item()

    start = module.gaussians(module.model.new_codes(len(scenes.names), seed=0), scenes)
    with torch.inference_mode():
        assert loss(module.reconstruct(scenes.map(torch.clone), seed=0)) < 0.9 * loss(start)
    for name, parameter in module.named_parameters():
        assert torch.equal(parameter, before[name])
        assert parameter.grad is None
