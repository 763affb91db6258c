import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from kornia import enhance
from realestate10k_trees import same
from torch import Tensor

from completesplat.data.loading.augmentation import (
    HUE,
    Augmentation,
    BoxMasks,
    CameraJitter,
    ColorJitter,
    jittered,
    mirrored,
)
from completesplat.errors import CompleteSplatError
from completesplat.geometry.cameras import Cameras, look_at, pinhole, pixel_rays, project
from completesplat.scene import SceneBatch, Views

SIZE = 24
STRONG = ColorJitter(brightness=0.4, contrast=0.4, saturation=0.4, hue=0.5)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed))


def scene() -> SceneBatch:
    """A reference at the origin and three targets around, principal points off the centre."""
    eyes = torch.tensor([[0.0, 0, 0], [1, 0.2, 0], [-1, 0, 0.5], [0.3, -0.6, 0.2]])
    poses = look_at(eyes, torch.tensor([0.0, 0, 3]), torch.tensor([0.0, -1, 0]))
    intrinsics = pinhole(60, SIZE).repeat(4, 1, 1)
    intrinsics[:, 0, 2] += torch.tensor([0, 3.0, -2, 1])
    views = Views(noise(4, 3, SIZE, SIZE), Cameras(poses, intrinsics, (SIZE, SIZE)), noise(4, 1, SIZE, SIZE))
    visible = torch.ones(1, SIZE, SIZE)
    return SceneBatch(views[0], views[1:], torch.tensor([1.0, 5.0]), visible, torch.tensor(0), "one")


def test_a_mirrored_scene_shows_mirrored_points_at_mirrored_pixels() -> None:
    before = replace(scene(), visible=noise(1, SIZE, SIZE).round())
    after = mirrored(before)
    points = torch.tensor([0, 0, 3.0]) + noise(20, 3)
    pixels, depth = project(before.all_views().cameras, points)
    mirrored_pixels, mirrored_depth = project(after.all_views().cameras, points * torch.tensor([-1.0, 1, 1]))
    expected = torch.stack([SIZE - pixels[..., 0], pixels[..., 1]], dim=-1)
    torch.testing.assert_close(mirrored_pixels, expected, atol=1e-4, rtol=1e-5)
    torch.testing.assert_close(mirrored_depth, depth)
    assert torch.equal(after.all_views().images, before.all_views().images.flip(-1))
    assert torch.equal(after.all_views().masks, before.all_views().masks.flip(-1))
    assert torch.equal(after.visible, before.visible.flip(-1))
    assert torch.equal(after.reference.cameras.world_to_camera, torch.eye(4))
    assert same(mirrored(after), before)


def test_a_scene_depends_on_the_seed_only_and_not_on_earlier_draws() -> None:
    used = rng(5)
    used.random(100)
    first, again = (Augmentation(STRONG, BoxMasks(1.0), horizontal_flip=True)(scene(), draw) for draw in (rng(5), used))
    assert same(first, again)
    other = Augmentation(STRONG, BoxMasks(1.0), horizontal_flip=True)(scene(), rng(6))
    assert not torch.equal(first.reference.images, other.reference.images)
    assert not torch.equal(first.visible, other.visible)


def was_mirrored(changed: SceneBatch) -> bool:
    return torch.equal(changed.reference.masks, scene().reference.masks.flip(-1))


@pytest.mark.parametrize("seed", range(2))
def test_no_part_depends_on_whether_the_others_are_switched_on(seed: int) -> None:
    everything = Augmentation(STRONG, BoxMasks(), horizontal_flip=True)(scene(), rng(seed))
    jitter = Augmentation(STRONG, None, horizontal_flip=False)(scene(), rng(seed))
    boxes = Augmentation(None, BoxMasks(), horizontal_flip=False)(scene(), rng(seed))
    flipped = Augmentation(None, None, horizontal_flip=True)(scene(), rng(seed))
    assert same(replace(boxes, visible=scene().visible), scene())
    assert torch.equal(everything.visible, boxes.visible)
    assert was_mirrored(everything) == was_mirrored(flipped)
    expected = mirrored(jitter) if was_mirrored(flipped) else jitter
    assert torch.equal(everything.all_views().images, expected.all_views().images)


def test_one_random_color_replaces_what_the_masks_leave_out_in_all_views() -> None:
    before = scene()
    views = before.all_views()
    first, other = (Augmentation(random_background=1)(before, rng(seed)) for seed in (0, 1))
    after = first.all_views()
    colors = (after.images - views.masks * views.images) / (1 - views.masks)
    torch.testing.assert_close(colors, colors[:1, :, :1, :1].expand_as(colors), atol=1e-3, rtol=0)
    assert 0 <= colors.min() <= colors.max() <= 1
    assert not torch.equal(first.reference.images, other.reference.images)
    assert same(replace(first, reference=before.reference, targets=before.targets), before)
    assert torch.equal(after.masks, views.masks)


def test_a_random_background_leaves_images_without_masks_and_other_draws_as_they_are() -> None:
    def whole(views: Views) -> Views:
        return replace(views, masks=torch.ones_like(views.masks))

    everywhere = replace(scene(), reference=whole(scene().reference), targets=whole(scene().targets))
    changed = Augmentation(random_background=1)(everywhere, rng())
    assert same(changed, everywhere)
    plain, colored = (
        Augmentation(None, BoxMasks(1.0), True, CameraJitter(), share)(scene(), rng(3)) for share in (0, 1)
    )
    assert not torch.equal(colored.targets.images, plain.targets.images)
    assert torch.equal(colored.visible, plain.visible)
    assert torch.equal(colored.targets.masks, plain.targets.masks)
    assert torch.equal(colored.reference.masks, plain.reference.masks)


def test_so_large_a_share_of_the_scenes_gets_another_background() -> None:
    """The number among 100 draws lies within 4 standard deviations of its mean."""
    before = scene()
    after = (Augmentation(random_background=0.3)(before, rng(seed)) for seed in range(100))
    count = sum(not torch.equal(one.reference.images, before.reference.images) for one in after)
    assert abs(count - 30) < 4 * (100 * 0.3 * 0.7) ** 0.5


def test_every_other_scene_is_mirrored() -> None:
    """The number among 100 draws lies within 4 standard deviations of its mean."""
    count = sum(was_mirrored(Augmentation(None, None, horizontal_flip=True)(scene(), rng(seed))) for seed in range(100))
    assert abs(count - 50) < 4 * (100 * 0.25) ** 0.5


def test_reference_and_targets_get_the_same_jitter_and_the_rest_stays() -> None:
    before = scene()
    alike = replace(before, targets=replace(before.targets, images=before.reference.images.repeat(3, 1, 1, 1)))
    after = Augmentation(STRONG, None, horizontal_flip=False)(alike, rng(4))
    assert not torch.allclose(after.reference.images, before.reference.images, atol=1e-2)
    assert torch.equal(after.targets.images, after.reference.images.expand(3, -1, -1, -1))
    assert same(replace(after, reference=before.reference, targets=before.targets), before)
    assert torch.equal(after.reference.masks, before.reference.masks)


@pytest.mark.parametrize("seed", range(2))
def test_one_color_becomes_one_color_in_all_views_within_bounds(seed: int) -> None:
    images = torch.cat([noise(1, 3, 8, 8) * 0.3, 0.7 + noise(1, 3, 8, 8) * 0.3])
    images[:, :, 2, 3] = torch.tensor([0.2, 0.5, 0.6])
    jittered = STRONG(images, rng(seed))
    assert not torch.allclose(jittered[0, :, 2, 3], images[0, :, 2, 3], atol=1e-3)
    torch.testing.assert_close(jittered[0, :, 2, 3], jittered[1, :, 2, 3])
    assert 0 <= jittered.min() <= jittered.max() <= 1


def test_brightness_alone_multiplies_by_a_factor_within_its_range() -> None:
    images = 0.1 + 0.4 * noise(2, 3, 5, 5)
    factors = []
    for seed in range(60):
        ratio = ColorJitter(0.5, 0, 0, 0)(images, rng(seed)) / images
        torch.testing.assert_close(ratio, ratio[:1, :1, :1, :1].expand_as(ratio))
        factors.append(ratio[0, 0, 0, 0].item())
    assert 0.5 <= min(factors) < 0.6
    assert 1.4 < max(factors) <= 1.5


def test_hue_rotates_colors_up_to_their_complement_and_keeps_grey_grey() -> None:
    """Of all angles within half a turn, the farthest from red is cyan; some draw comes near it, none beyond."""
    images = noise(2, 1, 5, 5).repeat(1, 3, 1, 1)
    images[:, :, 0, 0] = torch.tensor([1.0, 0, 0])
    jittered = [ColorJitter(0, 0, 0, 0.5)(images, rng(seed)) for seed in range(100)]
    torch.testing.assert_close(jittered[1][:, :, 1:], images[:, :, 1:])
    reds = torch.stack([one[0, :, 0, 0] for one in jittered])
    # A pure colour of whichever hue has one channel at 1 and one at 0.
    torch.testing.assert_close(torch.stack(reds.aminmax(dim=1)), torch.tensor([[0.0], [1.0]]).expand(2, 100))
    assert (reds - torch.tensor([0.0, 1, 1])).abs().amax(dim=1).min() < 0.1
    quarter = [ColorJitter(0, 0, 0, 0.25)(images, rng(seed))[0, 0, 0, 0] for seed in range(100)]
    # A quarter turn either way ends half-way between yellow and green, or between magenta and blue.
    assert 0.5 - 1e-5 <= min(quarter) < 0.55


def test_changes_in_any_order_are_kornias() -> None:
    """Kornia gets all views as one image, because the mean grey level is that of all views."""
    functions = (
        enhance.adjust_brightness_accumulative,
        enhance.adjust_contrast_with_mean_subtraction,
        enhance.adjust_saturation_with_gray_subtraction,
        enhance.adjust_hue,
    )
    for seed in range(30):
        draw, images = rng(seed), noise(3, 3, 7, 9, seed=seed)
        images[:, :, :3] = (4 * images[:, :, :3]).round() / 4  # equal channels, greys, black and white
        order, factors = draw.permutation(4), [*draw.uniform(0.4, 1.6, 3), draw.uniform(0, 6)]
        tall = torch.cat([*images], dim=1)
        for change in order:
            tall = functions[change](tall, factors[change] * (math.pi / 3 if change == HUE else 1)).clamp(0, 1)
            images = jittered(images, int(change), factors[change])
        torch.testing.assert_close(torch.cat([*images], dim=1), tall, atol=1e-5, rtol=0)


ZERO = ColorJitter(0, 0, 0, 0)


@pytest.mark.parametrize(
    ("part", "settings", "message"),
    [
        *((ZERO, wrong, next(iter(wrong))) for wrong in ({"brightness": -0.1}, {"contrast": math.nan}, {"hue": 0.6})),
        *((BoxMasks(), {"probability": wrong}, "probability") for wrong in (math.nan, -0.1, 1.1)),
        *((BoxMasks(), {"boxes": wrong}, "boxes") for wrong in ((0, 2), (3, 2))),
        *((BoxMasks(), {"sides": wrong}, "sides") for wrong in ((0.5, 0.1), (0.5, 1.2))),
        (CameraJitter(), {"zoom": (1.2, 0.8)}, "smaller"),
        (CameraJitter(), {"roll": -1.0}, "roll"),
        (CameraJitter(), {"shift": 0.7}, "shift"),
    ],
)
def test_settings_without_meaning_are_refused_by_name(part: object, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(CompleteSplatError, match=message):
        replace(part, **settings)


def is_box(hidden: Tensor) -> bool:
    top, left = hidden.nonzero().amin(0)
    bottom, right = hidden.nonzero().amax(0) + 1
    return bool(hidden[top:bottom, left:right].all() and hidden.sum() == (bottom - top) * (right - left))


def test_a_single_box_is_a_rectangle_with_sides_in_the_stated_range() -> None:
    heights, widths, corners = set(), set(), set()
    for seed in range(300):
        visible = BoxMasks(1.0, boxes=(1, 1), sides=(0.25, 0.5))(16, 40, rng(seed))
        assert visible.shape == (1, 16, 40)
        hidden = visible[0] == 0
        assert is_box(hidden)
        heights.add(int(hidden.any(dim=1).sum()))
        widths.add(int(hidden.any(dim=0).sum()))
        corners |= {name for name, pixel in {"first": hidden[0, 0], "last": hidden[-1, -1]}.items() if pixel}
    assert heights == set(range(4, 9))
    assert widths == set(range(10, 21))
    assert corners == {"first", "last"}
    assert (BoxMasks(1.0, boxes=(1, 1), sides=(0.01, 0.01))(16, 40, rng()) == 0).sum() == 1  # never none


def test_images_are_masked_with_the_stated_probability() -> None:
    """The number among 300 draws lies within 4 standard deviations of its mean."""
    for probability in (0.5, 0.2, 0.0):
        masked = sum(bool((BoxMasks(probability)(8, 8, rng(seed)) == 0).any()) for seed in range(300))
        assert abs(masked - 300 * probability) <= 4 * (300 * probability * (1 - probability)) ** 0.5


def test_a_jittered_camera_sees_what_the_reference_image_shows_and_the_targets_stay_consistent() -> None:
    """A smooth pattern on a plane, computed for the old and the new camera, and points seen by all cameras."""
    before = scene()

    def pattern(cameras: Cameras, world: Tensor) -> Tensor:
        """Return a pattern on the plane z = 3 of the world in which `world` maps camera to world coordinates."""
        points = 3 * pixel_rays(cameras) @ world.mT
        waves = [torch.sin(points[..., 0]), torch.cos(points[..., 1]), torch.sin(points.sum(-1))]
        return torch.stack(waves) * 0.5 + 0.5

    jitter, middle = CameraJitter(roll=40, zoom=(0.7, 1.3), shift=0.1), torch.zeros(1, SIZE, SIZE)
    middle[:, 2:-2, 2:-2] = 1
    seen = replace(before.reference, images=pattern(before.reference.cameras, torch.eye(3)))
    before = replace(before, reference=seen, visible=middle)
    after = jitter(before, rng(3))
    points = torch.tensor([0, 0, 3.0]) + noise(20, 3)
    turn = (after.targets.cameras.world_to_camera.inverse() @ before.targets.cameras.world_to_camera)[0, :3, :3]
    moved, _ = project(after.targets.cameras, points @ turn.mT)
    torch.testing.assert_close(moved, project(before.targets.cameras, points)[0], atol=1e-3, rtol=1e-4)
    expected = pattern(after.reference.cameras, turn.mT)
    shown = after.visible[0] > 0.99
    assert shown.float().mean() > 0.3
    assert (after.reference.images - expected)[:, shown].abs().max() < 0.02
    assert torch.equal(after.targets.images, before.targets.images)
    assert not torch.allclose(after.reference.cameras.intrinsics, before.reference.cameras.intrinsics)
    assert torch.equal(after.reference.cameras.world_to_camera, torch.eye(4))
    square = replace(before.reference, masks=middle)
    assert set(jitter(replace(before, reference=square), rng(3)).reference.masks.unique().tolist()) == {0, 1}
