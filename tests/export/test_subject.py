"""Orbits around the object that a photo is of, wherever it is in the photo."""

import math
from dataclasses import replace

import pytest
import torch
from support import some_gaussians

from completesplat.export.placed_scene import PlacedScene
from completesplat.export.subject import Subject, all_around, subject_of
from completesplat.gaussians import Gaussians, merge_gaussians
from completesplat.geometry.cameras import Cameras, pinhole, project
from completesplat.geometry.trajectories import orbit
from completesplat.rasterizers.reference import ReferenceRasterizer

UP = torch.tensor([0.0, -1.0, 0.0])


def camera(fov: float = 50) -> Cameras:
    return Cameras(torch.eye(4), pinhole(fov, 32), (32, 32))


def splats(means: torch.Tensor, scale: float) -> Gaussians:
    count = len(means)
    one = some_gaussians(1, scale=scale, opacity=0.95)[0][:1]
    fields = {name: getattr(one, name).expand(count, *getattr(one, name).shape[1:]) for name in vars(one)}
    return replace(type(one)(**fields), means=means)


def block(center: tuple[float, float, float], half: tuple[float, float, float]) -> Gaussians:
    """An object: splats on a grid that fills a box."""
    steps = torch.linspace(-1, 1, 7)
    grid = torch.cartesian_prod(steps, steps, steps)
    return splats(torch.tensor(center) + grid * torch.tensor(half), max(half) / 6)


def wall(depth: float) -> Gaussians:
    steps = torch.linspace(-1.2 * depth, 1.2 * depth, 30)
    across = torch.cartesian_prod(steps, steps)
    return splats(torch.cat([across, torch.full((len(across), 1), depth)], dim=1), 0.05 * depth)


def corners(thing: Gaussians) -> torch.Tensor:
    low, high = thing.means.amin(0), thing.means.amax(0)
    return torch.cartesian_prod(*(torch.stack(ends) for ends in zip(low, high, strict=True)))


def mask_of(thing: Gaussians, seen_by: Cameras) -> torch.Tensor:
    rendering = ReferenceRasterizer()(thing[None], seen_by[None][None])
    return (rendering.alpha[0, 0] > 0.5).float()


PLACES = [
    ((0.0, 0.0, 2.0), (0.3, 0.3, 0.3), 50),
    ((-0.55, 0.3, 2.0), (0.25, 0.35, 0.25), 50),
    ((0.6, 0.35, 2.2), (0.3, 0.15, 0.35), 50),
    ((1.2, -0.7, 2.0), (0.4, 0.5, 0.4), 80),
]


@pytest.mark.parametrize(("center", "half", "fov"), PLACES)
@pytest.mark.parametrize("masked", [False, True])
def test_the_objects_box_stays_in_the_frame_all_around_wherever_it_is_in_the_photo(center, half, fov, masked):
    thing, seen_by = block(center, half), camera(fov)
    mask = mask_of(thing, seen_by) if masked else None
    scene = PlacedScene(merge_gaussians([thing, wall(5)]), seen_by, UP, mask=mask)
    subject = subject_of(scene, ReferenceRasterizer())
    assert (subject.center - torch.tensor(center)).norm() < 0.6 * max(half)
    cameras = orbit(all_around(seen_by, subject), subject.center, UP, 24)
    pixels, depths = project(cameras, corners(thing).expand(24, 8, 3))
    assert (depths > 0).all()
    assert ((pixels > 0) & (pixels < 32)).all()


def test_a_known_pivot_or_depth_is_kept_and_a_scene_that_shows_nothing_has_a_finite_centre():
    thing = block((-0.5, 0.2, 2.0), (0.25, 0.25, 0.25))
    known = PlacedScene(thing, camera(), UP, pivot=torch.tensor([1.0, 2, 3]))
    subject = subject_of(known, ReferenceRasterizer())
    assert subject.center is known.pivot
    assert subject.radius == 0
    far = subject_of(PlacedScene(thing, camera(), UP, depth=2.0, mask=mask_of(thing, camera())), ReferenceRasterizer())
    assert far.center[2] == pytest.approx(2)
    empty = PlacedScene(replace(thing, opacities=0 * thing.opacities), camera(), UP)
    torch.testing.assert_close(subject_of(empty, ReferenceRasterizer()).center, torch.tensor([0, 0, 2.0]))


def test_the_camera_goes_back_until_a_ball_fits_and_never_nearer_and_looks_through_its_middle():
    shifted = camera()
    shifted = replace(shifted, intrinsics=shifted.intrinsics + torch.tensor([[0, 0, 5.0], [0, 0, -3], [0, 0, 0]]))
    center = torch.tensor([0.6, 0, 2.0])
    for radius, distance in ((0.2, center.norm().item()), (3.0, 1.05 * 3 / math.sin(math.radians(25)))):
        around = all_around(shifted, Subject(center, radius))
        assert (around.centers - center).norm().item() == pytest.approx(distance)
        assert torch.cosine_similarity(around.centers - center, -center, dim=0) == pytest.approx(1)
        assert around.intrinsics[:2, 2].tolist() == [16, 16]
