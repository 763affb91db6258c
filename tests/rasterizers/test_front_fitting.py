"""Gaussians that are fitted to an image: what it shows follows it, what it hides does not."""

from dataclasses import replace

import pytest
import torch
from support import round_gaussians

from completesplat.gaussians import DirectionalGaussians, Gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.rasterizers.front_fitting import ENOUGH, fit_front
from completesplat.rasterizers.reference import ReferenceRasterizer

SIDE = 8
CAMERA = Cameras(torch.eye(4)[None], pinhole(60.0, SIDE)[None], (SIDE, SIDE))
VIEW = CAMERA.map(lambda tensor: tensor[:, None])


def wall(depth: float, grey: float) -> Gaussians:
    """A nearly opaque wall of Gaussians, one for each pixel and somewhat wider than it."""
    place = (torch.arange(SIDE) + 0.5) / SIDE * 2 - 1
    reach = depth * torch.tan(torch.deg2rad(torch.tensor(30.0)))
    y, x = torch.meshgrid(place * reach, place * reach, indexing="ij")
    means = torch.stack([x, y, torch.full_like(x, depth)], -1).view(1, -1, 3)
    return round_gaussians(means, float(reach / SIDE), 0.99, grey)


def joined(*walls: Gaussians) -> Gaussians:
    return Gaussians(*(torch.cat(parts, 1) for parts in zip(*(vars(x).values() for x in walls), strict=True)))


def render(gaussians: Gaussians) -> torch.Tensor:
    return ReferenceRasterizer()(gaussians, VIEW).over(0.5)[:, 0]


@pytest.fixture(scope="module")
def image():
    painted = replace(wall(2, 0.5), colors=torch.rand(1, SIDE**2, 3, generator=torch.Generator().manual_seed(0)))
    return render(painted)


def fitted(gaussians: Gaussians, image: torch.Tensor, rounds: int, visible: torch.Tensor | None = None) -> Gaussians:
    return fit_front(gaussians, CAMERA, image, ReferenceRasterizer(), rounds, 0.5, visible)


def test_more_rounds_bring_the_render_nearer_to_the_image(image):
    scene = joined(wall(2, 0.2), wall(3, 0.8))
    errors = [(render(fitted(scene, image, rounds)) - image).square().mean().item() for rounds in (0, 5, 10, 20, 40)]
    assert errors == sorted(errors, reverse=True)
    assert errors[-1] < errors[0] / 10


def test_what_the_front_hides_stays_as_it_is_and_nothing_changes_its_place(image):
    scene = joined(wall(2, 0.2), wall(2.1, 0.8), wall(3, 0.8))
    result = fitted(scene, image, 20)
    moved = (result.colors - scene.colors).abs().amax(-1).view(3, SIDE, SIDE)[:, 1:-1, 1:-1]
    assert moved[0].mean() > 0.2
    assert moved[2].max() < 1e-3
    hidden = slice(2 * SIDE**2 + SIDE, -SIDE)
    torch.testing.assert_close(result.scales[:, hidden], scene.scales[:, hidden], rtol=1e-3, atol=0)
    torch.testing.assert_close(result.opacities[:, hidden], scene.opacities[:, hidden], rtol=1e-3, atol=0)
    assert torch.equal(result.means, scene.means)
    assert torch.equal(result.quaternions, scene.quaternions)
    assert not any(tensor.requires_grad for tensor in vars(result).values())


def test_what_no_pixel_shows_stays_exactly_as_it_is(image):
    behind = replace(wall(2, 0.3), means=-wall(2, 0.3).means, opacities=torch.linspace(0, 1, SIDE**2)[None])
    result = fitted(joined(wall(2, 0.2), behind), image, 3)[:, SIDE**2 :]
    assert all(torch.equal(*pair) for pair in zip(vars(result).values(), vars(behind).values(), strict=True))


@pytest.mark.parametrize("visible", [None, torch.ones(1, 1, SIDE, SIDE)])
def test_a_scene_that_is_near_enough_stays(visible):
    scene = wall(2, 0.4)
    result = fitted(scene, render(scene) + ENOUGH**0.5 * 0.99, 3, visible)
    assert all(torch.equal(*pair) for pair in zip(vars(result).values(), vars(scene).values(), strict=True))


def test_hidden_pixels_have_no_influence(image):
    visible = torch.ones(1, 1, SIDE, SIDE)
    visible[..., : SIDE // 2] = 0
    other = image.where(visible > 0, 1 - image)
    first, second = (fitted(wall(2, 0.2), x, 2, visible) for x in (image, other))
    assert torch.equal(first.colors, second.colors)
    changed = (first.colors - 0.2).abs().amax(-1).view(SIDE, SIDE)
    assert changed[:, -2:].mean() > 10 * changed[:, :2].mean()


@pytest.mark.parametrize(("name", "factor"), [("colors", 0.25), ("opacities", 3), ("scales", 3)])
def test_a_value_that_is_wrong_is_found(name, factor):
    """Opacities and scales that are too large; they are not raised."""
    right = replace(wall(2, 0.9), opacities=torch.full((1, SIDE**2), 0.3))
    wrong = replace(right, **{name: getattr(right, name) * factor})
    before, after = ((render(x) - render(right)).square().mean() for x in (wrong, fitted(wrong, render(right), 100)))
    assert after <= ENOUGH < before / 1.5


def test_it_works_where_autograd_is_off(image):
    visible = torch.ones(1, 1, SIDE, SIDE)
    expected = fitted(wall(2, 0.2), image, 2, visible).colors
    with torch.inference_mode():
        scene = wall(2, 0.2).map(torch.clone)
        camera = CAMERA.map(torch.clone)
        result = fit_front(scene, camera, image.clone(), ReferenceRasterizer(), 2, 0.5, visible.clone())
    assert torch.equal(result.colors, expected)


def test_of_directional_colors_the_means_move_and_the_photo_is_met(image: torch.Tensor) -> None:
    plain = wall(2, 0.5)
    slopes = 0.1 * torch.randn(1, plain.count, 3, 3, generator=torch.Generator().manual_seed(2))
    before = DirectionalGaussians(**vars(replace(plain, colors=plain.colors - 0.1)), harmonics=slopes)
    after = fitted(before, image, rounds=100)
    assert isinstance(after, DirectionalGaussians)
    assert torch.equal(after.harmonics, slopes)
    assert (render(after) - image).square().mean() <= ENOUGH * 1.01


def test_no_colour_becomes_brighter_than_white():
    dim = replace(wall(2, 0.9), opacities=torch.full((1, SIDE**2), 0.2), scales=wall(2, 0.9).scales / 8)
    result = fitted(dim, torch.ones(1, 3, SIDE, SIDE), 20)
    assert result.colors.max() == 1
    assert result.colors.min() >= 0


def test_nothing_becomes_more_opaque_or_grows_because_it_would_hide_what_lies_behind(image):
    """A thin pale wall in front of a dark one: only its colour and its falling opacity may show the image."""
    thin = replace(wall(2, 0.9), opacities=torch.full((1, SIDE**2), 0.3))
    scene = joined(thin, wall(3, 0.2))
    result = fitted(scene, image, 20)
    assert (result.opacities <= scene.opacities).all()
    assert (result.scales <= scene.scales).all()
    assert (result.colors - scene.colors).abs().amax() > 0.1
    faded = fitted(scene, render(wall(3, 0.2)), 40)
    assert faded.opacities[:, : SIDE**2].mean() < 0.2
