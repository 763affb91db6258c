"""`predict`, `test` and `view` with Splatter Image's published weights: files of their format with random values."""

import math
from dataclasses import replace

import pytest
import torch
from PIL import Image
from published_weights import write_published
from support import SMALL, compose_config, strict_json

from completesplat.baselines.splatter_image.model import PublishedModel
from completesplat.commands.trained import trained_model
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.export.ply import read_ply
from completesplat.gaussians import DirectionalGaussians
from completesplat.generator import CompleteSplat
from completesplat.training.stage import Stage


def cut_out(path, size=(60, 40)):
    """An orange rectangle of 20 x 10 pixels, transparent around it."""
    photo = Image.new("RGBA", size, (0, 0, 255, 0))
    photo.paste((255, 128, 0, 255), (5, 8, 25, 18))
    photo.save(path)
    return path


def test_a_cut_out_object_lies_on_what_the_weights_know_as_large_as_in_training(tmp_path):
    image = cut_out(tmp_path / "a.png")
    of_objects = PublishedModel(str(write_published(tmp_path / "objects", "objaverse", size=40)))
    photograph = of_objects.read(image)
    assert (photograph.fov_degrees, photograph.fov_source) == (pytest.approx(49.1343, abs=1e-3), "default")
    orange = photograph.image[2] < 0.5
    rows, columns = orange.any(1).nonzero(), orange.any(0).nonzero()
    assert len(columns) == pytest.approx(0.65 * 40, abs=1)
    assert len(rows) == pytest.approx(0.325 * 40, abs=1)
    assert abs(rows.float().mean() - 19.5) <= 1
    assert abs(columns.float().mean() - 19.5) <= 1
    assert photograph.image[:, 0, 0].tolist() == [1, 1, 1]
    of_captures = PublishedModel(str(write_published(tmp_path / "captures", "hydrants", size=40)))
    across = math.degrees(2 * math.atan(1.5 * math.tan(math.radians(30))))  # of the longer side
    seen = of_captures.read(image, across, crop="center")
    assert (seen.fov_degrees, seen.fov_source) == (pytest.approx(60), "given")
    assert seen.image[:, 0, 0].tolist() == [0, 0, 0]  # the central square, its left border cuts the object
    near, far = of_captures.depth_range_of(seen).tolist()
    assert far - near == pytest.approx(4)
    assert (far + near) / 2 == pytest.approx(1.14 * 34.64 / 15, rel=1e-3)  # 15 of the object's 20 pixels are left
    assert of_objects.depth_range_of(photograph).tolist() == pytest.approx([0.8, 3.2])


def test_predict_gives_one_scene_in_the_colours_that_the_camera_sees(command, tmp_path):
    weights = write_published(tmp_path / "objects", "objaverse")
    image = cut_out(tmp_path / "a.png")
    given = [f"image={image}", f"weights={weights}", "out=out", "frames=2", "samples=4"]
    finished = command.succeeds("predict", *given)
    assert "one answer for each image and draws no samples" in finished.out
    assert "give images that are transparent or white around one, or background=remove" in finished.out
    folder = tmp_path / "out/a"
    files = {"sample_00.ply", "orbit_00.mp4", "sheet.png", "scene.json", "photo.png"}
    assert {path.name for path in folder.iterdir()} == files
    settings = strict_json(folder / "scene.json")["settings"]
    assert settings["depth_range"] == pytest.approx([0.8, 3.2])
    assert not {"sampler", "steps"} & settings.keys()
    assert settings["samples"] == 1
    model = CompleteSplat.from_pretrained(weights)
    assert isinstance(model, PublishedModel)
    scene = model(image, color_fits=40)[0]
    stored, center = read_ply(folder / "sample_00.ply"), torch.zeros(3)
    assert isinstance(stored, DirectionalGaussians)
    torch.testing.assert_close(stored.seen_from(center).colors, scene.seen_from(center).colors, atol=1e-4, rtol=0)
    for settings, message in (
        ("fov=40", "image as of 49 degrees"),
        ("sampler=dpm20", "these weights draw no samples: leave out sampler"),
    ):
        assert message in command.refuses("predict", *given, settings)
    with pytest.raises(CompleteSplatError, match="samples=2: this model draws none"):
        model(image, samples=2)
    with pytest.raises(WeightsError, match="copy these"):
        model.save_pretrained(tmp_path / "copy")


def test_a_photograph_of_an_object_becomes_a_scene_without_its_background(rembg, command, tmp_path):
    weights = write_published(tmp_path / "objects", "objaverse", size=40)
    photo = Image.new("RGB", (120, 80), "red")
    photo.paste((0, 128, 255), (5, 8, 25, 18))
    photo.save(tmp_path / "a.png")
    command.succeeds(
        "predict", "a.png", f"weights={weights}", "out=out", "video=[]", "color_fits=1", "background=remove"
    )
    model = CompleteSplat.from_pretrained(weights)
    seen = model.read(tmp_path / "a.png", remove_background=True)
    blue = seen.image[0] < 0.5
    assert blue.sum() == pytest.approx(26 * 13, rel=0.1)
    assert (seen.image[:, ~blue] > 0.5).all()  # no red is left
    torch.testing.assert_close(read_ply(tmp_path / "out/a/sample_00.ply").means, model(seen)[0].means)
    assert strict_json(tmp_path / "out/a/scene.json")["settings"]["background"] == "remove"


def test_what_is_hidden_counts_as_background(tmp_path):
    model = CompleteSplat.from_pretrained(write_published(tmp_path, "objaverse"))
    photograph = model.read(cut_out(tmp_path / "a.png"))
    visible = torch.ones(1, 16, 16)
    visible[..., 8:] = 0
    changed = replace(photograph, image=photograph.image.clone())
    changed.image[..., 8:] = 1
    plain = {"color_fits": 0, "detail": 0}
    assert torch.equal(model(photograph, visible, **plain)[0].means, model(changed, **plain)[0].means)
    assert not model.architecture.get("training", {}).get("box_masks")


def test_a_test_sees_objects_only_at_their_depths_and_its_figures_stand_apart(command, pipeline, tmp_path):
    weights = write_published(tmp_path / "captures", "hydrants", size=32)
    given = ["ckpt=null", f"weights={weights}", "data=toy_objects", f"data.root={pipeline.toy}"]
    command.succeeds("test", *given, "trainer.accelerator=cpu", "out=out")
    metrics = strict_json(tmp_path / "out/metrics.json")
    assert (metrics["protocol"]["method"], metrics["protocol"]["background"]) == ("PublishedSplatterImage", 0)
    assert metrics["protocol"]["checkpoint"]["path"] == str(weights)
    assert metrics["model"]["full"]["novel"]["psnr"] > 0
    config = compose_config("test", *given)
    names = ("ckpt", "weights", "overrides", "seed", "trust", "data", "rasterizer")
    module, data = trained_model(**{name: config[name] for name in names}).open()
    assert not isinstance(module, Stage)  # nothing is trained, so there is no optimizer
    data.prepare_data()
    data.setup("test")
    scenes = next(iter(data.test_dataloader()))
    scenes = getattr(scenes, "scenes", scenes)
    assert (scenes.reference.images * (scenes.reference.masks == 0)).max() == 0
    result = module.eval().reconstruct(scenes)
    depths = module.model.depths.range(scenes.depth_range)
    torch.testing.assert_close(depths[:, 1] - depths[:, 0], torch.full((len(depths),), 4.0))
    torch.testing.assert_close(depths[:, 1], scenes.depth_range[:, 1])
    assert result.means.shape == (len(depths), 32 * 32, 3)


def test_what_is_trained_on_is_predicted_with_from_its_run(command, toy_root, tmp_path):
    weights = write_published(tmp_path / "captures", "hydrants", size=32)
    given = ["experiment=toy_var", "model=splatter_image_published", f"model.model.weights={weights}", *SMALL]
    given += [f"data.root={toy_root}", "data.background=0", "callbacks.images=null", "test=false"]
    refused = command.refuses("fit", *given, "data.image_size=64", "out=OTHER")
    assert refused == "data.image_size=64: model_hydrants.pth needs 32"
    command.succeeds("fit", *given, "optimizer.lr=1e-3", "out=RUN")
    files = sorted(path.name for path in (tmp_path / "RUN/weights").iterdir())
    assert files == ["config_hydrants.yaml", "model_hydrants.pth"]
    before, after = (CompleteSplat.from_pretrained(path).network.state_dict() for path in (weights, tmp_path / "RUN"))
    same = {name for name, value in before.items() if torch.equal(value, after[name])}
    assert same < set(before)
    quick = ["samples=1", "video=[]", "color_fits=1", "rasterizer=reference", "out=OUT"]
    command.succeeds("predict", str(cut_out(tmp_path / "a.png")), "weights=RUN", *quick)
    assert (tmp_path / "OUT/a/sample_00.ply").is_file()
