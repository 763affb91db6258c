"""Models as ONNX graphs, run by `notebooks/onnx_predict.py`, beside the same models in torch."""

import importlib.util
import json
import math
import os
import sys
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
import torch
from diffusers import DDIMScheduler, DPMSolverMultistepScheduler, HeunDiscreteScheduler
from PIL import Image
from published_weights import write_published
from support import tiny_generator

from completesplat.commands import export as export_command
from completesplat.diffusion.sampling import Sampler
from completesplat.diffusion.step_table import step_table
from completesplat.errors import CompleteSplatError
from completesplat.export.ply import read_ply
from completesplat.generator import CompleteSplat
from completesplat.onnx_graphs import PIPELINE_FILE
from completesplat.weights import shipped

pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")
REFERENCE = Path(__file__).parents[1] / "notebooks/onnx_predict.py"


@pytest.fixture(scope="module")
def onnx_predict():
    spec = importlib.util.spec_from_file_location("onnx_predict", REFERENCE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def photo(tmp_path_factory):
    """A photo that is not square and has an odd size."""
    path = tmp_path_factory.mktemp("photo") / "photo.png"
    pixels = np.random.default_rng(0).integers(0, 255, (41, 60, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(path)
    return path


def largest_differences(scene, values) -> dict[str, float]:
    return {name: np.abs(getattr(scene, name).numpy() - value).max() for name, value in values.items()}


def assert_same_scenes(onnx_predict, folder, model, photo, samples=2, seed=5):
    """Compare means within 1e-3 of the scene's size and colours within 1/255."""
    drawn = {"samples": samples, "seed": seed, "bfloat16": False} if model.draws_samples else {}
    photograph = model.read(photo)
    scenes = model(photograph, color_fits=0, detail=0, **drawn)
    image = onnx_predict.read_square(photo, model.image_size)
    assert np.array_equal(image, photograph.image.numpy())
    found = onnx_predict.Pipeline(folder).scenes(image, photograph.fov_degrees, samples, seed)
    assert len(found) == len(scenes) == (samples if model.draws_samples else 1)
    for scene, values in zip(scenes, found, strict=True):
        size = (scene.means.amax(0) - scene.means.amin(0)).max().item()
        differences = largest_differences(scene, values)
        assert differences.keys() == vars(scene).keys()
        assert differences.pop("means") < 1e-3 * size
        assert max(differences.values()) < 1 / 255
    return scenes


@pytest.fixture(autouse=True, scope="module")
def shapes_are_not_checked():
    """Tracing through the checks of shapes takes twice the time; other tests call the same functions."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """A tiny model of samples and the folder of its graphs."""
    model = tiny_generator().eval()
    with torch.no_grad():  # a fresh network's last layers are 0
        for parameter in model.parameters():
            parameter.add_(0.02 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1)))
    model.set_latent_moments([0.1] * 4, [1.5] * 4)
    folder = tmp_path_factory.mktemp("onnx") / "tiny"
    model.to_onnx(folder)
    return model, folder


def test_scenes_are_those_of_torch_from_the_same_seed(tiny, onnx_predict, photo):
    model, folder = tiny
    first, second = assert_same_scenes(onnx_predict, folder, model, photo)
    assert (first.means - second.means).abs().max() > 0.01
    assert_same_scenes(onnx_predict, folder, model, photo, samples=3, seed=2**31 + 7)


def test_skips_and_guidance_are_inputs(tiny, onnx_predict, photo):
    model, folder = tiny
    pipeline = onnx_predict.Pipeline(folder)
    image = onnx_predict.read_square(photo, model.image_size)
    fov = model.framing.fov_degrees
    seen = pipeline.run("image", {"image": image[None]})
    scene = model(photo, color_fits=0, detail=0, seed=5, skip_weight=0.0, bfloat16=False, guidance_weight=1.0)[0]
    run = pipeline.run

    def free(name, inputs):
        if name == "decode":
            inputs = {**inputs, "skip_weight": np.float32([0])}
        if name == "step":
            inputs = {**inputs, "conditioning": np.zeros_like(inputs["conditioning"])}
        return run(name, inputs)

    pipeline.run = free
    values = pipeline.scenes(image, fov, 1, 5)[0]
    assert max(largest_differences(scene, values).values()) < 1e-3
    pipeline.run = run
    assert largest_differences(scene, pipeline.scenes(image, fov, 1, 5)[0])["means"] > 1e-3
    assert seen.keys() == {"conditioning", *(name for name in seen if name.startswith("feature"))}


@pytest.mark.slow
def test_weights_in_float16_take_half_the_bytes_and_change_little(tiny, onnx_predict, photo, tmp_path):
    model, folder = tiny
    model.to_onnx(tmp_path / "half", "float16")
    files = sorted(path.name for path in folder.glob("*.onnx"))
    assert files == ["decode.onnx", "image.onnx", "step.onnx"]
    image = onnx_predict.read_square(photo, model.image_size)
    whole = onnx_predict.Pipeline(folder).scenes(image, 50.0, 1, 0)[0]
    half = onnx_predict.Pipeline(tmp_path / "half").scenes(image, 50.0, 1, 0)[0]
    assert 0 < np.abs(whole["means"] - half["means"]).max() < 0.05
    assert json.loads((tmp_path / "half" / PIPELINE_FILE).read_text())["precision"] == "float16"
    sizes = [sum((place / name).stat().st_size for name in files) for place in (folder, tmp_path / "half")]
    assert sizes[1] < 0.8 * sizes[0]


@pytest.mark.slow
def test_a_command_writes_graphs_of_a_run_and_the_program_writes_ply(
    command, pipeline, onnx_predict, photo, tmp_path, monkeypatch
):
    out = command.succeeds("export", f"weights={pipeline.weights}", f"out={tmp_path / 'onnx'}").out
    assert out.splitlines()[-1] == str(tmp_path / "onnx" / PIPELINE_FILE)
    given = [str(tmp_path / "onnx"), str(photo), str(tmp_path / "scenes"), "--samples", "2", "--seed", "3"]
    monkeypatch.setattr(sys, "argv", ["onnx_predict.py", *given])
    onnx_predict.main()
    model = CompleteSplat.from_pretrained(pipeline.weights)
    for number, scene in enumerate(model(photo, samples=2, seed=3, color_fits=0, detail=0, bfloat16=False)):
        read = read_ply(tmp_path / "scenes" / f"sample_{number:02d}.ply")
        torch.testing.assert_close(read.means, scene.means, atol=1e-3, rtol=0)
        torch.testing.assert_close(read.colors, scene.colors, atol=1 / 255, rtol=0)


@pytest.mark.slow
def test_models_that_draw_no_samples_are_one_graph(onnx_predict, photo, tmp_path):
    model = CompleteSplat.from_pretrained(write_published(tmp_path / "published", "hydrants"))
    model.to_onnx(tmp_path / "onnx")
    assert [path.name for path in (tmp_path / "onnx").glob("*.onnx")] == ["scene.onnx"]
    described = json.loads((tmp_path / "onnx" / PIPELINE_FILE).read_text())
    assert described["draws_samples"] is False
    assert "steps" not in described


@pytest.mark.parametrize("size", [16, 48, 4096])
def test_the_program_draws_torchs_noise(onnx_predict, size):
    for seed in (0, 3, 2**32 - 1):
        drawn = torch.randn(size, generator=torch.Generator().manual_seed(seed))
        np.testing.assert_allclose(onnx_predict.torch_randn((size,), seed), drawn.numpy(), atol=1e-6)


@pytest.mark.parametrize(
    "scheduler",
    [
        DDIMScheduler(clip_sample=False),
        DDIMScheduler(clip_sample=False, prediction_type="v_prediction"),
        DPMSolverMultistepScheduler(),
        HeunDiscreteScheduler(),
    ],
    ids=["ddim", "v", "dpm", "heun"],
)
def test_tables_of_steps_give_the_samplers_latents(scheduler):
    sampler = Sampler(scheduler, steps=10)
    table = step_table(sampler)
    noise = torch.randn(2, 4, 8, 8, generator=torch.Generator().manual_seed(0))

    def denoise(latent, timestep, conditioning):
        return torch.tanh(latent * 0.7) + timestep[:, None, None, None] / 2000

    expected = sampler(denoise, noise, torch.zeros(2, 1, 8, 8))
    terms = [noise]
    for call in table["calls"]:
        latent = sum(weight * term for weight, term in zip(call["input"], terms, strict=True))
        terms.append(denoise(latent, torch.full((2,), call["timestep"]), None))
    found = sum(weight * term for weight, term in zip(table["latent"], terms, strict=True))
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)


def test_a_sampler_that_clips_is_refused():
    with pytest.raises(CompleteSplatError, match="clip_sample=true"):
        step_table(Sampler(DDIMScheduler(clip_sample=True), steps=10))


def test_without_the_extra_the_message_names_it(tiny, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    with pytest.raises(CompleteSplatError, match=r"ONNX files need .*onnx"):
        tiny[0].to_onnx(tmp_path / "onnx")
    assert not os.path.exists(tmp_path / "onnx")


@pytest.mark.slow
@pytest.mark.parametrize("name", shipped())
def test_shipped_weights_are_the_same_in_onnx(name, onnx_predict, photo, tmp_path):
    model = CompleteSplat.from_pretrained(name)
    model.to_onnx(tmp_path / "onnx", "float16" if name == "general" else "float32")
    assert_same_scenes(onnx_predict, tmp_path / "onnx", model, photo)
    assert math.prod(model.depth_range.shape) == 2
    assert export_command.PIPELINE_FILE in os.listdir(tmp_path / "onnx")
