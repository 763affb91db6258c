"""A VAE of sparse Splatter Images: what it sees, what it is compared with, and that it can learn one by heart."""

from functools import partial

import pytest
import torch
from fake_mps import FakeMPS

from completesplat.autoreconstructor.encoder import Encoder
from completesplat.autoreconstructor.reconstructor import Reconstructor
from completesplat.baselines.preoptimized import SparseVAE, occupied, project_to_splatter_image
from completesplat.errors import CompleteSplatError
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.splatter_image import CHANNELS, Parameterization, SplatterImage

SIZE = 16
COUNT = 60
SHAPE = {"channels": (16, 32), "layers_per_block": 1, "norm_groups": 8}


def sparse_image(seed: int = 0, batch: int = 1) -> SplatterImage:
    """Return a splatter image of random Gaussians, all in view."""
    draws = torch.Generator().manual_seed(seed)
    sizes = (1, 2, 4, 3, 1, 3)
    depths, places, rotations, scales, opacities, colors = (torch.rand(batch, COUNT, n, generator=draws) for n in sizes)
    means = torch.cat([(places - 0.5) * (1 + 2 * depths), 1 + 2 * depths], dim=-1)
    quaternions = torch.nn.functional.normalize(rotations - 0.5, dim=-1)
    gaussians = Gaussians(means, quaternions, 0.01 + 0.2 * scales, 0.1 + 0.8 * opacities[..., 0], colors)
    cameras = Cameras(torch.eye(4).expand(batch, 4, 4), pinhole(60.0, SIZE).expand(batch, 3, 3), (SIZE, SIZE))
    depth_range = torch.tensor([[0.5, 4.0]]).expand(batch, 2)
    return project_to_splatter_image(gaussians, cameras, depth_range, Parameterization())[0]


def tiny_vae() -> SparseVAE:
    torch.manual_seed(0)
    return SparseVAE(partial(Encoder, **SHAPE), Reconstructor(Parameterization(), **SHAPE, skip_levels=[]))


@pytest.fixture
def measured() -> SparseVAE:
    vae = tiny_vae()
    vae.measure(IMAGES)
    return vae


IMAGES = [sparse_image(0, batch=2), sparse_image(1, batch=3)]


def test_values_of_occupied_places_have_mean_0_and_deviation_1(measured):
    for layer in range(2):
        values = torch.cat([measured.normalize(i.raw)[:, layer].movedim(1, -1)[occupied(i)[:, layer]] for i in IMAGES])
        assert 0 < len(values) < 5 * SIZE * SIZE / 2
        torch.testing.assert_close(values.mean(0), torch.zeros(CHANNELS), atol=1e-4, rtol=0)
        expected = torch.ones(CHANNELS)
        expected[3] = 0  # the ray's depth leaves nothing of the offset along the optical axis
        torch.testing.assert_close(values.std(0, correction=0), expected, atol=1e-3, rtol=0)


def test_the_same_is_measured_on_a_device_without_float64(measured):
    vae = tiny_vae()
    with FakeMPS():
        vae.mean, vae.std = vae.mean.to("mps"), vae.std.to("mps")
        vae.measure([image.to("mps") for image in IMAGES])
        moments = vae.mean.cpu(), vae.std.cpu()
    torch.testing.assert_close(moments, (measured.mean, measured.std))


def test_what_does_not_vary_is_centred_and_an_empty_layer_left_alone():
    vae = tiny_vae()
    image = sparse_image()
    raw = image.raw.clone()
    raw[:, :, 0] = 3.0
    raw[:, 1, 4] = -30.0
    vae.measure([SplatterImage(raw, image.parameterization)])
    assert (vae.mean[0, 0].item(), vae.std[0, 0].item()) == (pytest.approx(3), 1)
    assert torch.equal(vae.mean[1], torch.zeros_like(vae.mean[1]))
    assert torch.equal(vae.std[1], torch.ones_like(vae.std[1]))


def test_raw_values_of_empty_places_are_neither_seen_nor_compared(measured):
    image = sparse_image()
    there = occupied(image)[:, :, None]
    noise = torch.where(there, image.raw, torch.randn(image.raw.shape, generator=torch.Generator().manual_seed(2)))
    noise[:, :, 4] = image.raw[:, :, 4]
    other = SplatterImage(noise, image.parameterization)
    measured.eval()
    assert torch.equal(measured(image).splatter_image.raw, measured(other).splatter_image.raw)
    assert all(value.item() == 0 for name, value in measured.errors(other, image).items() if name != "opacity")


def test_errors_are_those_of_single_places(measured):
    image = sparse_image()
    result = image.raw.clone()
    result[:, :, 0] += 3 * measured.std[:, 0]  # depth, everywhere
    result[:, :, 12] += 2 * measured.std[:, 12]  # the first of three colours
    result[:, :, 4] = 0.0
    errors = measured.errors(SplatterImage(result, image.parameterization), image)
    assert errors["depth"].item() == pytest.approx(9, rel=1e-4)
    assert errors["color"].item() == pytest.approx(4 / 3, rel=1e-4)
    assert [errors[name].item() for name in ("offset", "scale", "rotation")] == [0, 0, 0]
    # An opacity of one half is log 2 away from any.
    assert errors["opacity"].item() == pytest.approx(0.6931, abs=1e-4)


def test_one_sparse_splatter_image_can_be_learned_by_heart():
    vae = tiny_vae()
    image = sparse_image()
    vae.measure([image])
    optimizer = torch.optim.Adam(vae.parameters(), lr=1e-2)
    losses = []
    for _ in range(90):
        losses.append(torch.stack(list(vae.errors(vae(image).splatter_image, image).values())).mean())
        optimizer.zero_grad()
        losses[-1].backward()
        optimizer.step()
    assert losses[-1] < 0.3 * losses[0]
    opacities = vae.eval()(image).splatter_image.split()["opacity"].sigmoid().squeeze(2)
    assert opacities[~occupied(image)].mean() < 0.15 < 0.25 < opacities[occupied(image)].mean()


def test_skips_are_refused():
    with pytest.raises(CompleteSplatError, match="skip_levels"):
        SparseVAE(partial(Encoder, **SHAPE), Reconstructor(Parameterization(), **SHAPE))
