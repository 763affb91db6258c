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


def make_scene(index: int, targets: int = 3) -> SceneBatch:
    reference, others = make_views(start=10.0 * index), make_views(targets, start=10.0 * index + 1)
    depth_range, visible = torch.tensor([0.5, 4.0]), torch.full((1, *SIZE), index / 10)
    return SceneBatch(reference, others, depth_range, visible, torch.tensor(index), f"scene{index}")


def test_a_scene_without_batch_axis_puts_the_reference_first() -> None:
    views = make_scene(2).all_views()
    expected = torch.tensor([20.0, 21, 22, 23])
    assert torch.equal(views.images[:, 0, 0, 0], expected)
    assert torch.equal(views.cameras.world_to_camera[:, 0, 3], expected)
    assert torch.equal(views.masks[:, 0, 0, 0], expected / 100)
    assert torch.equal(views.depths[:, 0, 0, 0], expected + 1)
    assert views.cameras.intrinsics.shape == (4, 3, 3)
    assert views.cameras.image_size == SIZE


def test_all_views_commutes_with_collation() -> None:
    scenes = [make_scene(0), make_scene(1)]
    batch = stack(scenes)
    assert batch.names == ("scene0", "scene1")
    assert torch.equal(batch.visible[:, 0, 0, 0], torch.tensor([0.0, 0.1]))
    one, other = batch.all_views(), stack([scene.all_views() for scene in scenes])
    assert torch.equal(one.images, other.images)
    assert torch.equal(one.cameras.world_to_camera, other.cameras.world_to_camera)
    assert torch.equal(one.masks, other.masks)
    assert torch.equal(one.depths, other.depths)


def test_scenes_with_different_image_sizes_do_not_collate() -> None:
    scene = make_scene(0)
    small = Views(torch.zeros(3, 2, 2), Cameras(torch.eye(4), pinhole(60, 2), (2, 2)), masks=torch.zeros(1, 2, 2))
    other = SceneBatch(small, scene.targets, scene.depth_range, torch.ones(1, 2, 2), torch.tensor(0), "small")
    with pytest.raises((ValueError, RuntimeError)):
        stack([scene, other])


def test_wrong_shapes_are_refused_when_types_are_checked() -> None:
    """Guards the set-up of the tests themselves: annotations of the package are enforced here."""
    scene = make_scene(0)
    with pytest.raises(TypeError):
        Views(torch.zeros(4, *SIZE), scene.reference.cameras, torch.zeros(1, *SIZE))
