"""The weights that come with the package: whole, small, and better than guessing on scenes never seen."""

from pathlib import Path

import pytest
import skimage
import torch
from PIL import Image
from support import strict_json

from completesplat.data.toy.module import ToyObjectsDataModule
from completesplat.evaluation.naive_predictors import copy_reference, repeat_image
from completesplat.generator import CompleteSplat
from completesplat.geometry.trajectories import orbit
from completesplat.metrics.images import psnr
from completesplat.rasterizers.tiled import TiledRasterizer
from completesplat.sampling_settings import Sampling
from completesplat.tensors import stack
from completesplat.weights import SHIPPED, SUMS_FILE, locate, shipped

NAME, COUCHES, FRUITS, GENERAL = "toy_objects", "rendered_couches", "fruits", "general"


def test_they_are_small_and_complete():
    assert list(shipped()) == [FRUITS, GENERAL, COUCHES, NAME]
    assert sum(path.stat().st_size for path in SHIPPED.rglob("*") if path.is_file()) < 75e6
    for name in shipped():
        assert (SHIPPED / name / SUMS_FILE).is_file()
        assert locate(name).parent == SHIPPED / name
        facts = strict_json(SHIPPED / name / "config.json")["training"]  # which weights=auto chooses by
        assert {"content", "picture_mean", "picture_std"} <= facts.keys()


@pytest.mark.parametrize(("name", "background"), [(COUCHES, 0.5), (FRUITS, 1.0)])
def test_samples_agree_with_the_photo_in_front_and_differ_behind(name, background):
    """A couch and an apple that training never saw: four samples, from the front and from behind."""
    model = CompleteSplat.from_pretrained(name)
    photo = model.read(SHIPPED / name / "held_out.jpg")
    camera, scenes = model.camera(photo), stack(model(photo, samples=4, steps=8))
    around = orbit(camera, model.middle_depth(model.depth_range) * torch.tensor([0.0, 0.0, 1.0]), model.up, 2)
    cameras = around.map(lambda tensor: tensor.expand(4, *tensor.shape))
    images = TiledRasterizer()(scenes, cameras).over(background).clamp(0, 1)
    front, behind = images[:, 0], images[:, 1]
    assert psnr(front, photo.image.expand(4, -1, -1, -1)).min() > 24
    assert behind.std(0).mean() > 1.5 * front.std(0).mean()


def test_a_photo_of_anything_keeps_its_front_and_gets_depth():
    """A cup in a photo that training never saw: the input view, without fitting, and a relief."""
    model = CompleteSplat.from_pretrained(GENERAL)
    photo = model.read(Path(skimage.__file__).parent / "data/coffee.png")
    (scene,) = model(photo)
    rendering = TiledRasterizer()(scene[None], model.camera(photo)[None, None])
    assert psnr(rendering.over(0.5)[0], photo.image[None]).item() > 24
    depth = rendering.depth[0, 0, 0]
    assert depth[48:80, 48:80].mean() < depth[:12].mean() - 0.3


def test_weights_of_objects_take_a_photo_as_of_their_own_field_of_view(tmp_path):
    model, exif = CompleteSplat.from_pretrained(FRUITS), Image.Exif()
    exif.get_ifd(0x8769)[41989] = 26  # focal length in 35 mm film
    Image.new("RGB", (40, 40), "white").save(tmp_path / "a.jpg", exif=exif)
    photo = model.read(tmp_path / "a.jpg")
    assert (photo.fov_degrees, photo.fov_source) == (model.fov_degrees.item(), "default")
    assert model.read(tmp_path / "a.jpg", 30).fov_source == "given"


def test_samples_fit_the_image_they_are_drawn_for(tmp_path, monkeypatch):
    """Two scenes of another seed than training's: the reference view is met, the naive answers are beaten."""
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {0}, raising=False)  # so that no process has to be started
    size = {"scenes": 20, "frames": 4, "image_size": 64}
    data = ToyObjectsDataModule(str(tmp_path), make=True, **size, data_seed=77, evaluation_batch_size=2)
    data.prepare_data()
    data.setup("test")
    scenes = next(iter(data.test_dataloader()))
    model, truth = CompleteSplat.from_pretrained(NAME), scenes.all_views()
    given = scenes.reference.images, scenes.reference.cameras, scenes.depth_range
    with torch.no_grad():
        images = TiledRasterizer()(model.generate(*given, Sampling(steps=5)), truth.cameras).over(0.5)
    drawn, mean, copied = (
        psnr(other.flatten(0, 1).clamp(0, 1), truth.images.flatten(0, 1)).unflatten(0, truth.images.shape[:2])
        for other in (images, repeat_image(data.mean_image(), scenes), copy_reference(scenes))
    )
    assert drawn[:, 0].min() > 21
    assert drawn[:, 1:].mean() > mean[:, 1:].mean() + 1
    assert drawn[:, 1:].mean() > copied[:, 1:].mean() + 1


@pytest.mark.slow
def test_they_score_as_the_card_says(command, tmp_path):
    """One sample of each of 12 scenes: all pixels and object pixels, against both naive answers."""
    given = ["data=toy_objects", f"data.root={tmp_path / 'data'}", "data.make=true"]
    given += ["data.scenes=120", "data.data_seed=77"]
    assert command("test", f"weights={NAME}", *given, f"out={tmp_path / 'scores'}").status == 0
    scores = strict_json(tmp_path / "scores/metrics.json")
    for region in ("full", "object"):
        psnr_of = {name: scores[name][region]["novel"]["psnr"] for name in ("model", "mean_image", "copy_reference")}
        assert psnr_of["model"] > max(psnr_of["mean_image"], psnr_of["copy_reference"]) + 2
