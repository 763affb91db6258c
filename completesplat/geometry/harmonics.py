"""Real spherical harmonics of degree 1 to 3, in the order and with the signs of 3D Gaussian Splatting.

Along the unit vector d, from the camera to the Gaussian, the colour 0.5 + C0 c_0 + sum_k Y_k(d) c_k is seen
(Kerbl et al. 2023, `utils/sh_utils.py`).
"""

import math
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

SH_C0 = 0.28209479177387814
"""The zeroth spherical harmonic, 1 / (2 sqrt(pi)): colours are predicted as its coefficient."""
SH_C1 = 0.4886025119029199
SH_C2 = (1.0925484305920792, 0.31539156525252005, 0.5462742152960396)
SH_C3 = (0.5900435899266435, 2.890611442640554, 0.4570457994644658, 0.3731763325901154, 1.445305721320277)
LARGEST_DEGREE = 3
Directions = Float[Tensor, "*batch 3"]


def coefficients(degree: int) -> int:
    """Return the number of harmonics of degree 1 up to `degree`."""
    return (degree + 1) ** 2 - 1


def degree_of(count: int) -> int:
    """Return the degree up to which there are `count` harmonics without degree 0."""
    return math.isqrt(count + 1) - 1


def harmonics(directions: Directions, degree: int) -> Float[Tensor, "*batch coefficient"]:
    """Return the harmonics of degree 1 up to `degree` for unit vectors."""
    x, y, z = directions.unbind(-1)
    terms = [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if degree > 1:
        mixed, even, difference = SH_C2
        terms += [mixed * x * y, -mixed * y * z, even * (2 * z * z - x * x - y * y)]
        terms += [-mixed * x * z, difference * (x * x - y * y)]
    if degree > 2:
        outer, mixed, inner, zonal, difference = SH_C3
        xx = x * x
        yy = y * y
        zz = z * z
        terms += [-outer * y * (3 * xx - yy), mixed * x * y * z, -inner * y * (4 * zz - xx - yy)]
        terms += [zonal * z * (2 * zz - 3 * xx - 3 * yy), -inner * x * (4 * zz - xx - yy)]
        terms += [difference * z * (xx - yy), -outer * x * (xx - 3 * yy)]
    return torch.stack(terms, dim=-1)


def rotated(
    values: Float[Tensor, "*batch gaussian coefficient 3"], rotation: Float[Tensor, "*#batch 3 3"]
) -> Float[Tensor, "*batch gaussian coefficient 3"]:
    """Return the coefficients of the same colours after a rotation: seen along R d as they were along d before.

    A rotation maps the harmonics of one degree to combinations of themselves, so a least-squares fit over enough
    directions is exact.
    """
    degree = degree_of(values.shape[-2])
    directions, inverse = _fit(degree)
    directions = directions.to(values)
    inverse = inverse.to(values)
    change = inverse @ harmonics(directions @ rotation, degree)
    return change[..., None, :, :] @ values


@lru_cache
def _fit(degree: int) -> tuple[Float[Tensor, "direction 3"], Float[Tensor, "coefficient direction"]]:
    """Return directions, and the matrix that fits coefficients to values along them."""
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(32, 3, generator=generator, dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    return directions, torch.linalg.pinv(harmonics(directions, degree))
