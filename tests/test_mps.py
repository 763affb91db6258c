"""What a Mac's GPU computes, on a device that stands in for it: no test has run on a true one."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from fake_mps import MPS, FakeMPS
from packed_sequences import contents
from PIL import Image
from support import round_gaussians, strict_json

from completesplat.baselines.densification import scale_of_copies
from completesplat.commands import predict, trained
from completesplat.export.ply import read_ply
from completesplat.generator import CompleteSplat
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.metrics.image_sets import frechet_distance, kernel_distance
from completesplat.metrics.proper_scores import crps, energy_score, rank_histogram
from completesplat.rasterizers.tiled import TiledRasterizer


def test_the_device_that_stands_in_refuses_what_mps_refuses():
    with FakeMPS():
        there = torch.ones(2).to("mps") * torch.arange(2, device="mps")
        assert there.device == MPS
        assert there.cpu().device.type == "cpu"
        with pytest.raises(TypeError, match="float64"):
            there.double()
        with pytest.raises(RuntimeError, match="same device"):
            there + torch.ones(2)
        with pytest.raises(TypeError, match="numpy"):
            there.numpy()


def test_the_tiled_rasterizer_draws_gaussians_of_mps_on_the_cpu_with_their_gradients():
    gaussians = round_gaussians(torch.tensor([[0.1, 0, 2.0], [-0.2, 0.1, 3.0]]), 0.2, 0.8, 0.6)[None]
    cameras = Cameras(torch.eye(4)[None, None], pinhole(50, 16)[None, None], (16, 16))
    expected = TiledRasterizer()(gaussians, cameras)
    means = gaussians.means.clone().requires_grad_()
    with FakeMPS():
        color = TiledRasterizer()(replace(gaussians, means=means).to("mps"), cameras.to("mps")).color
        assert color.device == MPS
        torch.testing.assert_close(color.cpu(), expected.color, rtol=0, atol=0)
    (gradient,) = torch.autograd.grad(color.as_subclass(torch.Tensor).square().sum(), means)
    assert gradient.abs().max() > 0


SAMPLES_AND_TRUTH = torch.rand(5, 12), torch.rand(12)
TWO_SETS = torch.rand(9, 4), torch.rand(9, 4)
FIGURES = [
    (energy_score, SAMPLES_AND_TRUTH),
    (crps, SAMPLES_AND_TRUTH),
    (lambda *values: rank_histogram(*values).tolist(), SAMPLES_AND_TRUTH),
    (frechet_distance, TWO_SETS),
    (kernel_distance, TWO_SETS),
]


@pytest.mark.parametrize(("figure", "values"), FIGURES)
def test_figures_of_samples_and_of_sets_on_mps_are_those_on_the_cpu(figure, values):
    expected = figure(*values)
    with FakeMPS():
        assert figure(*(value.to("mps") for value in values)) == pytest.approx(expected)


def test_copies_of_gaussians_on_mps_are_scaled_as_on_the_cpu():
    opacities, copies = torch.tensor([0.3, 0.9]), torch.tensor([2, 5])
    expected = scale_of_copies(opacities, copies)
    with FakeMPS():
        scales = scale_of_copies(opacities.to("mps"), copies.to("mps"))
        assert scales.device == MPS
        torch.testing.assert_close(scales.cpu(), expected)


def test_a_prediction_with_networks_on_mps_has_the_files_of_the_cpu(command, tiny_weights, tmp_path, monkeypatch):
    image = tmp_path / "a.png"
    Image.fromarray((torch.rand(32, 32, 3) * 255).byte().numpy()).save(image)
    given = [f"image={image}", f"weights={tiny_weights}", "samples=2", "frames=2", "steps=2", "color_fits=2"]
    monkeypatch.setattr(predict, "has_bfloat16", lambda device: False)  # as it is for MPS
    command.succeeds("predict", *given, "maps=true", f"out={tmp_path / 'cpu'}")
    monkeypatch.setattr(trained, "used_device", lambda: "mps")
    overwrite = torch.__future__.get_overwrite_module_params_on_conversion()
    torch.__future__.set_overwrite_module_params_on_conversion(True)  # else parameters keep their class
    seen = []
    generate = CompleteSplat.generate
    monkeypatch.setattr(CompleteSplat, "generate", lambda *x, **y: seen.append(generate(*x, **y)) or seen[-1])
    try:
        with FakeMPS():
            command.succeeds("predict", *given, "maps=true", f"out={tmp_path / 'mps'}")
            assert [scenes.means.device for scenes in seen] == [MPS]
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(overwrite)
    # A CPU draws parts of the samples in threads, an MPS device all at once, which changes rounding.
    cpu = tmp_path / "cpu/a"
    mps = tmp_path / "mps/a"
    assert sorted(contents(mps)) == sorted(contents(cpu))
    descriptions = [strict_json(folder / "scene.json") for folder in (mps, cpu)]
    ends = [description["settings"].pop("depth_map_ends") for description in descriptions]
    assert ends[0] == pytest.approx(ends[1], rel=1e-4)
    for key in ("settings", "files"):
        assert descriptions[0][key] == descriptions[1][key]
    for path in cpu.glob("*.ply"):
        expected = read_ply(path)
        scene = read_ply(mps / path.name)
        for name in ("means", "scales", "opacities", "colors"):
            torch.testing.assert_close(getattr(scene, name), getattr(expected, name), rtol=1e-3, atol=1e-4)
    for path in cpu.glob("*.png"):
        difference = np.asarray(Image.open(mps / path.name), np.int64) - np.asarray(Image.open(path), np.int64)
        assert np.quantile(np.abs(difference), 0.999) <= 2
