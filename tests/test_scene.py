"""Scenes: the order of views, collation into batches, and the shapes that are checked."""

import pytest
import torch

from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.scene import SceneBatch, Views
from completesplat.tensors import stack

SIZE = (4, 6)


def make_views(*batch: int, start: float) -> Views:
    """Views whose pixels, poses and masks carry the number of the view."""
    numbers = start + torch.arange(torch.Size(batch).numel(), dtype=torch.float32).reshape(batch)
    poses = torch.eye(4).repeat(*batch, 1, 1)
    poses[..., 0, 3] = numbers
    cameras = Cameras(poses, pinhole(60, 6).repeat(*batch, 1, 1), SIZE)
    images = numbers[..., None, None, None].expand(*batch, 3, *SIZE)
    return Views(images, cameras, images[..., :1, :, :] / 100, depths=images[..., :1, :, :] + 1)


def make_scene(index: int) -> SceneBatch:
    reference = make_views(start=10.0 * index)
    others = make_views(3, start=10.0 * index + 1)
    depth_range = torch.tensor([0.5, 4.0])
    visible = torch.full((1, *SIZE), index / 10)
    return SceneBatch(reference, others, depth_range, visible, torch.tensor(index), f"scene{index}")


def test_the_reference_comes_first_with_and_without_a_batch_axis() -> None:
    batch = stack([make_scene(0), make_scene(2)])
    assert batch.names == ("scene0", "scene2")
    assert torch.equal(batch.visible[:, 0, 0, 0], torch.tensor([0.0, 0.2]))
    views = make_scene(2).all_views()
    assert (views.cameras.intrinsics.shape, views.cameras.image_size) == ((4, 3, 3), SIZE)
    expected = torch.tensor([20.0, 21, 22, 23])
    for result in (views, batch.all_views()[1]):
        assert torch.equal(result.images[:, 0, 0, 0], expected)
        assert torch.equal(result.cameras.world_to_camera[:, 0, 3], expected)
        assert torch.equal(result.masks[:, 0, 0, 0], expected / 100)
        assert torch.equal(result.depths[:, 0, 0, 0], expected + 1)


def test_scenes_with_different_image_sizes_do_not_collate_and_wrong_shapes_are_refused() -> None:
    """The latter guards the set-up of the tests themselves: annotations of the package are enforced here."""
    scene = make_scene(0)
    small = Views(torch.zeros(3, 2, 2), Cameras(torch.eye(4), pinhole(60, 2), (2, 2)), masks=torch.zeros(1, 2, 2))
    other = SceneBatch(small, scene.targets, scene.depth_range, torch.ones(1, 2, 2), torch.tensor(0), "small")
    with pytest.raises((ValueError, RuntimeError)):
        stack([scene, other])
    with pytest.raises(TypeError):
        Views(torch.zeros(4, *SIZE), scene.reference.cameras, torch.zeros(1, *SIZE))
