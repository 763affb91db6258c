import copy
import json
import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from itertools import product

import pytest
import torch
from omegaconf import OmegaConf
from PIL import Image
from published_weights import write_published
from safetensors.torch import load_file, save
from support import compose_config, python, tiny_generator
from torch.nn.functional import interpolate

from completesplat import scene_model
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.generator import CompleteSplat
from completesplat.geometry.cameras import Cameras, look_at, pinhole
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.sampling_settings import Sampling
from completesplat.weights import CONFIG_FILE, SUMS_FILE, WEIGHTS_FILE


@pytest.fixture(scope="module")
def model():
    return tiny_generator()


@pytest.fixture
def folder(model, tmp_path):
    model.save_pretrained(tmp_path / "weights")
    return tmp_path / "weights"


@pytest.fixture(scope="module")
def photo(toy_root):
    return sorted(toy_root.glob("*/*/images/*.jpg"))[0]


def same(first, second) -> bool:
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in vars(first))


def test_whoever_may_read_the_settings_may_read_the_weights(folder):
    assert len({path.stat().st_mode for path in folder.iterdir()}) == 1


def test_what_is_saved_is_loaded_bit_for_bit(model, folder, photo):
    loaded = CompleteSplat.from_pretrained(folder)
    assert loaded.architecture == model.architecture == json.loads(json.dumps(model.architecture))
    for name, value in model.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], value)
    for ours, theirs in zip(model(photo, samples=2), loaded(photo, samples=2), strict=True):
        assert same(ours, theirs)


def test_samples_are_fitted_to_the_visible_part_of_the_image_one_by_one(model, photo):
    visible = torch.ones(1, model.image_size, model.image_size)
    visible[..., : model.image_size // 2] = 0
    draw = partial(model, photo, samples=3, steps=1, skip_weight=0.0)
    plain, fitted, parts = draw(), draw(color_fits=2), draw(color_fits=2, batch=2)
    for one, other, part in zip(plain, fitted, parts, strict=True):
        assert torch.equal(one.means, other.means)
        assert (one.colors - other.colors).abs().max() > 0.01
        torch.testing.assert_close(other.colors, part.colors, atol=1e-3, rtol=1e-3)
    assert not same(fitted[0], draw(visible=visible, color_fits=2)[0])


def test_no_scene_is_fitted_to_a_border_that_is_continued(model, photo, monkeypatch):
    fitted, fit = [], scene_model.fit_front

    def watched(scene, cameras, images, rasterizer, rounds, background, visible=None, *pace):
        fitted.append(visible)
        return fit(scene, cameras, images, rasterizer, rounds, background, visible, *pace)

    monkeypatch.setattr(scene_model, "fit_front", watched)
    high = Image.open(photo).crop((0, 0, 24, 32))
    draw = partial(model, steps=1, color_fits=1, detail=model.image_size)
    draw(high)
    assert torch.equal(fitted[0], model.read(high).own_at(model.image_size)[None])
    draw(model.read(high, box=[0, 0, 1, 0.25]))
    assert torch.equal(fitted[1] > 0, (fitted[0] > 0) & (model.read(high, box=[0, 0, 1, 0.25]).visible > 0)[None])
    draw(model.read(high, crop="center"))
    assert fitted[2] is None


def test_a_photo_is_denoised_in_bfloat16_where_the_processor_has_it_and_decoded_in_float32(model, photo, monkeypatch):
    networks, seen = (model.denoiser.network, model.autoreconstructor.reconstructor.network), []
    hooks = [part.conv_in.register_forward_hook(lambda *_: seen.append(_[-1].dtype)) for part in networks]
    exact, half = model(photo, samples=1, bfloat16=False)[0], model(photo, samples=1, bfloat16=True)[0]
    steps = model.sampler.steps
    assert seen == [torch.float32] * (steps + 1) + [torch.bfloat16] * steps + [torch.float32]
    assert 0 < (half.colors - exact.colors).square().mean().sqrt() < 0.02
    for has in (True, False):
        monkeypatch.setattr(scene_model, "has_bfloat16", {"cpu": has}.get)
        assert same(model(photo, samples=1)[0], half if has else exact)
    for hook in hooks:
        hook.remove()


@pytest.mark.processes
def test_no_lightning_is_needed_to_generate(folder, photo):
    program = "import sys; from completesplat.generator import CompleteSplat; "
    program += f"scenes = CompleteSplat.from_pretrained({str(folder)!r})({str(photo)!r}, samples=1, steps=1); "
    program += "print(len(scenes), 'lightning' in sys.modules)"
    assert python(program).split() == ["1", "False"]


def test_seeds_decide_and_samples_differ(model, photo):
    (first, second), again, other = (model(photo, samples=2, seed=seed) for seed in (3, 3, 4))
    assert same(first, again[0])
    assert same(second, again[1])
    assert not torch.equal(first.means, second.means)
    assert not torch.equal(first.means, other[0].means)


def test_one_model_draws_in_four_threads_what_it_draws_one_after_the_other(model, photo):
    def draw(seed: int):
        return model(photo, samples=1, seed=seed, steps=(2, 4, 5, 8)[seed])

    alone = [draw(seed) for seed in range(4)]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(draw, range(4)))
    assert all(same(*pair) for scenes in zip(alone, together, strict=True) for pair in zip(*scenes, strict=True))


@pytest.mark.parametrize("mixed", [False, True], ids=["float32", "bfloat16"])
def test_any_number_of_threads_draws_the_same_scenes_bit_for_bit_and_stays_set(model, photo, set_threads, mixed):
    drawn = []
    for number in (1, 2, 3):
        set_threads(number)
        with torch.autocast("cpu", torch.bfloat16, enabled=mixed):
            drawn.append(model(photo, samples=10, steps=2))
        assert torch.get_num_threads() == number
    assert all(same(*pair) for others in drawn[1:] for pair in zip(drawn[0], others, strict=True))


def test_another_default_type_of_torch_changes_nothing_and_weights_of_another_type_are_refused(folder, photo):
    expected = CompleteSplat.from_pretrained(folder)(photo, samples=1, steps=1)[0]
    torch.set_default_dtype(torch.float64)
    try:
        model = CompleteSplat.from_pretrained(folder)
        assert same(model(photo, samples=1, steps=1)[0], expected)
        assert torch.get_default_dtype() == torch.float64
    finally:
        torch.set_default_dtype(torch.float32)
    for dtype in (torch.bfloat16, torch.float16, torch.float64):
        with pytest.raises(CompleteSplatError, match=r"weights are torch\.\w+; model\.float\(\) makes them float32"):
            model.to(dtype)(photo, samples=1, steps=1)
    assert len(model.float()(photo, samples=1, steps=1)) == 1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"samples": "4"}, "samples=4: must be a whole number"),
        ({"samples": 0}, "samples=0: must be at least 1"),
        ({"batch": 0}, "batch=0: must be at least 1"),
        ({"seed": 2**70}, "seed=1180591620717411303424: must lie between"),
        ({"seed": [1, 2]}, "seed=[1, 2]: 2 seeds for 1 images"),
    ],
)
def test_settings_of_wrong_kinds_are_named(model, photo, settings, message):
    with pytest.raises(CompleteSplatError) as caught:
        model(photo, **{"samples": 1, "steps": 1} | settings)
    assert str(caught.value).startswith(message)


def test_samples_of_a_batch_stand_next_to_each_other(model, photo):
    photograph = model.read(photo)
    images = torch.stack([photograph.image, photograph.image.flip(-1)])
    cameras = model.camera(photograph)[None].map(lambda tensor: tensor.expand(2, *tensor.shape[1:]))
    ranges = model.depth_range.expand(2, 2)
    scenes = model.generate(images, cameras, ranges, Sampling(samples=3, skip_weight=1.0, steps=2))
    assert scenes.means.shape[0] == 6
    # With one skip of weight one the image reaches its own samples only: a changed second image moves those alone.
    darker = images * torch.tensor([1.0, 0.5]).view(2, 1, 1, 1)
    changed = model.generate(darker, cameras, ranges, Sampling(samples=3, steps=2))
    moved = (changed.means - scenes.means).abs().amax((1, 2)) > 1e-6
    assert moved.tolist() == [False] * 3 + [True] * 3


def test_training_mode_leaves_the_autoreconstructor_frozen(model):
    model.train()
    assert model.denoiser.training
    assert not model.autoreconstructor.training
    assert not any(p.requires_grad for p in model.autoreconstructor.parameters())
    assert all(p.requires_grad for p in model.denoiser.parameters())


@pytest.fixture
def half(model):
    """The right half is hidden."""
    visible = torch.ones(1, model.image_size, model.image_size)
    visible[..., model.image_size // 2 :] = 0
    return visible


def calls_of(model, **settings) -> dict[str, list[int]]:
    """Batch sizes with which the networks are called in a drawing of one image."""
    encoder, reconstructor = model.autoreconstructor.encoder.network, model.autoreconstructor.reconstructor
    networks = {"conditioning": model.conditioning, "denoiser": model.denoiser, "reconstructor": reconstructor}
    networks |= {"first level": encoder.conv_in, "second level": encoder.down_blocks[1].resnets[0]}
    networks |= {"latent": encoder.mid_block, "skip": reconstructor.skips["0"]}
    sizes = {name: [] for name in networks}
    hooks = [
        network.register_forward_pre_hook(lambda _, inputs, seen=sizes[name]: seen.append(len(inputs[0])))
        for name, network in networks.items()
    ]
    size = model.image_size
    camera = Cameras(torch.eye(4), pinhole(50.0, size), (size, size))[None]
    model.generate(torch.rand(1, 3, size, size), camera, model.depth_range[None], Sampling(**settings))
    for hook in hooks:
        hook.remove()
    return {name: seen for name, seen in sizes.items() if seen}


@pytest.mark.parametrize(("guidance_weight", "passes"), [(0.0, 1), (0.5, 2)])
def test_an_image_is_encoded_once_for_all_samples_and_steps_and_as_far_as_skips_reach(model, guidance_weight, passes):
    actual = calls_of(model, samples=2, steps=1, skip_weight=0.0)
    assert actual == {"conditioning": [1], "denoiser": [2], "reconstructor": [2]}
    actual = calls_of(model, samples=20, batch=20, steps=4, guidance_weight=guidance_weight)
    once = {"conditioning": [1], "first level": [1], "skip": [20], "reconstructor": [20]}
    assert actual == {**once, "denoiser": [20 * passes] * 4}


def test_latents_are_kept_where_memory_does_not_suffice_to_decode_all_at_once(model, photo, monkeypatch):
    whole, reconstructor, sizes = model(photo, samples=5, batch=5, steps=2), model.autoreconstructor.reconstructor, []
    decode = reconstructor.forward

    def small(*inputs):
        sizes.append(len(inputs[0]))
        if sizes[-1] > 2:
            raise torch.cuda.OutOfMemoryError
        return decode(*inputs)

    monkeypatch.setattr(reconstructor, "forward", small)
    denoised = []
    hook = model.denoiser.register_forward_pre_hook(lambda _, inputs: denoised.append(len(inputs[0])))
    parts = model(photo, samples=5, batch=5, steps=2)
    hook.remove()
    assert (denoised, sizes) == ([5, 5], [5, 3, 2, 2, 1])
    for one, other in zip(whole, parts, strict=True):
        torch.testing.assert_close(one.means, other.means, atol=1e-4, rtol=1e-4)


def test_what_is_hidden_has_no_influence_at_all(model, photo, half):
    photograph = model.read(photo)
    other = replace(photograph, image=torch.where(half > 0, photograph.image, 1 - photograph.image))
    assert not torch.equal(other.image, photograph.image)
    for first, second in zip(model(photograph, half, samples=2), model(other, half, samples=2), strict=True):
        assert same(first, second)
    assert not same(model(photograph)[0], model(other)[0])
    other = replace(photograph, image=torch.where(half > 0, 1 - photograph.image, photograph.image))
    assert not same(model(photograph, half)[0], model(other, half)[0])


def test_skips_are_off_where_something_is_hidden_and_weights_out_of_place_refused(model, photo, half):
    assert same(model(photo, half)[0], model(photo, half, skip_weight=0.0)[0])
    everything = torch.ones_like(half)
    assert same(model(photo, everything, skip_weight=1.0)[0], model(photo)[0])
    with pytest.raises(CompleteSplatError, match=r"skip_weight=0\.5: must be 0"):
        model(photo, half, skip_weight=0.5)
    for visible, (name, weight) in product((None, half), {"skip_weight": -0.5, "guidance_weight": math.nan}.items()):
        with pytest.raises(CompleteSplatError, match=f"{name}={weight:g}: must lie between 0 and 1"):
            model(photo, visible, steps=1, **{name: weight})


def test_what_is_visible_needs_the_images_shape_and_values_from_0_to_1(model, photo, half):
    unfit = [torch.where(half > 0, half, value) for value in (math.nan, math.inf, -0.5, 2.0)]
    for visible in (*unfit, half[..., 1:], half[:, 1:]):
        with pytest.raises(CompleteSplatError, match=r"^visible: needs values from 0 to 1 in shape \[1, 32, 32\]"):
            model(photo, visible, steps=1)


@pytest.mark.parametrize(
    ("kind", "ending"), [(torch.complex64, ".bias"), (torch.bool, "latent_std"), (torch.int64, ".bias")]
)
def test_weights_of_another_kind_than_floats_are_refused_and_not_cast(folder, kind, ending):
    tensors = load_file(folder / WEIGHTS_FILE)
    name = next(name for name in tensors if name.endswith(ending))
    tensors[name] = torch.ones_like(tensors[name]).to(kind)
    (folder / WEIGHTS_FILE).write_bytes(save(tensors))
    (folder / SUMS_FILE).unlink()
    shape = list(tensors[name].shape)
    with pytest.raises(WeightsError) as caught:
        CompleteSplat.from_pretrained(folder)
    assert f"{name} is {shape} of {kind} there and {shape} here" in str(caught.value)


def test_the_scenes_of_all_steps_are_shown(model, photo):
    shown = []
    scenes = model(photo, samples=3, steps=4, batch=2, on_step=lambda *step: shown.append(step))
    assert [(step, level) for step, level, _ in shown] == 2 * [(0, 999), (1, 749), (2, 499), (3, 249)]
    last = [scene for _, _, part in (shown[3], shown[7]) for scene in (part[i] for i in range(len(part.means)))]
    for scene, estimate in zip(scenes, last, strict=True):
        torch.testing.assert_close(scene.means, estimate.means, atol=1e-4, rtol=1e-4)
    assert not torch.allclose(shown[0][2].means, shown[3][2].means, atol=1e-3)


def test_who_watches_the_steps_sees_all_samples_at_once(model, photo):
    seen = []
    model(photo, samples=5, steps=2, on_step=lambda step, _, part: seen.append((step, len(part.means))))
    assert seen == [(0, 5), (1, 5)]


def test_another_sampler_is_saved_with_the_weights(model, photo, tmp_path):
    changed = copy.deepcopy(model)
    changed.replace_sampler(OmegaConf.to_container(compose_config("fit", "sampler=unipc10", "sampler.steps=5").sampler))
    assert not same(changed(photo)[0], model(photo)[0])
    changed.save_pretrained(tmp_path / "changed")
    loaded = CompleteSplat.from_pretrained(tmp_path / "changed")
    assert loaded.sampler.steps == 5
    assert same(loaded(photo)[0], changed(photo)[0])


def test_files_that_are_damaged_missing_or_of_another_model_are_refused(folder):
    (folder / SUMS_FILE).unlink()
    path = folder / WEIGHTS_FILE
    content, weights = path.read_bytes(), load_file(path)
    weights.pop("latent_std")
    for damaged in (save(weights), content[:-1000]):
        path.write_bytes(damaged)
        with pytest.raises(WeightsError, match="cannot be loaded"):
            CompleteSplat.from_pretrained(folder)
    for name in (WEIGHTS_FILE, CONFIG_FILE):
        (folder / name).unlink()
        with pytest.raises(WeightsError, match=name):
            CompleteSplat.from_pretrained(folder)


def test_weights_that_are_not_finite_are_refused(folder, tmp_path):
    (folder / SUMS_FILE).unlink()
    path = folder / WEIGHTS_FILE
    weights = load_file(path)
    for value in (torch.nan, torch.inf):
        path.write_bytes(save(weights | {"latent_std": torch.full_like(weights["latent_std"], value)}))
        with pytest.raises(WeightsError, match=rf"^{folder}: latent_std is not finite$"):
            CompleteSplat.from_pretrained(folder)
    published = write_published(tmp_path, "hydrants")
    contents = torch.load(published, weights_only=True)
    name = next(name for name in contents["model_state_dict"] if name.endswith("out.bias"))
    contents["model_state_dict"][name][0] = torch.nan
    torch.save(contents, published)
    with pytest.raises(WeightsError, match=rf"{name} is not finite$"):
        CompleteSplat.from_pretrained(published)


def test_cameras_of_any_units_come_to_where_gaussians_start(model):
    eyes = torch.tensor([[0.0, 0, -1], [1, 0, 0], [0.6, 0, -0.8]])
    poses = look_at(eyes, torch.zeros(3), torch.tensor([0.0, -1, 0]))
    cameras = Cameras(poses, pinhole(50.0, 32).expand(3, 3, 3), (32, 32))
    cameras = cameras.relative_to(cameras[0])
    near, far = model.depth_range.tolist()
    start = near + model.autoreconstructor.reconstructor.parameterization.first_depth * (far - near)
    for units in (1.0, 0.01, 30.0):
        placed = model.in_model_units(cameras.scale_world(torch.tensor(units)))
        assert placed.centers.norm(dim=1).tolist() == pytest.approx(
            [0, math.sqrt(2) * start, placed.centers[2].norm().item()], rel=1e-4
        )
    with pytest.raises(CompleteSplatError, match="do not look at one place"):
        model.in_model_units(cameras[[0, 0]])
    turned = look_at(eyes, 2 * eyes, torch.tensor([0.0, -1, 0]))
    with pytest.raises(CompleteSplatError, match="do not look at one place"):
        model.in_model_units(replace(cameras, world_to_camera=turned))


def test_weights_of_objects_move_their_depths_to_where_an_object_is_as_large_in_any_field_of_view(model, photo, caplog):
    objects = copy.deepcopy(model)
    near, far = objects.depth_range.tolist()
    objects.architecture["training"] = {"depth_before": 1.0}
    half = 2 * math.degrees(math.atan(math.tan(math.radians(objects.fov_degrees.item()) / 2) / 2))
    moved = objects.depth_range_of(objects.read(photo, half)).tolist()
    assert moved == pytest.approx([2 * (near + 1) - 1, 2 * (near + 1) - 1 + far - near], rel=1e-5)
    assert objects.depth_range_of(objects.read(photo)).tolist() == [near, far]
    assert objects.depth_range_of(objects.read(photo, 170.0))[0] == pytest.approx(0.1)
    assert model.depth_range_of(model.read(photo, half)).tolist() == [near, far]
    with caplog.at_level("WARNING"):
        caplog.clear()
        objects.read(photo, half / 2)
        assert "too deep" not in caplog.text
        model.read(photo, half / 2)
        assert "too deep" in caplog.text


def test_weights_of_objects_on_white_put_a_transparent_object_on_white_as_large_as_in_training(model, tmp_path):
    """A red square of 20 pixels aside in a transparent image of 100: in the middle, 0.9 of the side, on white."""
    trained = copy.deepcopy(model)
    trained.architecture["training"] = {"background": 1.0}
    trained.fov_degrees.fill_(18.0)
    trained.save_pretrained(tmp_path / "white")
    loaded = CompleteSplat.from_pretrained(str(tmp_path / "white"))
    assert (model.background, loaded.background) == (None, 1.0)
    assert loaded.needed_of_data({}) == {"image_size": 32, "background": 1.0}
    assert model.needed_of_data({}) == {"image_size": 32}
    image = Image.new("RGBA", (100, 100), (0, 0, 255, 0))
    image.paste((255, 0, 0, 255), (70, 10, 90, 30))
    photograph = loaded.read(image)
    assert (photograph.fov_degrees, loaded.read(image, 30.0).fov_degrees) == (18.0, 30.0)
    red = (photograph.image - torch.tensor([1.0, 0, 0])[:, None, None]).abs().amax(0) < 0.05
    white = (photograph.image > 0.95).all(0)
    assert red[3:29, 3:29].all()
    assert white[:, 0].all()
    assert white[-1].all()
    assert abs(red.float().mean().sqrt() - 0.9) < 0.1


def test_detail_makes_the_front_sharper_than_the_models_own_size(model, folder):
    side = 2 * model.image_size
    stripes = torch.arange(side) // 4 % 2 * 0.8 + 0.1
    image = stripes.expand(3, side, side)
    photograph = model.read(image)
    draw = partial(model, photograph, samples=2, steps=1, color_fits=2)
    fitted = []
    plain, same_size, detailed = draw(detail=0), draw(detail=model.image_size), draw(on_fit=fitted.append)
    assert fitted == [0, 1]
    assert same(plain[0], model(photograph, samples=2, steps=1, detail=0)[0])
    assert same_size[0].count == plain[0].count < detailed[0].count
    assert not same(plain[0], same_size[0])
    assert model.front_size(photograph) == model.front_size(photograph, 2000) == side
    assert model.camera(photograph, side).image_size == (side, side)
    errors = []
    for scene, size in ((same_size[0], model.image_size), (detailed[0], side)):
        camera = model.camera(photograph, size)
        view = ReferenceRasterizer()(scene[None], camera[None, None]).over(0.5)[0]
        errors.append((interpolate(view, (side, side), mode="bilinear") - image).square().mean())
    assert errors[1] < errors[0] / 1.5


def test_a_photo_that_is_smaller_than_the_models_images_has_no_detail(model):
    photograph = model.read(torch.rand(3, 16, 20, generator=torch.Generator().manual_seed(0)))
    assert model.front_size(photograph) == model.image_size
    scenes = model(photograph, steps=1, color_fits=1), model(photograph, steps=1, color_fits=1, detail=1)
    assert same(scenes[0][0], scenes[1][0])


@pytest.mark.parametrize("detail", [-1, 4096])
def test_detail_beyond_its_range_is_refused(model, photo, detail):
    with pytest.raises(CompleteSplatError, match="detail="):
        model(photo, detail=detail)
