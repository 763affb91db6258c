"""A known point stays on its pixel through annotations, crop, resizing and mirroring."""

from pathlib import Path

import co3d_trees as trees
import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from completesplat.data.co3d.annotations import camera_from_viewpoint
from completesplat.data.co3d.module import CO3DDataModule
from completesplat.geometry.cameras import project
from completesplat.scene import SceneBatch

CENTER = np.array([5.0, -3.0, 2.0])
CLOUD = CENTER + 2.5 * np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
POINT = CENTER + np.array([0.35, 0.5, -0.3])
FRAMES = 5
SPREAD = 3.0  # of the blob, in pixels of the files
SIZES = {"landscape": (90, 130), "portrait": (140, 96), "square": (100, 100)}
LAYOUTS = ["ndc_norm_image_bounds", "ndc_isotropic"]
PRINCIPAL_POINTS = {"central": [0.0, 0.0], "off_centre": [0.12, -0.2]}


def blob_image(pixel: np.ndarray, size: tuple[int, int], number: int) -> np.ndarray:
    """Red: a blob at `pixel`. Green: the frame's number. Blue: rises to the right, so that mirroring is seen."""
    y, x = np.mgrid[: size[0], : size[1]] + 0.5
    blob = 255 * np.exp(-((x - pixel[0]) ** 2 + (y - pixel[1]) ** 2) / (2 * SPREAD**2))
    return np.stack([blob, 0 * x + 40 * number, 250 * x / size[1]], axis=-1).round().astype(np.uint8)


def viewpoints(name: str, layout: str, principal_point: list[float]) -> list[dict]:
    """Cameras that look past the object's centre, with focal lengths of their own for each axis and frame."""
    return [
        trees.look(
            eye, CENTER + np.array([0.1 * number, 0, 0]), layout,
            focal_length=[3.0 + 0.1 * number, 3.3], principal_point=principal_point,
        )
        for number, eye in enumerate(CENTER + trees.orbit(FRAMES, start=float("abc".index(name)), radius=12.0))
    ]  # fmt: skip


def write(root: Path, size: tuple[int, int], layout: str, principal_point: list[float]) -> None:
    """Three sequences of images of the point, without depth maps."""
    entries = []
    for name in "abc":
        for part in ("images", "masks"):
            (root / trees.CATEGORY / name / part).mkdir(parents=True)
        for number, viewpoint in enumerate(viewpoints(name, layout, principal_point)):
            entry = trees.frame_entry(name, number, viewpoint, size)
            (pixel,), _ = trees.pytorch3d_pixels(viewpoint, size, POINT[None])
            pixels = blob_image(pixel, size, number)
            Image.fromarray(pixels).save(root / entry["image"]["path"])
            Image.fromarray(pixels[..., 0]).save(root / entry["mask"]["path"])
            entries.append({**entry, "depth": None})
        trees.write_cloud(root / trees.CATEGORY / name / "pointcloud.ply", CLOUD)
    sequences = [trees.sequence_entry(name) for name in "abc"]
    trees.write_annotations(root, entries, sequences, {"train": "a", "val": "b", "test": "c"})


def centroid(values: Tensor) -> Tensor:
    """(x, y) of the blob in an image [height width], in pixels."""
    weights = (values - 0.05).clamp(min=0)
    y, x = (torch.arange(n) + 0.5 for n in values.shape)
    return torch.stack([(weights.sum(0) * x).sum(), (weights.sum(1) * y).sum()]) / weights.sum()


def point_in_reference(viewpoint: dict, is_mirrored: bool, scale: float) -> Tensor:
    """The point [1 3] as the reference's camera sees it (+x right, +y down), at the common scale."""
    left, up, forward = POINT @ np.array(viewpoint["R"]) + viewpoint["T"]
    seen = np.array([left if is_mirrored else -left, -up, forward]) * scale
    return torch.tensor(seen[None], dtype=torch.float32)


def mirrored(batch: SceneBatch) -> bool:
    blue = batch.all_views().images[0, :, 2]
    falls = {bool(view[:, 2].mean() > view[:, -3].mean()) for view in blue}
    assert len(falls) == 1
    return falls.pop()


@pytest.mark.parametrize("principal_point", PRINCIPAL_POINTS)
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("size", SIZES)
def test_a_known_point_stays_on_its_pixel(tmp_path, size, layout, principal_point):
    write(tmp_path, SIZES[size], layout, PRINCIPAL_POINTS[principal_point])
    data = CO3DDataModule(
        str(tmp_path), trees.CATEGORY, image_size=48, batch_size=1, targets=3, on_bad="raise", horizontal_flip=True,
        references_per_sequence=5,
    )  # fmt: skip
    training = list(data.train_dataloader())
    evaluation = [*data.val_dataloader(), *data.test_dataloader()]
    assert {mirrored(batch) for batch in training} == {True, False}
    assert [mirrored(batch) for batch in evaluation] == [False, False]
    for batch in [*training, *evaluation]:
        views, (name,) = batch.all_views(), batch.names
        number = round(255 / 40 * batch.reference.images[0, 1].mean().item())
        around = viewpoints(name, layout, PRINCIPAL_POINTS[principal_point])
        _, _, scale = trees.splatter_image(CLOUD, around)
        pixels, depth = project(views.cameras[0], point_in_reference(around[number], mirrored(batch), scale))
        for seen in (views.images[0, :, 0], views.masks[0, :, 0]):
            assert max((centroid(one) - pixel).norm() for one, pixel in zip(seen, pixels[:, 0], strict=True)) < 0.1
        assert batch.depth_range[0, 0] < depth[0] < batch.depth_range[0, 1]


@pytest.mark.parametrize("size", [(300, 400), (500, 320), (256, 256)])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_points_land_where_pytorch3d_puts_them(layout, size):
    intrinsics = {"focal_length": [2.3, 2.9], "principal_point": [0.13, -0.21]}
    viewpoint = trees.look(np.array([3.0, -2, 4]), np.array([0.1, 0.3, -0.2]), layout, **intrinsics)
    points = np.random.default_rng(0).normal(size=(50, 3))
    expected, expected_depth = trees.pytorch3d_pixels(viewpoint, size, points)
    camera = camera_from_viewpoint(viewpoint, size)
    pixels, depth = project(camera, torch.from_numpy(points))
    np.testing.assert_allclose(pixels.numpy(), expected, atol=1e-9)
    np.testing.assert_allclose(depth.numpy(), expected_depth, atol=1e-12)
    assert torch.linalg.det(camera.world_to_camera[:3, :3]).item() == pytest.approx(1)
    if layout == LAYOUTS[0]:  # As annotations older than the format are normalised.
        del viewpoint["intrinsics_format"]
        assert torch.equal(camera_from_viewpoint(viewpoint, size).intrinsics, camera.intrinsics)
