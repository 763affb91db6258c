import math

import pytest
import torch

from completesplat.geometry.cameras import Cameras
from completesplat.metrics.evaluation import Evaluation
from completesplat.scene import SceneBatch, Views


def scenes(batch: int, targets: int) -> SceneBatch:
    def views(*axes: int) -> Views:
        cameras = Cameras(torch.eye(4).expand(*axes, 4, 4), torch.eye(3).expand(*axes, 3, 3), (16, 16))
        mask = torch.zeros(*axes, 1, 16, 16)
        mask[..., :8, :] = 1
        return Views(torch.full((*axes, 3, 16, 16), 0.5), cameras, mask)

    names = tuple(f"scene {i}" for i in range(batch))
    depth_range, visible = torch.tensor([[1.0, 2.0]]).expand(batch, 2), torch.ones(batch, 1, 16, 16)
    frames = torch.zeros(batch, dtype=torch.int64)
    return SceneBatch(views(batch), views(batch, targets), depth_range, visible, frames, names)


def test_views_are_averaged_within_scenes_before_scenes_are():
    """One scene with 1 novel view at 20 dB and one with 3 at 40 dB average to 30 dB, not to 35."""
    evaluation = Evaluation()
    for targets, error in ((1, 0.1), (3, 0.01)):
        images = torch.full((1, 1 + targets, 3, 16, 16), 0.5 + error)
        evaluation.update("model", images, scenes(1, targets))
    results = evaluation.results()["model"]
    assert results["full"]["novel"]["psnr"] == pytest.approx(30, abs=1e-3)
    assert (results["scenes"], results["views"]) == (2, 4)


def test_reference_and_novel_views_are_apart():
    images = torch.full((1, 3, 3, 16, 16), 0.5)
    images[:, 0] += 0.1
    evaluation = Evaluation()
    evaluation.update("model", images, scenes(1, 2))
    results = evaluation.results()["model"]["full"]
    assert results["reference"]["psnr"] == pytest.approx(20, abs=1e-3)
    assert results["novel"]["psnr"] == 100


def test_object_scores_ignore_the_background():
    images = torch.full((1, 2, 3, 16, 16), 0.6)
    images[..., 8:, :] = 0.0
    evaluation = Evaluation()
    evaluation.update("model", images, scenes(1, 1))
    results = evaluation.results()["model"]
    # An error of 0.1 on the object's half of the image, both backgrounds black.
    assert results["object"]["novel"]["psnr"] == pytest.approx(-10 * math.log10(0.01 / 2), abs=1e-3)
    assert results["full"]["novel"]["psnr"] == pytest.approx(-10 * math.log10((0.01 + 0.25) / 2), abs=1e-3)


def test_values_out_of_range_are_clipped():
    images = torch.full((1, 2, 3, 16, 16), 7.0)
    evaluation = Evaluation()
    evaluation.update("model", images, scenes(1, 1))
    assert evaluation.results()["model"]["full"]["novel"]["psnr"] == pytest.approx(-10 * math.log10(0.25), abs=1e-3)
