"""The figures: what is drawn, and where."""

import warnings

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from completesplat.studies.controls import plot_controls
from completesplat.studies.masked import box_visibility
from completesplat.studies.samplers import plot_samplers
from completesplat.studies.samples import Strip, draw_strips

CRIMSON = (220, 20, 60)


def read(path) -> np.ndarray:
    return imageio.imread(path)[..., :3]


def shows(image: np.ndarray, color: tuple[int, int, int]) -> bool:
    return bool((image == color).all(-1).any())


def plain(*color: int, count: int = 1) -> torch.Tensor:
    return (torch.tensor(color) / 255).view(1, 3, 1, 1).expand(count, 3, 4, 4)


def test_strips_stand_in_their_rows_and_columns(tmp_path):
    red, green, blue = (250, 10, 10), (10, 250, 10), (10, 10, 250)
    rows = [[Strip(plain(*red), "a"), None], [Strip(plain(*green, count=2), "b"), Strip(plain(*blue), "c")]]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        draw_strips(rows, ["first", "second"], tmp_path / "strips.png", "title")
    image = read(tmp_path / "strips.png")
    places = {color: np.argwhere((image == color).all(-1)) for color in (red, green, blue)}
    assert places[red][:, 0].max() < places[green][:, 0].min()
    assert places[green][:, 1].max() < places[blue][:, 1].min()
    # All pictures are of one size, though a strip holds fewer of them.
    assert np.ptp(places[red][:, 0]) == pytest.approx(np.ptp(places[blue][:, 0]), rel=0.06)
    assert len(places[green]) > 1.9 * len(places[red])


def controls(paper: bool) -> list[dict]:
    row = {"skip_weight": 0.5, "guidance_weight": 0.5, "diversity": 0.1, "reference_psnr": 20.0}
    return [row | {"paper": paper, "near_object_psnr": None}]


def test_the_papers_settings_are_marked(tmp_path):
    for paper in (True, False):
        plot_controls(controls(paper), tmp_path / "controls.png", "title")
        assert shows(read(tmp_path / "controls.png"), CRIMSON) == paper


def test_each_sampler_has_its_line(tmp_path):
    measures = {"psnr": 20.0, "ssim": 0.5, "diversity": 0.1, "agreement": 30.0, "ms": 9.0}
    rows = [{"sampler": "ddim", "steps": n, "calls": n} | measures for n in (50, 10)]
    plot_samplers(rows, tmp_path / "one.png", "title")
    plot_samplers([*rows, {"sampler": "dpm", "steps": 5, "calls": 5} | measures], tmp_path / "two.png", "title")
    orange = (255, 127, 14)
    assert not shows(read(tmp_path / "one.png"), orange)
    assert shows(read(tmp_path / "two.png"), orange)


def test_a_box_hides_the_pixels_that_it_touches():
    expected = torch.ones(1, 8, 8)
    expected[:, 2:5, 4:8] = 0
    assert torch.equal(box_visibility([0.5, 0.25, 1, 0.6], 8), expected)
