"""Scene representation: a set of 3D Gaussians with activated parameters, in world space."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat.geometry import rotations
from completesplat.geometry.cameras import transform_points
from completesplat.geometry.harmonics import degree_of, harmonics, rotated
from completesplat.tensors import TensorDataclass, concatenate


@dataclass(frozen=True)
class Gaussians(TensorDataclass):
    """3D Gaussians with final values: scales in world units, opacities in [0, 1], sRGB colours from 0 to 1.

    Quaternions are (w, x, y, z), of any length but zero for a defined rotation. Colours are stored as they are seen,
    not as harmonics, because there is one colour for all directions (the DC term only, as in the paper).
    `DirectionalGaussians` add the other harmonics.
    """

    means: Float[Tensor, "*batch gaussian 3"]
    quaternions: Float[Tensor, "*batch gaussian 4"]
    scales: Float[Tensor, "*batch gaussian 3"]
    opacities: Float[Tensor, "*batch gaussian"]
    colors: Float[Tensor, "*batch gaussian 3"]

    @property
    def count(self) -> int:
        return self.means.shape[-2]

    def covariances(self) -> Float[Tensor, "*batch gaussian 3 3"]:
        """Return R S S^T R^T (Kerbl et al. 2023, Eq. 6)."""
        root = rotations.quaternion_to_matrix(self.quaternions) * self.scales[..., None, :]
        return root @ root.mT

    def transform(self, matrix: Float[Tensor, "*#batch 4 4"]) -> "Gaussians":
        """Move the Gaussians by a rotation and translation (the upper left block must be a rotation)."""
        rotation = rotations.matrix_to_quaternion(matrix[..., :3, :3])[..., None, :]
        # Normalise first, because a zero quaternion would stay zero instead of taking the rotation.
        quaternions = rotations.quaternion_multiply(rotation, rotations.normalize_quaternion(self.quaternions))
        return replace(self, means=transform_points(matrix, self.means), quaternions=quaternions)

    def seen_from(self, centers: Float[Tensor, "*batch 3"]) -> "Gaussians":
        """Return the Gaussians with the colours that they have as seen from these points: the same from all."""
        return self

    def finite(self) -> Bool[Tensor, "*batch gaussian"]:
        """Return a mask of the Gaussians whose values are all finite."""
        vectors = (self.means, self.quaternions, self.scales, self.colors)
        masks = [self.opacities.isfinite(), *(vector.isfinite().all(-1) for vector in vectors)]
        return torch.stack(masks).all(0)


@dataclass(frozen=True)
class DirectionalGaussians(Gaussians):
    """Gaussians whose colours depend on the direction, by spherical harmonics of degree 1 to 3.

    Seen along a unit vector d, the colour is max(0, colors + Y(d) @ harmonics) (`completesplat.geometry.harmonics`), so
    `colors` are means over all directions.
    """

    harmonics: Float[Tensor, "*batch gaussian coefficient 3"]

    @property
    def degree(self) -> int:
        return degree_of(self.harmonics.shape[-2])

    def seen_from(self, centers: Float[Tensor, "*batch 3"]) -> Gaussians:
        """Return the Gaussians with the colours that they have as seen from these points.

        Colours of Gaussians that are not finite are NaN, without a gradient.
        """
        finite = self.finite()[..., None]
        means = torch.where(finite, self.means, 0.0)
        plain = torch.where(finite, self.colors, 0.0)
        directions = torch.nn.functional.normalize(means - centers[..., None, :], dim=-1)
        terms = torch.where(finite[..., None], self.harmonics, 0.0)
        change = (harmonics(directions, self.degree)[..., None, :] @ terms).squeeze(-2)
        colors = torch.where(finite, (plain + change).clamp(min=0), torch.nan)
        return Gaussians(self.means, self.quaternions, self.scales, self.opacities, colors)

    def transform(self, matrix: Float[Tensor, "*#batch 4 4"]) -> "DirectionalGaussians":
        """Move the Gaussians as `Gaussians.transform` does, and turn their harmonics with them."""
        values = dict(vars(super().transform(matrix)))
        values["harmonics"] = rotated(self.harmonics, matrix[..., :3, :3])
        return DirectionalGaussians(**values)

    def finite(self) -> Bool[Tensor, "*batch gaussian"]:
        return super().finite() & self.harmonics.isfinite().flatten(-2).all(-1)


def merge_gaussians(sets: Sequence[Gaussians]) -> Gaussians:
    """Join sets of equal batch shape into one."""
    return concatenate(sets, axis=sets[0].opacities.ndim - 1)
