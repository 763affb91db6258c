"""Scenes of the benchmarks: as many Gaussians, as dense and as opaque as splatter images."""

import pytest
import torch

from completesplat.benchmarks.workloads import DISTANCE, FOV_DEGREES, OPACITIES, orbit, splatter_scene
from completesplat.geometry.cameras import Cameras, pinhole, project
from completesplat.rasterizers.reference import ReferenceRasterizer


@pytest.mark.parametrize("opacity", OPACITIES)
def test_the_workload_looks_like_a_splatter_image(opacity: str) -> None:
    size, seen = 32, 24
    gaussians, _ = splatter_scene(size, 1, opacity, seen)
    source = Cameras(torch.eye(4)[None, None], pinhole(FOV_DEGREES, seen)[None, None], (seen, seen))
    alpha = ReferenceRasterizer()(gaussians, source).alpha
    assert gaussians.count == 2 * size * size
    assert alpha.min() > 0.5  # every pixel has its Gaussians
    if opacity == "initial":
        assert gaussians.opacities.min() >= 0.1
        assert gaussians.opacities.max() < 0.31
    else:
        assert gaussians.opacities.max() > 0.9
        assert (alpha > 0.99).float().mean() > 0.5


def test_what_the_cameras_see_may_be_larger_than_the_splatter_image() -> None:
    gaussians, cameras = splatter_scene(8, 3, "trained")
    others, larger = splatter_scene(8, 3, "trained", 24)
    assert all(torch.equal(tensor, getattr(others, name)) for name, tensor in vars(gaussians).items())
    assert cameras.image_size == (8, 8)
    assert larger.image_size == (24, 24)
    pixels, _ = project(cameras, gaussians.means[:, None])
    enlarged, _ = project(larger, gaussians.means[:, None])
    torch.testing.assert_close(enlarged, 3 * pixels)


def test_the_cameras_stand_around_the_object_and_see_its_centre() -> None:
    cameras = orbit(20, 5)
    pixels, depth = project(cameras, torch.tensor([0.0, 0.0, DISTANCE]).expand(1, 5, 1, 3))
    torch.testing.assert_close(pixels, torch.full((1, 5, 1, 2), 10.0))
    torch.testing.assert_close(depth, depth[:, :1].expand(1, 5, 1))
    assert torch.pdist(cameras.centers[0]).min() > 1
