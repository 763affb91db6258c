"""Gaussians: covariances, rigid motion, culling and concatenation."""

from dataclasses import replace
from itertools import product

import pytest
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from completesplat.gaussians import Gaussians, merge_gaussians

FIELDS = ("means", "quaternions", "scales", "opacities", "colors")


def make(*batch: int, count: int = 12, seed: int = 0) -> Gaussians:
    generator = torch.Generator().manual_seed(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(*batch, count, *shape, generator=generator, dtype=torch.float64)

    return Gaussians(rand(3) * 4 - 2, rand(4) * 2 - 1, rand(3) + 0.05, rand(), rand(3))


def rigid(*batch: int, seed: int = 3) -> Tensor:
    matrix = torch.eye(4, dtype=torch.float64).repeat(*batch, 1, 1)
    count = matrix.numel() // 16
    rotations = torch.from_numpy(Rotation.random(count, rng=seed).as_matrix())
    matrix[..., :3, :3] = rotations.reshape(matrix[..., :3, :3].shape)
    matrix[..., :3, 3] = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    return matrix


def test_the_axes_of_a_gaussian_are_the_columns_of_scipys_rotation() -> None:
    """So that the squared scales are the eigenvalues of its covariance."""
    gaussians = make(count=50)
    rotations = torch.from_numpy(Rotation.from_quat(gaussians.quaternions.numpy(), scalar_first=True).as_matrix())
    covariances = gaussians.covariances()
    torch.testing.assert_close(covariances @ rotations, rotations * gaussians.scales.square()[:, None, :])
    torch.testing.assert_close(covariances, covariances.mT, atol=1e-15, rtol=0)


@pytest.mark.parametrize("batch", [(), (3,)])
def test_transform_moves_means_and_turns_covariances(batch: tuple[int, ...]) -> None:
    gaussians = make(*batch)
    matrix = rigid(*batch)
    gaussians.quaternions[..., 0, :] = 0  # which stands for the identity
    moved = gaussians.transform(matrix)
    rotation = matrix[..., None, :3, :3]
    torch.testing.assert_close(moved.covariances(), rotation @ gaussians.covariances() @ rotation.mT)
    homogeneous = torch.cat([gaussians.means, torch.ones_like(gaussians.means[..., :1])], dim=-1)
    torch.testing.assert_close(moved.means, (homogeneous @ matrix.mT)[..., :3])
    assert all(torch.equal(getattr(moved, f), getattr(gaussians, f)) for f in ("scales", "opacities", "colors"))


def test_transforms_compose_and_one_matrix_serves_a_batch() -> None:
    gaussians = make(2)
    first = rigid(seed=5)
    second = rigid(seed=6)
    twice = gaussians.transform(first).transform(second)
    once = gaussians.transform(second @ first)
    torch.testing.assert_close(twice.means, once.means)
    torch.testing.assert_close(twice.covariances(), once.covariances())


def test_concatenation_keeps_all_gaussians_in_order() -> None:
    sets = [make(2, count=n, seed=n) for n in (4, 0, 7)]
    joined = merge_gaussians(sets)
    assert joined.count == 11
    for name in FIELDS:
        assert torch.equal(getattr(joined, name)[:, :4], getattr(sets[0], name))
        assert torch.equal(getattr(joined, name)[:, 4:], getattr(sets[2], name))


def test_finite_marks_a_bad_value_in_any_field_and_keep_selects_the_marked_ones() -> None:
    gaussians = make(2)
    assert gaussians.finite().all()
    for field, value in product(FIELDS, (float("nan"), -float("inf"))):
        spoiled = getattr(gaussians, field).clone()
        spoiled[1, 5].view(-1)[-1] = value
        marks = replace(gaussians, **{field: spoiled}).finite()
        assert marks.shape == (2, 12)
        assert (~marks).nonzero().tolist() == [[1, 5]]
    gaussians = make()
    selected = gaussians[gaussians.opacities > 0.5]
    marked = [i for i in range(12) if gaussians.opacities[i] > 0.5]
    assert 0 < selected.count == len(marked) < 12
    assert all(torch.equal(getattr(selected, f), getattr(gaussians, f)[marked]) for f in FIELDS)
