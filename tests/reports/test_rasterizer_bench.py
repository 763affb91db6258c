"""The benchmark of the rasterizers, on scenes small enough for a test."""

import json

import pytest
import torch

from completesplat.rasterizers.tiled import TiledRasterizer
from completesplat.reports.rasterizer_bench import run, table
from completesplat.reports.splatter_workload import splatter_scene


def test_rows_are_complete_and_can_be_written() -> None:
    results = run([16, 24], [1, 2], 2, ["tiled", "reference"])
    assert json.loads(json.dumps(results)) == results
    assert {"processor", "threads", "torch"} <= set(results["machine"])
    seen = [(row["backend"], row["size"], row["gaussians"], row["views"], row["opacity"]) for row in results["rows"]]
    expected = [
        ("tiled", size, 2 * size * size, views, opacity)
        for size in (16, 24)
        for views in (1, 2)
        for opacity in ("trained", "initial")
    ]
    assert seen == expected  # the reference is timed at one size only
    assert all(0 < row["forward_ms"] < row["forward_backward_ms"] for row in results["rows"])
    assert table(results).row_count == len(expected)


@pytest.mark.parametrize("opacity", ["trained", "initial"])
def test_the_workload_looks_like_a_splatter_image(opacity: str) -> None:
    size = 32
    gaussians, cameras = splatter_scene(size, 2, opacity)
    source = cameras[:, :1].map(torch.clone)
    source.world_to_camera[:] = torch.eye(4)
    alpha = TiledRasterizer()(gaussians, source).alpha
    assert gaussians.count == 2 * size * size
    assert alpha.min() > 0.5  # every pixel has its Gaussians
    if opacity == "initial":
        assert gaussians.opacities.max() < 0.31
    else:
        assert gaussians.opacities.max() > 0.9
        assert (alpha > 0.99).float().mean() > 0.5
