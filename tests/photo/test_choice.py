"""`weights=auto`: the weights in the package that are likeliest for the photos."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.stats import norm
from skimage import data
from support import change_json, compose_config, shipped_folders, strict_json, tiny_generator

from completesplat.commands.trained import open_generator
from completesplat.errors import ImageError, WeightsError
from completesplat.generator import CompleteSplat
from completesplat.photo.choice import likeliest_weights, match_shipped
from completesplat.weights import SHIPPED, shipped

COUCH = SHIPPED / "rendered_couches/held_out.jpg"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Three folders of weights in place of the package's; their training images had these mean colours and sizes."""
    folders = shipped_folders(tmp_path / "package", blues=(16, (0, 0, 1)), greens=(48, (0, 1, 0)), reds=(24, (1, 0, 0)))
    for module in ("photo.choice", "commands.trained"):
        monkeypatch.setattr(f"completesplat.{module}.shipped", lambda: folders)
    return folders


def photo(path: Path, color: str) -> Path:
    Image.new("RGB", (60, 50), color).save(path)
    return path


def test_the_likeliest_for_the_images_that_can_be_read_are_chosen_and_the_others_are_named(package, tmp_path):
    red, green = (photo(tmp_path / f"{color}.png", color) for color in ("red", "lime"))
    (tmp_path / "broken.png").write_text("no image")
    name, reason = likeliest_weights([green], remove_background=False)
    assert (name, reason) == ("greens", "; the likeliest for lime.png: greens 100%, blues 0%, reds 0%")
    # Two of eight features differ by 1 from the other weights' mean, and deviations are 0.1: sqrt(2 / 8) / 0.1 = 5.
    assert [x.distance for x in match_shipped(green).values()] == pytest.approx([0, 5, 5], abs=1e-3)
    images = [tmp_path / "broken.png", tmp_path / "gone.png", green, red, red]
    name, reason = likeliest_weights(images, False)
    assert (name, reason) == ("reds", "; the likeliest for 3 of 5 images: reds 67%, greens 33%, blues 0%")
    others = "or give weights=greens or weights=reds"
    assert likeliest_weights(images[:2], False) == ("blues", f"; taken because no image can be read, {others}")
    assert likeliest_weights([], False) == ("blues", f"; taken because there is no image to choose by, {others}")
    for name in ("blues", "greens"):  # of one kind each
        change_json(package[name] / "config.json", lambda config: config["training"].update(log_odds=1.0))
    assert likeliest_weights(images[:2], False)[0] == "reds"
    package.clear()
    with pytest.raises(WeightsError, match="this package has no weights; give weights=DIR"):
        likeliest_weights([red], False)


def test_of_many_images_a_few_from_all_over_are_looked_at(package, tmp_path):
    many = [photo(tmp_path / f"{number}.png", "red" if number < 20 else "lime") for number in range(50)]
    name, reason = likeliest_weights(many, False)
    assert (name, reason) == ("greens", "; the likeliest for 8 of 50 images: greens 62%, reds 38%, blues 0%")


def test_probabilities_are_those_of_normal_distributions_and_log_odds(package, tmp_path):
    training = {"picture_mean": [0.5] * 3 + [0.0] * 5, "picture_std": [0.5] * 8}
    change_json(package["blues"] / "config.json", lambda config: config.update(training=training))
    change_json(package["reds"] / "config.json", lambda config: config["training"].update(log_odds=1.5))
    found = match_shipped(photo(tmp_path / "photo.png", "#b70000"))  # nearer to blues, but likelier among reds
    features = np.array([0xB7 / 255, 0, 0, 0, 0, 0, 0, 0])
    broad, narrow = np.full(8, 0.5), np.full(8, 0.1)
    kinds = {"reds": ([1, 0, 0], narrow, 1.5), "blues": ([0.5] * 3, broad, 0), "greens": ([0, 1, 0], narrow, 0)}
    densities = {
        name: norm.pdf(features, [*mean, 0, 0, 0, 0, 0], deviation).prod() * np.exp(odds)
        for name, (mean, deviation, odds) in kinds.items()
    }
    assert list(found) == ["reds", "blues", "greens"]
    assert found["blues"].distance < found["reds"].distance
    for name, match in found.items():
        assert match.probability == pytest.approx(densities[name] / sum(densities.values()), rel=1e-3, abs=1e-12)


def test_odds_by_features_are_against_the_weights_for_photos_of_anything(package, tmp_path):
    """Red weighs 4, so a photo of red 0.5 has odds of exp(2 - 1), although it is far from the training images."""
    odds = {"log_odds": -1.0, "feature_odds": [4.0] + [0.0] * 7}
    change_json(package["reds"] / "config.json", lambda config: config["training"].update(odds))
    change_json(package["greens"] / "config.json", lambda config: config["training"].update(log_odds=-100.0))
    found = match_shipped(photo(tmp_path / "photo.png", "#800000"))
    assert found["reds"].distance > 1
    assert found["reds"].probability == pytest.approx(1 / (1 + np.exp(1 - 4 * 128 / 255)), rel=1e-3)
    assert found["blues"].probability == pytest.approx(1 - found["reds"].probability, rel=1e-3)


@pytest.mark.parametrize(("border", "chosen"), [("white", "reds"), ("red", "blues")])
def test_weights_of_objects_on_white_are_for_images_whose_border_is_white(package, tmp_path, border, chosen):
    change_json(package["reds"] / "config.json", lambda config: config["training"].update(background=1.0))
    image = Image.new("RGB", (60, 60), border)
    image.paste("red", (3, 3, 60, 57))  # the object touches the right side
    image.save(tmp_path / "object.png")
    assert next(iter(match_shipped(tmp_path / "object.png"))) == chosen


def test_distances_are_of_the_image_at_the_size_of_each_model(package, tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (48, 48, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "noise.png")
    matches = match_shipped(tmp_path / "noise.png")
    for name, folder in package.items():
        config = json.loads((folder / "config.json").read_text())
        side = config["image_size"]
        values = np.asarray(Image.fromarray(pixels).resize((side, side), Image.Resampling.LANCZOS)) / 255
        detail = [np.abs(np.diff(values, axis=axis)).mean() for axis in (1, 0)]
        features = np.array([*values.mean((0, 1)), *values.std((0, 1)), *detail])
        expected = np.sqrt(np.square((features - config["training"]["picture_mean"]) / 0.1).mean())
        assert matches[name].distance == pytest.approx(expected, rel=1e-5)


def test_the_default_chooses_and_says_so_in_one_line(command, tmp_path):
    quick = ["samples=1", "steps=1", "color_fits=0", "video=[]"]
    finished = command.succeeds("predict", f"image={COUCH}", f"out={tmp_path / 'out'}", *quick)
    (line,) = [line for line in finished.out.splitlines() if line.startswith("weights: ")]
    assert line.startswith("weights: rendered_couches, trained on renders of ")
    assert "; the likeliest for held_out.jpg: rendered_couches " in line
    assert all(name in line for name in shipped())
    assert strict_json(tmp_path / "out/held_out/scene.json")["settings"]["weights"] == "rendered_couches"


@pytest.mark.parametrize("verb", ["predict", "view"])
def test_weights_by_name_are_taken_as_they_are(verb, capsys, monkeypatch):
    monkeypatch.setattr("completesplat.commands.trained.likeliest_weights", lambda *_: pytest.fail("chosen"))
    config = compose_config(verb, f"image={COUCH}", "weights=toy_objects")
    open_generator(config, [COUCH])
    assert config.weights == "toy_objects"
    line = "weights: toy_objects, trained on procedural toy objects, not photographs\n"
    assert capsys.readouterr().out == line
    assert compose_config(verb, f"image={COUCH}").weights == "auto"


def test_python_chooses_as_predict_does_and_refuses_what_is_no_photo(tmp_path, caplog, monkeypatch):
    opened = []
    model = tiny_generator()
    monkeypatch.setattr(CompleteSplat, "from_pretrained", staticmethod(lambda name: opened.append(name) or model))
    caplog.set_level("INFO")
    CompleteSplat.for_photo(str(COUCH))
    CompleteSplat.for_photo(data.astronaut())
    assert opened == ["rendered_couches", "general"]
    assert "weights: rendered_couches; the likeliest for held_out.jpg: rendered_couches " in caplog.text
    assert "weights: general; the likeliest for the photo: general " in caplog.text
    (tmp_path / "a.jpg").write_text("no photo")
    with pytest.raises(ImageError):
        CompleteSplat.for_photo(tmp_path / "a.jpg")
    assert len(opened) == 2
