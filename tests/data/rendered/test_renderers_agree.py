"""The renderer of meshes beside Blender: the same jobs, the same places, nearly the same colours."""

from threading import Event

import meshes
import numpy as np
import pytest
from PIL import Image

from completesplat.data.rendered.blender import find_blender, run_job
from completesplat.data.rendered.mesh_renderer import draw_job
from completesplat.data.rendered.random_scenes import draw_rendered_scene

pytest.importorskip("trimesh")
pytestmark = pytest.mark.blender


@pytest.fixture(scope="module", autouse=True)
def blender() -> None:
    meshes.need_blender()


def files_of(folder):
    """Return images, 0 to 255, and depth, mask and coverage."""
    images = [np.asarray(Image.open(path), float) for path in sorted(folder.glob("*.png"))]
    return np.array(images), np.array([np.load(path) for path in sorted(folder.glob("*.npy"))])


@pytest.mark.parametrize("wall", ["none", "random"])
def test_both_renderers_draw_an_upright_scan_in_the_same_places_and_nearly_the_same_colours(tmp_path, wall):
    mesh = meshes.write_scan(tmp_path / "scan")
    settings = meshes.SETTINGS | {"views": 3, "size": 64, "samples": 16, "up": "z", "wall": wall, "floor": "random"}
    job, _ = draw_rendered_scene("scan", settings)
    job |= {"mesh": str(mesh), "root": str(tmp_path.resolve()), "memory": 8 * 10**9}
    for name in ("mesh", "blender"):
        job["folder"] = str(tmp_path / name)
        (tmp_path / name).mkdir()
        if name == "mesh":
            draw_job(job, Event())
        else:
            assert "refused" not in run_job(find_blender(), job, tmp_path / name, Event())
    (images, geometry), (expected_images, expected) = (files_of(tmp_path / name) for name in ("mesh", "blender"))
    coverage = np.stack([geometry[..., 2], expected[..., 2]])
    assert coverage.min(0).sum() > 0.98 * coverage.max(0).sum()
    both = (geometry[..., 1] == 1) & (expected[..., 1] == 1)
    assert np.quantile(np.abs(geometry[..., 0] - expected[..., 0])[both], 0.95) < 1e-4
    for region in (coverage.min(0) > 0.99, coverage.max(0) < 0.01):
        difference = (images - expected_images)[region]
        assert abs(difference.mean()) < 10
        assert np.abs(difference).mean() < 15
