"""`weights=auto`: the weights in the package whose training images are nearest to the photo."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from support import compose_config, strict_json

from completesplat.commands.trained import nearest_weights, open_generator
from completesplat.errors import WeightsError
from completesplat.scene_model import distances_to_shipped
from completesplat.weights import SHIPPED, shipped

COUCH = SHIPPED / "rendered_couches/held_out.jpg"


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Three folders of weights in place of the package's; their training images had these mean colours and sizes."""
    folders = {}
    for name, size, mean in (("blues", 16, [0, 0, 1.0]), ("greens", 48, [0, 1.0, 0]), ("reds", 24, [1.0, 0, 0])):
        folders[name] = tmp_path / "package" / name
        folders[name].mkdir(parents=True)
        training = {"picture_mean": mean + [0.0] * 5, "picture_std": [0.1] * 8}
        (folders[name] / "config.json").write_text(json.dumps({"image_size": size, "training": training}))
    for module in ("scene_model", "commands.trained"):
        monkeypatch.setattr(f"completesplat.{module}.shipped", lambda: folders)
    return folders


def photo(path: Path, color: str) -> Path:
    Image.new("RGB", (60, 50), color).save(path)
    return path


def test_the_nearest_to_the_first_image_that_can_be_read_are_chosen_and_the_others_are_named(package, tmp_path):
    red, green = (photo(tmp_path / f"{color}.png", color) for color in ("red", "lime"))
    (tmp_path / "broken.png").write_text("no image")
    name, reason = nearest_weights([green], remove_background=False)
    assert name == "greens"
    # Two of eight features differ by 1 from the other weights' mean, and deviations are 0.1: sqrt(2 / 8) / 0.1 = 5.
    distances = "(0.0 standard deviations, blues 5.0, reds 5.0)"
    assert reason == f"; their training images are most like lime.png {distances}"
    name, reason = nearest_weights([tmp_path / "broken.png", tmp_path / "gone.png", red, green], False)
    assert name == "reds"
    assert "most like the first image, red.png (0.0" in reason
    name, reason = nearest_weights([tmp_path / "broken.png"], False)
    assert (name, reason) == ("blues", "; there is no image to choose by (weights=NAME takes others: greens, reds)")
    package.clear()
    with pytest.raises(WeightsError, match="this package has no weights; give weights=DIR"):
        nearest_weights([red], False)


def test_weights_of_anything_are_for_images_that_are_like_no_others(package, tmp_path):
    config = json.loads((package["blues"] / "config.json").read_text())
    config["training"] = {"picture_mean": [0.5] * 3 + [0.0] * 5, "picture_std": [0.5] * 8}
    (package["blues"] / "config.json").write_text(json.dumps(config))
    # For the darker red the others are nearer, but its own are likelier.
    for color, chosen, distances in (("#b70000", "reds", [1.0, 0.5, 4.4]), ("black", "blues", [0.6, 3.5, 3.5])):
        found = distances_to_shipped(photo(tmp_path / "photo.png", color))
        assert next(iter(found)) == chosen
        assert list(found.values()) == pytest.approx(distances, abs=0.05)


@pytest.mark.parametrize(("border", "chosen"), [("white", "reds"), ("red", "blues")])
def test_weights_of_objects_on_white_are_for_images_whose_border_is_white(package, tmp_path, border, chosen):
    config = json.loads((package["reds"] / "config.json").read_text())
    config["training"]["background"] = 1.0
    (package["reds"] / "config.json").write_text(json.dumps(config))
    image = Image.new("RGB", (60, 60), border)
    image.paste("red", (3, 3, 60, 57))  # the object touches the right side
    image.save(tmp_path / "object.png")
    assert next(iter(distances_to_shipped(tmp_path / "object.png"))) == chosen


def test_distances_are_of_the_image_at_the_size_of_each_model(package, tmp_path):
    pixels = np.random.default_rng(0).integers(0, 256, (48, 48, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "noise.png")
    distances = distances_to_shipped(tmp_path / "noise.png")
    assert list(distances.values()) == sorted(distances.values())
    for name, folder in package.items():
        config = json.loads((folder / "config.json").read_text())
        side = config["image_size"]
        values = np.asarray(Image.fromarray(pixels).resize((side, side), Image.Resampling.LANCZOS)) / 255
        detail = [np.abs(np.diff(values, axis=axis)).mean() for axis in (1, 0)]
        features = np.array([*values.mean((0, 1)), *values.std((0, 1)), *detail])
        expected = np.sqrt(np.square((features - config["training"]["picture_mean"]) / 0.1).mean())
        assert distances[name] == pytest.approx(expected, rel=1e-5)


def test_the_default_chooses_and_says_so_in_one_line(command, tmp_path):
    quick = ["samples=1", "steps=1", "color_fits=0", "video=[]"]
    finished = command.succeeds("predict", f"image={COUCH}", f"out={tmp_path / 'out'}", *quick)
    (line,) = [line for line in finished.out.splitlines() if line.startswith("weights: ")]
    assert line.startswith("weights: rendered_couches, which come with the package and know renders of ")
    assert "most like held_out.jpg (" in line
    assert all(name in line for name in shipped())
    assert strict_json(tmp_path / "out/held_out/scene.json")["settings"]["weights"] == "rendered_couches"


@pytest.mark.parametrize("verb", ["predict", "view"])
def test_weights_by_name_are_taken_as_they_are(verb, capsys, monkeypatch):
    monkeypatch.setattr("completesplat.commands.trained.nearest_weights", lambda *_: pytest.fail("chosen"))
    config = compose_config(verb, f"image={COUCH}", "weights=toy_objects")
    open_generator(config, [COUCH])
    assert config.weights == "toy_objects"
    line = "weights: toy_objects, which come with the package and know procedural toy objects, not photographs\n"
    assert capsys.readouterr().out == line
    assert compose_config(verb, f"image={COUCH}").weights == "auto"
