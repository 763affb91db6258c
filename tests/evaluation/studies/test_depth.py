"""Disagreement of samples in depth, on scenes whose depth is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from support import some_gaussians

from completesplat.evaluation.studies.depth import color_deviation, depth_rows, depth_strips, deviation, deviations
from completesplat.evaluation.studies.samples import SampleRenderer
from completesplat.export.images import NOTHING, ramp
from completesplat.generator import CompleteSplat
from completesplat.geometry.cameras import Cameras, look_at, pinhole
from completesplat.rasterizers.reference import ReferenceRasterizer
from completesplat.scene import SceneBatch, Views
from completesplat.tensors import stack

SIZE, AWAY = 16, 3.0
CENTER = torch.tensor([0.0, 0, AWAY])
SETTINGS = [(0.0, 0.5), (1.0, 0.2)]


def cameras(*eyes: tuple[float, float, float]) -> Cameras:
    poses = look_at(torch.tensor(eyes), CENTER, torch.tensor([0.0, -1, 0]))
    return Cameras(poses, pinhole(40, SIZE).expand(len(eyes), 3, 3), (SIZE, SIZE))


def scene() -> SceneBatch:
    """Seen from the front; targets are the left, the back and almost the front. The object: the middle column."""
    masks = torch.zeros(4, 1, SIZE, SIZE)
    masks[..., SIZE // 2] = 1
    views = Views(torch.rand(4, 3, SIZE, SIZE), cameras((0, 0, 0), (-AWAY, 0, AWAY), (0, 0, 6), (0.1, 0, 0)), masks)
    visible = torch.ones(1, SIZE, SIZE)
    return stack([SceneBatch(views[0], views[1:], torch.tensor([1.0, 5]), visible, torch.tensor(0), "a")])


class Splats(CompleteSplat):
    """A generator whose samples are one large flat splat each, pushed back by `shift` times their number."""

    def __init__(self, shift: float) -> None:
        torch.nn.Module.__init__(self)
        self.shift = shift

    def generate(self, images, cameras, depth_range, sampling):
        samples = sampling.samples
        splats = some_gaussians(samples, scale=2.0, opacity=0.9)
        depth = AWAY + (1 - sampling.skip_weight) * self.shift * torch.arange(samples)[:, None, None]
        thin = splats.scales * torch.tensor([1, 1, 1e-3])
        return replace(splats, means=depth * torch.tensor([0.0, 0, 1]).expand(samples, 2, 3), scales=thin)


def renderer(shift: float = 0.5, samples: int = 3) -> SampleRenderer:
    return SampleRenderer(Splats(shift), ReferenceRasterizer(), 0.5, samples, 0)


def test_deviation_is_numpys_over_the_samples_that_see_something():
    depth = torch.rand(5, 2, 1, 4, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    depth[depth < 0.4] = 0
    expected = torch.full((2, 1, 4, 4), torch.nan, dtype=torch.float64)
    for place in np.ndindex(2, 1, 4, 4):
        known = [value for value in depth[:, *place].tolist() if value > 0]
        if len(known) > 1:
            expected[place] = np.std(known, ddof=1)
    assert 0 < expected.isnan().sum() < expected.numel()
    torch.testing.assert_close(deviation(depth), expected, equal_nan=True)


def test_a_shift_in_depth_is_its_deviation_in_the_reference_view():
    free, faithful = depth_rows(renderer(), SETTINGS, [scene()], 90, lambda _: None)
    for name in ("reference", "reference_object"):
        assert free[f"{name}_deviation"] == pytest.approx(0.5, abs=1e-3)
        assert faithful[f"{name}_deviation"] == pytest.approx(0, abs=1e-5)
    assert free["reference_measured"] == 1
    assert (free["skip_weight"], free["guidance_weight"], free["paper"]) == (0, 0.5, True)


def depths() -> torch.Tensor:
    """Two samples, that differ by the view's number, and on the object by twice that."""
    depth = torch.ones(2, 4, 1, SIZE, SIZE)
    depth[1] += torch.arange(4.0)[:, None, None, None]
    depth[1, ..., SIZE // 2] += torch.arange(4.0)[:, None, None]
    return depth


@pytest.mark.parametrize(("far_degrees", "views"), [(89, [1, 2]), (91, [2]), (1, [1, 2, 3])])
def test_far_is_an_angle_and_the_object_is_its_mask(far_degrees, views):
    result = deviations(depths(), scene(), far_degrees)
    mean = np.mean(views) / np.sqrt(2)
    assert result["far_object_deviation"] == pytest.approx(2 * mean)
    assert result["far_deviation"] == pytest.approx(mean * (1 + 1 / SIZE))
    assert (result["reference_deviation"], result["far_measured"]) == (0, 1)


def test_hidden_pixels_are_not_measured():
    depth = depths()
    depth[0, 2, :, : SIZE // 2] = 0
    assert deviations(depth, scene(), 91)["far_measured"] == 0.5
    depth[0, 2] = 0
    result = deviations(depth, scene(), 91)
    assert (result["far_deviation"], result["far_object_deviation"], result["far_measured"]) == (None, None, 0)
    result = deviations(depths(), scene(), 180)
    assert {result[f"far_{name}"] for name in ("deviation", "object_deviation", "measured")} == {None}


def test_a_row_shows_the_truth_some_samples_from_behind_and_where_all_disagree():
    batch = scene()
    (row,) = depth_strips(renderer(samples=3), [batch], 0.0, 0.5, shown=2)
    images = torch.stack([cell.image for cell in row])
    assert torch.equal(images[:2], torch.stack([batch.reference.images[0], batch.all_views().images[0, 2]]))
    # From behind, the second sample is nearer: brighter on the scale that both share.
    labels = {0: "a: input, far view", 2: "sample 0: depth 2.50 to 3.00", 5: "sample 1: depth 2.50 to 3.00"}
    assert {place: cell.label for place, cell in enumerate(row) if cell.label} == labels | {8: "deviation 0 to 0.5"}
    torch.testing.assert_close(images[3], ramp(torch.zeros(1, SIZE, SIZE)))
    torch.testing.assert_close(images[6], ramp(torch.ones(1, SIZE, SIZE)))
    # All face the camera.
    torch.testing.assert_close(images[4, :, 8, 8], torch.tensor([0.5, 0.5, 1]), atol=0.01, rtol=0)
    assert len(row) == 10


def test_disagreement_is_bright_and_what_cannot_be_compared_grey():
    maps = torch.tensor([[0.0, 1, 2, torch.nan]]).view(1, 1, 2, 2)
    colors, end = color_deviation(maps)
    assert end == pytest.approx(2, abs=0.05)
    lightness = colors.mean(1).flatten().tolist()
    assert lightness[0] < lightness[1] < lightness[2]
    assert (colors[..., 1, 1] == NOTHING).all()
    assert (color_deviation(torch.full((1, 1, 2, 2), torch.nan))[0] == NOTHING).all()
