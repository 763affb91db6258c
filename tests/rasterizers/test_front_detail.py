"""Detail in the front of scenes: Gaussians are split where the photo shows more, and nothing else changes."""

import math
from dataclasses import replace

import pytest
import torch
from support import round_gaussians
from torch.nn.functional import interpolate

from completesplat.gaussians import DirectionalGaussians, Gaussians, merge_gaussians
from completesplat.geometry.cameras import Cameras, crop_resize, pinhole
from completesplat.rasterizers import front_detail
from completesplat.rasterizers.front_detail import (
    PARTS_PER_PIXEL,
    fit_detail,
    front_targets,
    opacities_of_parts,
    seen_larger,
    split,
    worth_splitting,
)
from completesplat.rasterizers.reference import ReferenceRasterizer

SIDE = 8
LARGE = 24
CAMERA = Cameras(torch.eye(4)[None], pinhole(60.0, SIDE)[None], (SIDE, SIDE))
RENDER = ReferenceRasterizer()
ALL = torch.ones(SIDE**2, dtype=torch.bool)


def wall(depth: float, grey: float, opacity: float = 0.9) -> Gaussians:
    """A wall of flat Gaussians, one for each pixel and somewhat wider than it, turned about the axis of view."""
    place = (torch.arange(SIDE) + 0.5) / SIDE * 2 - 1
    reach = depth * math.tan(math.radians(30))
    y, x = torch.meshgrid(place * reach, place * reach, indexing="ij")
    means = torch.stack([x, y, torch.full_like(x, depth)], -1).view(1, -1, 3)
    scene = round_gaussians(means, reach / SIDE, opacity, grey)
    turned = torch.tensor([0.9, 0.1, 0.1, 0.4]).expand_as(scene.quaternions)
    return replace(scene, quaternions=turned, scales=scene.scales * torch.tensor([2.4, 1.8, 0.1]))


def render(scene: Gaussians, side: int = LARGE) -> torch.Tensor:
    return RENDER(scene, crop_resize(CAMERA, 0, 0, SIDE, side)[:, None]).over(0.5)[0, 0]


def photo_at(side: int) -> torch.Tensor:
    """Stripes in the right half, which are finer than the small image's pixels, grey on the left."""
    fine = torch.full((1, 3, 2 * LARGE, 2 * LARGE), 0.5)
    columns = torch.arange(LARGE, 2 * LARGE)
    fine[..., LARGE:] = (columns // 8 % 2).float() * 0.8 + 0.1
    return interpolate(fine, (side, side), mode="area")[0]


def detailed(scene: Gaussians, visible: torch.Tensor | None = None) -> Gaussians:
    return fit_detail(scene, CAMERA, front_targets(CAMERA, photo_at, LARGE, visible), RENDER, 0.5)


@pytest.mark.parametrize("opacity", [0.1, 0.5, 0.9, 0.99])
def test_a_split_alone_changes_nothing_visible(opacity):
    scene = wall(2, 0.2, opacity)
    parts = split(scene[0], ALL, CAMERA[0]).repeated(1)
    assert parts.count == 4 * scene.count
    inside = slice(4, -4)
    changes = (render(parts) - render(scene)).abs()[:, inside, inside]
    assert changes.mean() < 0.003
    assert changes.max() < 0.01


@pytest.mark.parametrize("opacity", [0.1, 0.5, 0.95])
def test_the_parts_of_one_cover_as_much_as_it(opacity):
    one = round_gaussians(torch.tensor([[[0.0, 0.0, 2.0]]]), 0.2, opacity, 1.0)
    four = split(one[0], ALL[:1], CAMERA[0]).repeated(1)
    covered = [RENDER(x, crop_resize(CAMERA, 0, 0, SIDE, 64)[:, None]).alpha.sum() for x in (one, four)]
    torch.testing.assert_close(*covered, rtol=0.03, atol=0)
    assert (four.opacities < opacity).all()


def test_opacities_of_parts_grow_with_the_opacity():
    opacities = opacities_of_parts(torch.linspace(0, 1, 100))
    assert (opacities.diff() >= 0).all()
    assert opacities[0] == 0
    assert opacities[-1] <= 1


def test_parts_are_no_spikes_along_the_ray():
    needle = replace(wall(2, 0.2), scales=torch.tensor([0.1, 5.0, 0.1]).expand(1, SIDE**2, 3))
    needle = replace(needle, quaternions=torch.tensor([1.0, 1.0, 0.0, 0.0]).expand(1, SIDE**2, 4))  # y to z
    chosen = ALL.clone()
    chosen[: SIDE**2 // 2] = False
    parts = split(needle[0], chosen, CAMERA[0])
    assert parts[: SIDE**2 // 2].scales.max() == 5
    assert parts[SIDE**2 // 2 :].scales.max() < 5


def test_what_is_split_keeps_its_harmonics():
    plain = wall(2, 0.2)
    scene = DirectionalGaussians(**vars(plain), harmonics=torch.rand(1, SIDE**2, 3, 3))
    parts = split(scene[0], ALL, CAMERA[0])
    assert torch.equal(parts.harmonics, scene.harmonics[0].repeat(4, 1, 1))


def test_a_scene_seen_larger_looks_as_before():
    scene = wall(2, 0.2)
    colors = torch.rand(1, SIDE**2, 3, generator=torch.Generator().manual_seed(0))
    scene = replace(scene, colors=colors, scales=scene.scales / 4)
    large = seen_larger(scene, CAMERA, crop_resize(CAMERA, 0, 0, SIDE, 5 * SIDE))
    middles = render(large, 5 * SIDE)[:, 2::5, 2::5]
    plain = render(scene, 5 * SIDE)[:, 2::5, 2::5]
    errors = [(x - render(scene, SIDE)).abs().mean() for x in (middles, plain)]
    assert errors[0] < 0.015
    assert errors[0] < errors[1] / 4


def test_targets_grow_at_most_twofold_to_the_size():
    sides = [target.image.shape[-1] for target in front_targets(CAMERA, photo_at, 50)]
    assert sides[-1] == 50
    assert all(b <= 2 * a for a, b in zip([SIDE, *sides], sides, strict=False))
    assert front_targets(CAMERA, photo_at, SIDE) == []


def test_only_what_lacks_detail_is_split_and_the_photo_is_met():
    scene = wall(2, 0.5)
    target = front_targets(CAMERA, photo_at, 2 * SIDE)[0]
    chosen = worth_splitting(seen_larger(scene, CAMERA, target.camera), target, RENDER, 0.5, 1000).view(SIDE, SIDE)
    assert not chosen[:, 0].any()
    assert chosen[:, 5:].float().mean() > 0.8
    before = seen_larger(scene, CAMERA, crop_resize(CAMERA, 0, 0, SIDE, LARGE))
    after = detailed(scene)
    assert after.count > scene.count
    errors = [(render(x) - photo_at(LARGE)).square().mean() for x in (before, after)]
    assert errors[1] < errors[0] / 2


@pytest.mark.parametrize(("opacity", "grey"), [(0.999, 0.52), (0.2, 0.535)])
def test_a_front_where_nothing_is_worth_splitting_is_left_as_it_is(opacity, grey):
    """The second wall lets the background through, so that its own error is less than the image's."""
    scene = wall(2, 0.5, opacity)
    targets = front_targets(CAMERA, lambda side: torch.full((3, side, side), grey), LARGE)
    after = fit_detail(scene, CAMERA, targets, RENDER, 0.5)
    expected = seen_larger(scene, CAMERA, targets[-1].camera)
    for name, values in vars(expected).items():
        torch.testing.assert_close(getattr(after, name), values, msg=name)


def test_the_number_of_gaussians_is_bounded(monkeypatch):
    monkeypatch.setattr(front_detail, "PARTS_PER_PIXEL", 0.1)
    scene = wall(2, 0.5)
    assert (
        scene.count < detailed(scene).count <= scene.count + 0.1 * LARGE**2 < scene.count + PARTS_PER_PIXEL * LARGE**2
    )


def test_hidden_layers_are_as_they_looked():
    hidden = wall(4, 0.9)
    after = detailed(merge_gaussians([wall(1.9, 0.5, 0.999), wall(2, 0.5, 0.999), wall(2.1, 0.5, 0.999), hidden]))
    expected = seen_larger(hidden, CAMERA, crop_resize(CAMERA, 0, 0, SIDE, LARGE))
    kept = [(after.means[0] == mean).all(-1).nonzero().item() for mean in expected.means[0]]
    torch.testing.assert_close(after.scales[:, kept], expected.scales, rtol=2e-2, atol=0)
    torch.testing.assert_close(after.opacities[:, kept], expected.opacities, rtol=2e-2, atol=0)


def test_hidden_pixels_have_no_influence(monkeypatch):
    visible = torch.ones(1, 1, SIDE, SIDE)
    visible[..., SIDE // 2 - 2 :] = 0
    first = detailed(wall(2, 0.3), visible)
    whole = photo_at
    monkeypatch.setitem(
        globals(),
        "photo_at",
        lambda side: torch.cat([whole(side)[..., : side // 2 - 1], torch.zeros(3, side, side - side // 2 + 1)], -1),
    )
    second = detailed(wall(2, 0.3), visible)
    assert all(torch.equal(*pair) for pair in zip(vars(first).values(), vars(second).values(), strict=True))
