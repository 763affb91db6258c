import json

import pytest
import torch
from omegaconf import OmegaConf
from safetensors.torch import load_file, save_file
from support import tiny_generator

from completesplat.errors import WeightsError
from completesplat.generation import CONFIG_FILE, WEIGHTS_FILE, CompleteSplat


@pytest.fixture(scope="module")
def model():
    return tiny_generator()


@pytest.fixture
def folder(model, tmp_path):
    model.save_pretrained(tmp_path / "weights")
    return tmp_path / "weights"


@pytest.fixture(scope="module")
def picture(toy_root):
    return sorted(toy_root.glob("*/*/images/*.jpg"))[0]


def same(first, second) -> bool:
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in vars(first))


def test_what_is_saved_is_loaded_bit_for_bit(model, folder, picture):
    loaded = CompleteSplat.from_pretrained(folder)
    assert loaded.architecture == model.architecture
    for name, value in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value)
    for ours, theirs in zip(model(picture, samples=2), loaded(picture, samples=2), strict=True):
        assert same(ours, theirs)


def test_no_lightning_is_needed_to_generate(folder, picture):
    import subprocess
    import sys

    program = (
        "import sys; from completesplat.generation import CompleteSplat; "
        f"scenes = CompleteSplat.from_pretrained({str(folder)!r})({str(picture)!r}, samples=1, steps=1); "
        "print(len(scenes), 'lightning' in sys.modules)"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["1", "False"]


def test_seeds_decide_and_samples_differ(model, picture):
    first, second = model(picture, samples=2, seed=3)
    again = model(picture, samples=2, seed=3)
    other = model(picture, samples=2, seed=4)
    assert same(first, again[0])
    assert same(second, again[1])
    assert not torch.equal(first.means, second.means)
    assert not torch.equal(first.means, other[0].means)


def test_samples_of_a_batch_stand_next_to_each_other(model, picture):
    photograph = model.read(picture)
    images = torch.stack([photograph.image, photograph.image.flip(-1)])
    cameras = model.camera(photograph)[None].map(lambda tensor: tensor.expand(2, *tensor.shape[1:]))
    ranges = model.depth_range.expand(2, 2)
    scenes = model.generate(images, cameras, ranges, samples=3, skip_weight=1.0, steps=2)
    assert scenes.means.shape[0] == 6
    # With one skip of weight one the picture reaches its own samples only: a changed second picture moves those alone.
    changed = model.generate(images * torch.tensor([1.0, 0.5]).view(2, 1, 1, 1), cameras, ranges, samples=3, steps=2)
    moved = (changed.means - scenes.means).abs().amax((1, 2)) > 1e-6
    assert moved.tolist() == [False] * 3 + [True] * 3


def test_all_gaussians_lie_on_rays_of_the_stated_field_of_view(model, picture):
    scene = model(model.read(picture, fov_degrees=90), samples=1)[0]
    near, far = model.depth_range.tolist()
    # The offset is small at first: depth stays near the range and |x / z| near tan(45 degrees).
    assert near - 1 < scene.means[:, 2].min()
    assert scene.means[:, 2].max() < far + 1
    assert 0.8 < (scene.means[:, 0] / scene.means[:, 2]).abs().max() < 2


def test_training_mode_leaves_the_autoreconstructor_frozen(model):
    model.train()
    assert model.denoiser.training
    assert not model.autoreconstructor.training
    assert not any(p.requires_grad for p in model.autoreconstructor.parameters())
    assert all(p.requires_grad for p in model.denoiser.parameters())


@pytest.mark.parametrize("name", [CONFIG_FILE, WEIGHTS_FILE])
def test_missing_files_are_named(folder, name):
    (folder / name).unlink()
    with pytest.raises(WeightsError, match=name):
        CompleteSplat.from_pretrained(folder)


def test_a_damaged_file_is_refused(folder):
    path = folder / WEIGHTS_FILE
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(WeightsError, match="cannot be loaded"):
        CompleteSplat.from_pretrained(folder)


def test_weights_of_another_model_are_refused(folder):
    weights = load_file(folder / WEIGHTS_FILE)
    weights.pop("latent_scale")
    save_file(weights, folder / WEIGHTS_FILE)
    with pytest.raises(WeightsError, match="cannot be loaded"):
        CompleteSplat.from_pretrained(folder)


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "torch.load",
        "builtins.eval",
        "completesplat.generation.torch.load",
        "completesplat.generation.json.loads",
    ],
)
def test_a_configuration_cannot_name_foreign_code(folder, target, tmp_path):
    config = json.loads((folder / CONFIG_FILE).read_text())
    config["sampler"]["scheduler"] = {"_target_": target, "f": str(tmp_path / "canary")}
    (folder / CONFIG_FILE).write_text(json.dumps(config))
    with pytest.raises(WeightsError, match="no part of a model"):
        CompleteSplat.from_pretrained(folder)


def test_the_architecture_is_plain_data(model):
    assert json.loads(json.dumps(model.architecture)) == model.architecture
    assert not OmegaConf.is_config(model.architecture["denoiser"])
