"""Augmented scenes: mirrored as a whole, jittered alike, and drawn from the generator only, each part by itself."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from completesplat.data.loading.augmentation import BoxMasks, ColorJitter, augment, mirrored
from completesplat.geometry.cameras import Cameras, look_at, pinhole, project
from completesplat.scene import SceneBatch, Views

SIZE = 24
STRONG = ColorJitter(brightness=0.4, contrast=0.4, saturation=0.4, hue=0.5)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def pictures(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def scene() -> SceneBatch:
    """A reference at the origin and three targets around, principal points off the centre."""
    eyes = torch.tensor([[0.0, 0, 0], [1, 0.2, 0], [-1, 0, 0.5], [0.3, -0.6, 0.2]])
    poses = look_at(eyes, torch.tensor([0.0, 0, 3]), torch.tensor([0.0, -1, 0]))
    intrinsics = pinhole(60, SIZE).repeat(4, 1, 1)
    intrinsics[:, 0, 2] += torch.tensor([0, 3.0, -2, 1])
    views = Views(pictures(4, 3, SIZE, SIZE), Cameras(poses, intrinsics, (SIZE, SIZE)), pictures(4, 1, SIZE, SIZE))
    visible = torch.ones(1, SIZE, SIZE)
    return SceneBatch(views[0], views[1:], torch.tensor([1.0, 5.0]), visible, torch.tensor(0), "one")


def test_a_mirrored_scene_shows_mirrored_points_at_mirrored_pixels() -> None:
    before, after = scene(), mirrored(scene())
    points = torch.tensor([0, 0, 3.0]) + pictures(20, 3)
    pixels, depth = project(before.all_views().cameras, points)
    mirrored_pixels, mirrored_depth = project(after.all_views().cameras, points * torch.tensor([-1.0, 1, 1]))
    expected = torch.stack([SIZE - pixels[..., 0], pixels[..., 1]], dim=-1)
    torch.testing.assert_close(mirrored_pixels, expected, atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(mirrored_depth, depth)
    column = torch.arange(SIZE)
    assert torch.equal(after.all_views().images, before.all_views().images[..., SIZE - 1 - column])
    assert torch.equal(after.all_views().masks, before.all_views().masks[..., SIZE - 1 - column])


def test_the_mirrored_reference_is_still_the_world() -> None:
    assert torch.equal(scene().reference.cameras.world_to_camera, torch.eye(4))
    assert torch.equal(mirrored(scene()).reference.cameras.world_to_camera, torch.eye(4))


def test_mirroring_a_scene_twice_changes_nothing() -> None:
    half_hidden = replace(scene(), visible=pictures(1, SIZE, SIZE).round())
    twice = mirrored(mirrored(half_hidden))
    assert not torch.equal(mirrored(half_hidden).visible, half_hidden.visible)
    assert_same_scene(twice, half_hidden)


def assert_same_scene(one: SceneBatch, other: SceneBatch) -> None:
    first, second = one.all_views(), other.all_views()
    assert torch.equal(first.images, second.images)
    assert torch.equal(first.masks, second.masks)
    assert torch.equal(first.cameras.world_to_camera, second.cameras.world_to_camera)
    torch.testing.assert_close(first.cameras.intrinsics, second.cameras.intrinsics)
    assert torch.equal(one.visible, other.visible)
    assert torch.equal(one.depth_range, other.depth_range)
    assert one.names == other.names


def test_without_any_part_a_scene_stays_as_it_is() -> None:
    assert_same_scene(augment(scene(), rng(), None, None, horizontal_flip=False), scene())


def test_a_scene_depends_on_the_generator_only() -> None:
    first, again = (augment(scene(), rng(5), STRONG, BoxMasks(1.0), horizontal_flip=True) for _ in range(2))
    assert_same_scene(first, again)
    other = augment(scene(), rng(6), STRONG, BoxMasks(1.0), horizontal_flip=True)
    assert not torch.equal(first.reference.images, other.reference.images)
    assert not torch.equal(first.visible, other.visible)


def was_mirrored(changed: SceneBatch) -> bool:
    return torch.equal(changed.reference.masks, scene().reference.masks.flip(-1))


@pytest.mark.parametrize("seed", range(6))
def test_no_part_depends_on_whether_the_others_are_switched_on(seed: int) -> None:
    everything = augment(scene(), rng(seed), STRONG, BoxMasks(), horizontal_flip=True)
    jitter = augment(scene(), rng(seed), STRONG, None, horizontal_flip=False)
    boxes = augment(scene(), rng(seed), None, BoxMasks(), horizontal_flip=False)
    flipped = augment(scene(), rng(seed), None, None, horizontal_flip=True)
    assert torch.equal(everything.visible, boxes.visible)
    assert was_mirrored(everything) == was_mirrored(flipped)
    expected = mirrored(jitter) if was_mirrored(flipped) else jitter
    assert torch.equal(everything.all_views().images, expected.all_views().images)


def test_earlier_draws_from_the_generator_do_not_matter() -> None:
    used = rng(3)
    used.random(100)
    assert_same_scene(
        augment(scene(), used, STRONG, BoxMasks(1.0), horizontal_flip=True),
        augment(scene(), rng(3), STRONG, BoxMasks(1.0), horizontal_flip=True),
    )


def test_every_other_scene_is_mirrored() -> None:
    """Of 400 draws, 4 standard deviations to either side."""
    count = sum(was_mirrored(augment(scene(), rng(seed), None, None, horizontal_flip=True)) for seed in range(400))
    assert abs(count - 200) < 4 * (400 * 0.25) ** 0.5


def test_reference_and_targets_get_the_same_jitter_and_the_rest_stays() -> None:
    before = scene()
    same = replace(before, targets=replace(before.targets, images=before.reference.images.repeat(3, 1, 1, 1)))
    after = augment(same, rng(4), STRONG, None, horizontal_flip=False)
    assert not torch.allclose(after.reference.images, before.reference.images, atol=1e-2)
    assert torch.equal(after.targets.images, after.reference.images.expand(3, -1, -1, -1))
    assert_same_scene(replace(after, reference=before.reference, targets=before.targets), before)
    assert torch.equal(after.reference.masks, before.reference.masks)


def test_boxes_leave_the_pictures_alone() -> None:
    after = augment(scene(), rng(), None, BoxMasks(1.0), horizontal_flip=False)
    assert (after.visible == 0).any()
    assert torch.equal(after.reference.images, scene().reference.images)
