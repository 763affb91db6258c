import math

import pytest
import torch
from torch import nn

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.model import VariationalAutoReconstructor
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.baselines.regressor import SplatterImageUNet
from completesplat.gaussians import DirectionalGaussians
from completesplat.geometry.cameras import Cameras, pinhole, project
from completesplat.geometry.harmonics import SH_C0
from completesplat.splatter_image import (
    CHANNELS,
    GROUPS,
    Parameterization,
    SplatterImage,
    from_channels,
    initialize_head,
)

SIZE = 6
FIRST = {"scale": math.log(0.02)}  # Splatter Image's
CAMERA = Cameras(torch.eye(4)[None], pinhole(50.0, SIZE)[None], (SIZE, SIZE))
RANGE = torch.tensor([[1.0, 5.0]])


def image_of(layers: int = 2, depths: str = "independent", **raw: torch.Tensor | float) -> SplatterImage:
    """A Splatter Image whose groups have the given raw values, and elsewhere what the head starts with."""
    parts = [
        torch.as_tensor(raw.get(name, FIRST.get(name, group.bias)), dtype=torch.float32).expand(
            1, layers, group.channels, SIZE, SIZE
        )
        for name, group in GROUPS.items()
    ]
    return SplatterImage(torch.cat(parts, dim=2), Parameterization(layers, depths))


def test_closed_forms_at_the_heads_bias():
    assert list(GROUPS) == ["depth", "offset", "opacity", "scale", "rotation", "color"]  # the paper's order
    assert ([group.channels for group in GROUPS.values()], CHANNELS) == ([1, 3, 1, 3, 4, 3], 15)
    gaussians = image_of().gaussians(CAMERA, RANGE)
    assert gaussians.count == 2 * SIZE * SIZE
    torch.testing.assert_close(gaussians.means[..., 2], torch.full((1, 72), 3.0))
    torch.testing.assert_close(gaussians.opacities, torch.full((1, 72), 1 / (1 + math.exp(2))))
    torch.testing.assert_close(gaussians.scales, torch.full((1, 72, 3), 0.02))
    torch.testing.assert_close(gaussians.colors, torch.full((1, 72, 3), 0.5))
    torch.testing.assert_close(gaussians.quaternions, torch.tensor([1.0, 0, 0, 0]).expand(1, 72, 4))


def test_each_gaussian_projects_onto_its_own_pixel():
    pixels, depth = project(CAMERA, image_of(depth=0.7).gaussians(CAMERA, RANGE).means)
    rows, columns = torch.meshgrid(torch.arange(SIZE) + 0.5, torch.arange(SIZE) + 0.5, indexing="ij")
    expected = torch.stack([columns, rows], -1).reshape(-1, 2).repeat(2, 1)
    torch.testing.assert_close(pixels[0], expected)
    torch.testing.assert_close(depth, torch.full((1, 72), 1 + 4 / (1 + math.exp(-0.7))))


def test_offset_is_linear_in_the_cameras_frame_and_color_the_zeroth_harmonic_cut_at_black():
    offset = torch.tensor([0.3, -0.2, 0.1])
    raw = torch.tensor([1.0, -5.0, 0.0])
    changed = image_of(offset=offset.view(1, 1, 3, 1, 1), color=raw.view(1, 1, 3, 1, 1)).gaussians(CAMERA, RANGE)
    torch.testing.assert_close(changed.means - image_of().gaussians(CAMERA, RANGE).means, offset.expand(1, 72, 3))
    torch.testing.assert_close(changed.colors[0, 0], torch.tensor([0.5 + 1 / (2 * math.sqrt(math.pi)), 0.0, 0.5]))


def test_scale_is_exponential_within_its_range_and_keeps_its_gradient_there():
    for raw, expected in ((-100.0, 1e-4), (100.0, 2.0), (0.0, 1.0)):
        scales = image_of(scale=raw).gaussians(CAMERA, RANGE).scales
        torch.testing.assert_close(scales[0, 0], torch.full((3,), expected), rtol=1e-5, atol=0)
    image = image_of(scale=-3.0)
    raw = image.raw.clone().requires_grad_()
    SplatterImage(raw, image.parameterization).gaussians(CAMERA, RANGE).scales.log().sum().backward()
    torch.testing.assert_close(raw.grad[:, :, 5:8], torch.ones(1, 2, 3, SIZE, SIZE))


def test_smooth_scales_keep_a_gradient_at_the_largest_and_beyond():
    settings = {"largest_scale": 2.0, "smooth_scales": True}
    raw = image_of(scale=math.log(2.0)).raw
    for beyond, least in ((0.0, 0.4), (1.0, 0.2)):
        moved = (raw + beyond).requires_grad_()
        scales = SplatterImage(moved, Parameterization(**settings)).gaussians(CAMERA, RANGE).scales
        assert (scales < 2.0).all()
        (gradient,) = torch.autograd.grad(scales.log().sum(), moved)
        assert gradient.max() > least
    small = image_of(scale=math.log(0.02))
    bent = SplatterImage(small.raw, Parameterization(**settings)).gaussians(CAMERA, RANGE)
    torch.testing.assert_close(bent.scales, small.gaussians(CAMERA, RANGE).scales, rtol=0.02, atol=0)


def test_incremental_layers_lie_behind_each_other_and_independent_ones_anywhere():
    raw = torch.linspace(-3, 2, 3).view(1, 3, 1, 1, 1)
    depth = image_of(3, "incremental", depth=raw).gaussians(CAMERA, RANGE).means[..., 2].reshape(3, -1)
    expected = torch.tensor([1 + 4 / (1 + math.exp(3)), math.exp(-0.5), math.exp(2.0)])
    torch.testing.assert_close(depth, expected.cumsum(0)[:, None].expand(3, 36))
    layers = image_of(depth=torch.tensor([1.0, -1.0]).view(1, 2, 1, 1, 1)).gaussians(CAMERA, RANGE)
    assert (layers.means[:, 36:, 2] < layers.means[:, :36, 2]).all()


def test_zero_rotation_is_the_identity_with_a_finite_gradient():
    image = image_of(rotation=0.0)
    raw = image.raw.clone().requires_grad_()
    gaussians = SplatterImage(raw, image.parameterization).gaussians(CAMERA, RANGE)
    gaussians.covariances().sum().backward()
    torch.testing.assert_close(gaussians.quaternions[0, 0], torch.tensor([1.0, 0, 0, 0]))
    assert raw.grad.isfinite().all()


# Standard deviations of the raw values of szymanowiczs/splatter-image's own network at the start: commit 98b4657,
# `SingleImageSongUNetPredictor` with the settings of its configs/default_config.yaml and these 15 channels, not
# training: the mean over 20 seeds, two images of uniform noise of 128 x 128 each.
UPSTREAM = {"depth": 0.206, "offset": 0.0209, "opacity": 0.200, "scale": 0.000596, "rotation": 0.196, "color": 0.968}


def autoreconstructor(channels: tuple[int, ...], groups: int) -> nn.Module:
    encoder = Encoder(channels, 1, 4, groups)
    return VariationalAutoReconstructor(encoder, Reconstructor(Parameterization(2), channels, 1, 4, groups))


NETWORKS = {
    "tiny": lambda: autoreconstructor((16, 16, 64, 128), 8),
    "Stable Diffusion's blocks": lambda: autoreconstructor((128, 256, 512, 512), 32),
    "Splatter Image": lambda: SplatterImageUNet(Parameterization(1), layers_per_block=1),
}


@pytest.mark.parametrize("network", NETWORKS)
def test_raw_values_start_as_far_apart_as_splatter_images(network):
    seeds = 12 if network == "tiny" else 2
    deviations = dict.fromkeys(GROUPS, 0.0)
    outside = 0.0
    for seed in range(seeds):
        torch.manual_seed(seed)
        with torch.no_grad():
            raw = NETWORKS[network]().eval()(torch.rand(2, 3, 64, 64)).splatter_image.split()
        for name, values in raw.items():
            deviations[name] += values.double().std().item() / seeds
            assert values.mean().item() == pytest.approx(
                FIRST.get(name, GROUPS[name].bias), abs=0.7 * GROUPS[name].gain
            )
        colors = 0.5 + SH_C0 * raw["color"]
        outside += ((colors < 0) | (colors > 1)).float().mean().item() / seeds
    assert deviations == pytest.approx(UPSTREAM, rel=0.2)
    assert outside < 0.15  # 0.08 there, 0.7 with its gains on one convolution


def test_gaussians_start_with_the_scale_of_the_parameterization():
    reconstructor = Reconstructor(Parameterization(2, first_scale=0.06), (16, 32), 1, 4, 8)
    scales = reconstructor(torch.randn(2, 4, 4, 4), [torch.zeros(2, 16, 8, 8)]).split()["scale"].exp()
    torch.testing.assert_close(scales, torch.full_like(scales, 0.06), rtol=0.02, atol=0)


@pytest.mark.parametrize(("back", "drawn"), [(1.9, True), (2.1, False)])
def test_gaussians_in_front_of_the_depth_range_can_be_left_out(back, drawn):
    """At a depth of 3 of 1 to 5, an offset of more than 2 towards the camera leaves the range."""
    image = image_of(offset=torch.tensor([0.0, 0.0, -back]).view(3, 1, 1))
    kept = image.gaussians(CAMERA, RANGE).opacities
    within = SplatterImage(image.raw, Parameterization(within_range=True)).gaussians(CAMERA, RANGE)
    assert torch.equal(within.opacities, kept if drawn else torch.zeros_like(kept))


@pytest.mark.parametrize("degree", [1, 2])
def test_harmonics_add_raw_values_at_the_end_of_a_layer_and_hardly_matter_at_first(degree):
    plain = Parameterization()
    further = Parameterization(harmonics=degree)
    count = 3 * ((degree + 1) ** 2 - 1)
    assert further.channels == plain.channels + 2 * count
    torch.manual_seed(0)
    head = nn.Conv2d(128, further.channels, 3, padding=1)
    initialize_head(head, further)
    features = torch.randn(1, 128, 8, 8)
    image = from_channels(head(features), further)
    raw = image.raw
    assert raw.shape == (1, 2, CHANNELS + count, 8, 8)
    cameras = Cameras(torch.eye(4)[None], pinhole(50, 8)[None], (8, 8))
    gaussians = image.gaussians(cameras, torch.tensor([[1.0, 3.0]]))
    assert isinstance(gaussians, DirectionalGaussians)
    without = SplatterImage(raw[:, :, :CHANNELS], plain).gaussians(cameras, torch.tensor([[1.0, 3.0]]))
    assert torch.equal(without.colors, gaussians.colors.clamp(min=0))
    assert torch.equal(without.means, gaussians.means)
    red_of_second = raw[0, 1, CHANNELS + 3, 2, 5]
    assert gaussians.harmonics[0, 64 + 2 * 8 + 5, 1, 0] == red_of_second
    spread = gaussians.seen_from(torch.tensor([[0.0, 0, 9]])).colors - gaussians.seen_from(torch.zeros(1, 3)).colors
    assert 0 < spread.abs().mean() < 0.3 * gaussians.colors.std()
