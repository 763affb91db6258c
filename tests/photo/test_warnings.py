"""What is said of photos from which scenes are likely to be wrong."""

from dataclasses import replace

import pytest
import torch
from PIL import Image
from support import shipped_folders

from completesplat.photo.photograph import read_photograph
from completesplat.photo.reading import Framing, Photograph, read_square
from completesplat.photo.warnings import hidden_parts_warning, photo_warnings, unusual_field_of_view

REDS = {"picture_mean": [1.0, 0, 0, 0, 0, 0, 0, 0], "picture_std": [0.1] * 8}


def of_color(color: str) -> Photograph:
    return read_square(Image.new("RGB", (40, 32), color), Framing(32), fov_degrees=15)


def test_a_photo_unlike_the_training_images_gets_a_warning_with_nearer_weights(tmp_path, monkeypatch):
    red, blue = of_color("red"), of_color("blue")
    fov, unlike, elsewhere = photo_warnings(blue, REDS, 50.0)
    assert "field of view is 15" in fov
    assert "unlike the training images (5.0 standard deviations away, where 2 is far): " in unlike
    assert max(len(unlike), len(elsewhere)) <= 190
    partly_hidden = replace(blue, visible=torch.zeros(1, 32, 32))
    assert len(photo_warnings(red, REDS, 50.0)) == len(photo_warnings(partly_hidden, REDS, 50.0)) == 1
    assert len(photo_warnings(blue, {}, 50.0)) == 1  # nothing is known of the training
    means = {"reds": (0.9, 0, 0), "blues": (0, 0, 1), "greens": (0, 0.5, 0), "unknown": None}
    folders = shipped_folders(tmp_path, **{name: (24, mean) for name, mean in means.items()})
    monkeypatch.setattr("completesplat.photo.choice.shipped", lambda: folders)
    assert photo_warnings(blue, REDS, 50.0)[2] == "weights=blues were trained on images that are nearer (0.0)"
    monkeypatch.setattr("completesplat.photo.choice.shipped", lambda: {"reds": folders["reds"]})
    near, elsewhere = photo_warnings(blue, REDS, 50.0)[2].split("; ", 1)
    assert near == "weights=reds were trained on images that are nearer (4.8)"  # but not near
    assert all(name in elsewhere for name in ("weights=splatter_image:objaverse", "github.com/apple/ml-sharp"))


def test_whoever_reads_a_photo_through_the_door_is_warned_by_its_name(tmp_path, caplog):
    Image.new("RGB", (32, 32), "blue").save(tmp_path / "a.png")
    for source, name in ((tmp_path / "a.png", "a.png"), (Image.open(tmp_path / "a.png"), "the image")):
        caplog.clear()
        read_photograph(source, Framing(32, training=REDS))
        assert [record.getMessage().partition(":")[0] for record in caplog.records] == [name, name]
        caplog.clear()
        read_photograph(source, Framing(32))  # as other images than a model's photo are read
        assert caplog.records == []


def test_hidden_parts_are_warned_of_unless_they_were_trained_with():
    for training, mask, box, setting in (
        ({}, None, [0, 0, 1, 1], "box"),
        ({"box_masks": 0.0}, "m.png", None, "mask"),
        ({"box_masks": 0.5}, "m.png", None, None),
        ({}, None, None, None),
    ):
        warning = hidden_parts_warning(training, mask, box)
        assert (None if warning is None else warning.partition(": these weights were not trained")[0]) == setting


@pytest.mark.parametrize(
    ("own", "trained", "message"),
    [
        (69.0, 50.0, None),  # tan 34.5 / tan 25 = 1.47
        (90.0, 2 * 26.565051, "about 2.0 times too flat"),  # tan 45 = 2 tan 26.57
        (2 * 26.565051, 90.0, "about 2.0 times too deep"),
        (20.0, 50.0, "the field of view is 20 degrees (from EXIF; fov=DEGREES overrides it), 50 in training"),
    ],
)
def test_a_field_of_view_far_from_trainings_is_told_with_what_it_does(own, trained, message):
    square = Image.new("RGB", (8, 8))
    photograph = Photograph(torch.zeros(3, 8, 8), own, "exif", (8, 8), square, (0, 0, 8, 8))
    warning = unusual_field_of_view(photograph, trained)
    assert (warning is None) if message is None else (message in warning)
