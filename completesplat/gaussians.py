"""Scene representation: a set of 3D Gaussians with activated parameters, in world space."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from completesplat import tensors
from completesplat.geometry.cameras import transform_points
from completesplat.geometry.rotations import (
    matrix_to_quaternion,
    normalize_quaternion,
    quaternion_multiply,
    quaternion_to_matrix,
)
from completesplat.tensors import TensorDataclass


@dataclass(frozen=True)
class Gaussians(TensorDataclass):
    """3D Gaussians with final values: scales in world units, opacities in [0, 1], sRGB colours from 0 to 1.

    Quaternions are (w, x, y, z), of any length but zero for a defined rotation. Colours are stored as they are seen,
    not as harmonics, because there is one colour for all directions (the DC term only, as in the paper).
    """

    means: Float[Tensor, "*batch gaussian 3"]
    quaternions: Float[Tensor, "*batch gaussian 4"]
    scales: Float[Tensor, "*batch gaussian 3"]
    opacities: Float[Tensor, "*batch gaussian"]
    colors: Float[Tensor, "*batch gaussian 3"]

    @property
    def count(self) -> int:
        """Return the number of Gaussians in each set."""
        return self.means.shape[-2]

    def covariances(self) -> Float[Tensor, "*batch gaussian 3 3"]:
        """Return R S S^T R^T (Kerbl et al. 2023, Eq. 6)."""
        root = quaternion_to_matrix(self.quaternions) * self.scales[..., None, :]
        return root @ root.mT

    def transform(self, matrix: Float[Tensor, "*#batch 4 4"]) -> "Gaussians":
        """Move the Gaussians by a rotation and translation (the upper left block must be a rotation)."""
        rotation = matrix_to_quaternion(matrix[..., :3, :3])[..., None, :]
        # Normalise first, because a zero quaternion would stay zero instead of taking the rotation.
        quaternions = quaternion_multiply(rotation, normalize_quaternion(self.quaternions))
        return replace(self, means=transform_points(matrix, self.means), quaternions=quaternions)

    def finite(self) -> Bool[Tensor, "*batch gaussian"]:
        """Return a mask of the Gaussians whose values are all finite."""
        marks = [self.opacities.isfinite()]
        marks += [x.isfinite().all(-1) for x in (self.means, self.quaternions, self.scales, self.colors)]
        return torch.stack(marks).all(0)


def concatenate(sets: Sequence[Gaussians]) -> Gaussians:
    """Join sets of equal batch shape into one."""
    return tensors.concatenate(sets, axis=sets[0].opacities.ndim - 1)
