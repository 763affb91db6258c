"""Quaternions against scipy, against the matrix exponential, and against themselves."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from completesplat.geometry.rotations import (
    matrix_to_quaternion,
    normalize_quaternion,
    quaternion_multiply,
    quaternion_to_matrix,
)


def exponential(axis: Tensor, angle: Tensor) -> Tensor:
    """Rotation matrices as exp(angle * [axis]_x), independent of any quaternion."""
    x, y, z = axis.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    return torch.linalg.matrix_exp(angle[:, None, None] * cross)


def hard_rotations() -> Tensor:
    """Random angles, half turns and almost half turns, tiny angles, and the coordinate axes."""
    generator = torch.Generator().manual_seed(1)
    axes = torch.randn(1000, 3, generator=generator, dtype=torch.float64)
    axes = torch.cat([axes / axes.norm(dim=-1, keepdim=True), torch.eye(3).double(), -torch.eye(3).double()])
    random = torch.rand(len(axes), generator=generator, dtype=torch.float64) * 2 * math.pi
    constants = [0.0, math.pi, math.pi - 1e-9, math.pi + 1e-9, 1e-9, math.pi / 2, 2 * math.pi / 3]
    return torch.cat([exponential(axes, angle) for angle in (random, *(torch.full_like(random, c) for c in constants))])


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_matrix_of_quaternion_of_matrix_is_the_matrix(dtype: torch.dtype, tolerance: float) -> None:
    matrices = hard_rotations().to(dtype)
    quaternions = matrix_to_quaternion(matrices)
    assert len(matrices) > 8000
    torch.testing.assert_close(quaternion_to_matrix(quaternions), matrices, atol=tolerance, rtol=0)
    torch.testing.assert_close(quaternions.norm(dim=-1), torch.ones(len(matrices), dtype=dtype))
    assert (quaternions[:, 0] >= 0).all()


def test_scipy_agrees_in_both_directions() -> None:
    quaternions = torch.randn(2000, 4, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    theirs = Rotation.from_quat(quaternions.numpy(), scalar_first=True)
    np.testing.assert_allclose(quaternion_to_matrix(quaternions).numpy(), theirs.as_matrix(), atol=1e-12)
    ours = matrix_to_quaternion(torch.from_numpy(theirs.as_matrix()))
    np.testing.assert_allclose(ours.numpy(), theirs.as_quat(canonical=True, scalar_first=True), atol=1e-12)


def test_quaternion_product_is_the_matrix_product_and_keeps_norms() -> None:
    left, right = torch.randn(2, 7, 300, 4, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    product = quaternion_multiply(left, right)
    rotations = quaternion_to_matrix(left) @ quaternion_to_matrix(right)
    torch.testing.assert_close(quaternion_to_matrix(product), rotations)
    torch.testing.assert_close(product.norm(dim=-1), left.norm(dim=-1) * right.norm(dim=-1))
    one_for_all = quaternion_multiply(left[0, 0], right)
    torch.testing.assert_close(one_for_all[3, 5], quaternion_multiply(left[0, 0], right[3, 5]))


def test_the_length_of_a_quaternion_has_no_meaning() -> None:
    quaternion = torch.randn(20, 4, generator=torch.Generator().manual_seed(6))
    for length in (1e-6, 1e6):
        torch.testing.assert_close(quaternion_to_matrix(quaternion * length), quaternion_to_matrix(quaternion))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_zero_quaternion_is_the_identity_with_a_zero_gradient(dtype: torch.dtype) -> None:
    quaternions = torch.tensor([[0, 0, 0, 0], [0, 0, 2, 0]], dtype=dtype, requires_grad=True)
    matrices = quaternion_to_matrix(quaternions)
    assert torch.equal(matrices[0], torch.eye(3, dtype=dtype))
    weights = torch.arange(18, dtype=dtype).reshape(2, 3, 3).square()
    (matrices * weights).sum().backward()
    assert quaternions.grad is not None
    assert torch.equal(quaternions.grad[0], torch.zeros(4, dtype=dtype))
    assert quaternions.grad[1].isfinite().all()
    assert quaternions.grad[1].any()


def test_gradients_of_the_conversions() -> None:
    quaternions = torch.randn(6, 4, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    assert torch.autograd.gradcheck(normalize_quaternion, quaternions.requires_grad_())
    assert torch.autograd.gradcheck(quaternion_to_matrix, quaternions)
