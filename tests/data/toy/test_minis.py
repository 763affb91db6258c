"""Minis: what their back could be is known, and what the front says about it."""

import os
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch

from completesplat.data.toy.mini_scene import CHANCES, draw_mini
from completesplat.data.toy.module import ToyObjectsDataModule
from completesplat.data.toy.object_scene import PATCH_COLORS, render_frame


def nose_is_dark(scene):
    """By what is seen: the nose is the only grey thing on the object."""
    image, coverage, _ = render_frame(scene, 0, 64)
    pixels = image[coverage > 0.99]
    grey = pixels[np.ptp(pixels, axis=-1) < 0.03 * pixels.max(-1)]
    return bool(np.median(grey) < 0.2)


@pytest.fixture(scope="module")
def marked():
    return [draw_mini(np.random.default_rng([1, i]), 2, marked=True) for i in range(240)]


@pytest.mark.parametrize("mark", CHANCES)
def test_colours_of_marked_minis_come_as_often_as_the_nose_says(mark, marked):
    own = [scene for scene in marked if np.array_equal(scene.chances, CHANCES[mark])]
    assert 80 < len(own) < 160
    assert all(nose_is_dark(scene) == (mark == "dark") for scene in own[:20])
    found = Counter(scene.patch_color for scene in own)
    shares = np.array([found[name] / len(own) for name in PATCH_COLORS])
    # Three standard deviations of a share of 120 draws are 0.13.
    np.testing.assert_allclose(shares, CHANCES[mark], atol=0.13)


def test_the_front_does_not_tell_the_colour_and_the_back_does():
    for i in range(5):
        scene = draw_mini(np.random.default_rng([2, i]), 24)
        pictures = [
            [render_frame(other, frame, 32)[0] for frame in (0, 12)]
            for other in (scene, *(recolored(scene, color) for color in PATCH_COLORS.values()))
        ]
        fronts, backs = zip(*pictures, strict=True)
        assert all(np.array_equal(front, fronts[0]) for front in fronts)
        assert np.abs(backs[1] - backs[2]).max() > 0.3


def recolored(scene, color):
    return replace(scene, patch=scene.patch._replace(color=np.array(color)))


@pytest.mark.parametrize("category", ["toy_minis", "toy_marked_minis"])
def test_hidden_modes_of_written_minis_are_known_with_their_probabilities(tmp_path, monkeypatch, category):
    monkeypatch.setattr(os, "cpu_count", lambda: 1)  # so that no process has to be started
    data = ToyObjectsDataModule(str(tmp_path), 20, 12, category=category, make=True, image_size=32)
    data.prepare_data()
    scenes = data.hidden_modes(views=2, spread_views=2)
    for scene in (scenes[i] for i in range(len(scenes))):
        expected = [0.25] * 4 if category == "toy_minis" else sorted(CHANCES["dark"])
        assert sorted(scene.probabilities.tolist()) == pytest.approx(expected)
        truth = scene.truths[scene.true_mode]
        stored = scene.scene.targets.images[0, list(scene.views)]
        assert (truth - stored).square().mean().sqrt() < 0.03
        assert scene.region.any()
        assert torch.unique(scene.truths.flatten(1), dim=0).shape[0] == 4
