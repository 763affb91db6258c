"""Spherical harmonics against their integrals over the sphere, and against the colours of turned scenes."""

import math

import pytest
import torch
from numpy.polynomial.legendre import leggauss

from completesplat.geometry.harmonics import SH_C0, coefficients, degree_of, harmonics, rotated
from completesplat.geometry.rotations import quaternion_to_matrix


def directions(count: int, seed: int = 0) -> torch.Tensor:
    values = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return torch.nn.functional.normalize(values, dim=-1)


def test_harmonics_are_orthonormal_on_the_sphere() -> None:
    """Gauss-Legendre points in z and even steps in azimuth integrate polynomials of degree 4 exactly."""
    heights, weights = (torch.from_numpy(values) for values in leggauss(6))
    azimuth = torch.arange(12, dtype=torch.float64) * 2 * math.pi / 12
    z, angle = torch.meshgrid(heights, azimuth, indexing="ij")
    ring = (1 - z * z).sqrt()
    points = torch.stack([ring * angle.cos(), ring * angle.sin(), z], -1)
    values = torch.cat([torch.full_like(z, SH_C0)[..., None], harmonics(points, 2)], -1)
    area = weights[:, None] * (2 * math.pi / 12) * torch.ones_like(z)
    products = torch.einsum("ij,ija,ijb->ab", area, values, values)
    torch.testing.assert_close(products, torch.eye(9, dtype=torch.float64))


def test_signs_and_order_are_those_of_3d_gaussian_splatting() -> None:
    """The signs along the axes and diagonals, from `eval_sh` of its `utils/sh_utils.py`."""
    x, y, z = torch.eye(3, dtype=torch.float64)
    first = math.sqrt(3 / (4 * math.pi))
    assert harmonics(x, 1).tolist() == pytest.approx([0, 0, -first])
    assert harmonics(y, 1).tolist() == pytest.approx([-first, 0, 0])
    assert harmonics(z, 1).tolist() == pytest.approx([0, first, 0])
    mixed = math.sqrt(15 / (4 * math.pi)) / 2
    assert harmonics((x + y) / math.sqrt(2), 2)[3].item() == pytest.approx(mixed)
    assert harmonics((y + z) / math.sqrt(2), 2)[4].item() == pytest.approx(-mixed)
    assert harmonics((x + z) / math.sqrt(2), 2)[6].item() == pytest.approx(-mixed)
    assert harmonics(z, 2)[5].item() == pytest.approx(math.sqrt(5 / (4 * math.pi)))
    assert harmonics(x, 2)[7].item() == pytest.approx(mixed)


@pytest.mark.parametrize("degree", [1, 2])
def test_rotated_coefficients_give_the_same_colours_along_rotated_directions(degree: int) -> None:
    generator = torch.Generator().manual_seed(1)
    values = torch.randn(2, 5, coefficients(degree), 3, generator=generator, dtype=torch.float64)
    rotation = quaternion_to_matrix(torch.randn(2, 4, generator=generator, dtype=torch.float64))
    seen, d = rotated(values, rotation), directions(7)
    for scene in range(2):
        before = torch.einsum("dk,gkc->dgc", harmonics(d, degree), values[scene])
        after = torch.einsum("dk,gkc->dgc", harmonics(d @ rotation[scene].mT, degree), seen[scene])
        torch.testing.assert_close(after, before)
    assert degree_of(coefficients(degree)) == degree
