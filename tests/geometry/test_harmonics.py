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
    """Gauss-Legendre points in z and even steps in azimuth integrate polynomials of degree 6 exactly."""
    heights, weights = (torch.from_numpy(values) for values in leggauss(6))
    azimuth = torch.arange(12, dtype=torch.float64) * 2 * math.pi / 12
    z, angle = torch.meshgrid(heights, azimuth, indexing="ij")
    ring = (1 - z * z).sqrt()
    points = torch.stack([ring * angle.cos(), ring * angle.sin(), z], -1)
    values = torch.cat([torch.full_like(z, SH_C0)[..., None], harmonics(points, 3)], -1)
    area = weights[:, None] * (2 * math.pi / 12) * torch.ones_like(z)
    products = torch.einsum("ij,ija,ijb->ab", area, values, values)
    torch.testing.assert_close(products, torch.eye(16, dtype=torch.float64))


def test_signs_and_order_are_those_of_3d_gaussian_splatting() -> None:
    """The signs along the axes and diagonals, from `eval_sh` of its `utils/sh_utils.py`."""
    x, y, z = torch.eye(3, dtype=torch.float64)
    first = math.sqrt(3 / (4 * math.pi))
    for axis, expected in ((x, [0, 0, -first]), (y, [-first, 0, 0]), (z, [0, first, 0])):
        assert harmonics(axis, 1).tolist() == pytest.approx(expected)
    mixed = math.sqrt(15 / (4 * math.pi)) / 2
    along = math.sqrt(5 / (4 * math.pi))
    second = {3: (x + y, mixed), 4: (y + z, -mixed), 5: (z, along), 6: (x + z, -mixed), 7: (x, mixed)}
    for index, (toward, expected) in second.items():
        assert harmonics(toward / toward.norm(), 2)[index].item() == pytest.approx(expected)
    signs = {8: y + x, 9: x + y + z, 10: 2 * z + y, 11: z, 12: 2 * z + x, 13: x + z, 14: x}
    negative = [harmonics(toward / toward.norm(), 3)[index].item() < 0 for index, toward in signs.items()]
    assert negative == [True, False, True, False, True, False, True]


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_rotated_coefficients_give_the_same_colours_along_rotated_directions(degree: int) -> None:
    generator = torch.Generator().manual_seed(1)
    values = torch.randn(2, 5, coefficients(degree), 3, generator=generator, dtype=torch.float64)
    rotation = quaternion_to_matrix(torch.randn(2, 4, generator=generator, dtype=torch.float64))
    seen = rotated(values, rotation)
    d = directions(7)
    for scene in range(2):
        before = torch.einsum("dk,gkc->dgc", harmonics(d, degree), values[scene])
        after = torch.einsum("dk,gkc->dgc", harmonics(d @ rotation[scene].mT, degree), seen[scene])
        torch.testing.assert_close(after, before)
    assert degree_of(coefficients(degree)) == degree
