"""Regularisers of the Gaussians: off unless they are given a weight."""

import pytest
import torch
from hydra.utils import instantiate
from support import compose_config, some_gaussians

from completesplat.geometry.cameras import Cameras
from completesplat.losses import Prediction
from completesplat.losses.regularizers import MeanOpacity, MeanScale
from completesplat.scene import Views

IMAGES = torch.zeros(2, 1, 3, 4, 4)
CAMERAS = Cameras(torch.eye(4).expand(2, 1, 4, 4), torch.eye(3).expand(2, 1, 3, 3), (4, 4))
TRUTH = Views(IMAGES, CAMERAS, torch.ones(2, 1, 1, 4, 4))


def test_they_are_means_over_all_gaussians():
    prediction = Prediction(IMAGES, some_gaussians(2, scale=0.3, opacity=0.7), None)
    assert MeanScale()(prediction, TRUTH).item() == pytest.approx(0.3)
    assert MeanOpacity()(prediction, TRUTH).item() == pytest.approx(0.7)


@pytest.mark.parametrize("name", ["scale", "opacity"])
def test_one_is_on_when_it_has_a_weight(name):
    off = instantiate(compose_config("fit").loss, _convert_="all")
    on = instantiate(compose_config("fit", f"loss.terms.{name}.weight=0.01").loss, _convert_="all")
    assert set(on.terms) - set(off.terms) == {name}
    assert on.terms[name].weight == 0.01
