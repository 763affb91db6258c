"""Copies of a Gaussian are together what it was, dead Gaussians move, and noise spares the opaque ones."""

import math

import pytest
import torch
from support import some_gaussians

from completesplat.baselines.densification import opacity_of_copies, position_noise, relocate, scale_of_copies
from completesplat.baselines.fitting import RawGaussians


@pytest.mark.parametrize("copies", [1, 2, 3, 10, 51])
@pytest.mark.parametrize("opacity", [0.01, 0.5, 0.95, 0.999])
def test_copies_hide_as_much_as_the_original(opacity, copies):
    """In the middle exactly, and along a line in the integral, here a sum over a fine grid."""
    o = torch.tensor([opacity])
    n = torch.tensor([copies])
    share = opacity_of_copies(o.double(), n).item()
    factor = scale_of_copies(o, n).item()
    assert 1 - (1 - share) ** copies == pytest.approx(opacity, rel=1e-6)
    x = torch.linspace(-12, 12, 20001, dtype=torch.float64)
    together = 1 - (1 - share * torch.exp(-(x**2) / (2 * factor**2))) ** copies
    assert together.sum().item() * 24 / 20000 == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-4)


def raw(opacities: list[float]) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    shapes = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "harmonics": (3,)}
    tensors = {name: torch.randn(len(opacities), *shape, generator=generator) for name, shape in shapes.items()}
    return tensors | {"logits": torch.tensor(opacities).logit()}


def test_dead_and_new_gaussians_become_copies_of_living_ones():
    torch.manual_seed(0)
    before = raw([0.001, 0.9, 0.004, 0.3, 0.5, 0.5])
    after = {name: tensor.clone() for name, tensor in before.items()}
    changed = relocate(after, 4, 5)  # rows 0 and 2 are dead, row 4 is new, row 5 stays unused
    assert {0, 2, 4} < set(changed.tolist()) <= {0, 1, 2, 3, 4}
    families = {
        alive: [row for row in (0, 2, 4) if after["means"][row].equal(before["means"][alive])] for alive in (1, 3)
    }
    assert sorted(row for children in families.values() for row in children) == [0, 2, 4]
    for alive, children in families.items():
        together = 1 - (1 - after["logits"][[alive, *children]].sigmoid()).prod()
        assert together.item() == pytest.approx(before["logits"][alive].sigmoid().item(), rel=1e-5)
        assert (after["log_scales"][alive] < before["log_scales"][alive]).all() == bool(children)
    assert all(after[name][5].equal(before[name][5]) for name in before)
    assert RawGaussians(**{name: tensor[None] for name, tensor in after.items()}).gaussians().finite().all()


def test_where_nothing_lives_nothing_moves():
    before = raw([0.001, 0.002])
    after = {name: tensor.clone() for name, tensor in before.items()}
    assert len(relocate(after, 2, 2)) == 0
    assert all(after[name].equal(before[name]) for name in before)


def test_noise_has_a_transparent_gaussians_covariance_and_spares_opaque_ones():
    one = some_gaussians(1, opacity=1e-4)[0][:1]
    rate = 1e-6
    many = one.map(lambda tensor: tensor.expand(20_000, *tensor.shape[1:]))
    torch.manual_seed(0)
    noise = position_noise(many, rate)
    weight = 5e5 * rate / (1 + math.exp(-100 * (0.005 - 1e-4)))  # the paper's, Eq. 8 with the code's k and t
    covariance = one.covariances()[0]
    torch.testing.assert_close(noise.T @ noise / len(noise) / weight**2, covariance @ covariance.T, rtol=0.1, atol=2e-6)
    opaque = some_gaussians(1, opacity=0.5)[0]
    assert position_noise(opaque, rate).abs().max() < 1e-12
