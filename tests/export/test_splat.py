import struct

import pytest
import torch

from completesplat.errors import CompleteSplatError
from completesplat.export.formats import write_splat
from completesplat.gaussians import Gaussians
from completesplat.geometry.rotations import normalize_quaternion


def some(count: int = 20) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def rand(*shape):
        return torch.rand(*shape, generator=generator)

    quaternions = normalize_quaternion(rand(count, 4) * 2 - 1) * 3  # any length
    return Gaussians(rand(count, 3) * 8 - 4, quaternions, rand(count, 3), rand(count), rand(count, 3))


def test_a_record_holds_position_extent_colour_and_rotation(tmp_path):
    gaussians = some()
    assert write_splat(tmp_path / "a.splat", gaussians) == 20
    data = (tmp_path / "a.splat").read_bytes()
    assert len(data) == 20 * 32
    for i, record in enumerate(struct.iter_unpack("<6f8B", data)):
        assert torch.equal(torch.tensor(record[:3]), gaussians.means[i])
        assert torch.equal(torch.tensor(record[3:6]), gaussians.scales[i])
        color = torch.cat([gaussians.colors[i], gaussians.opacities[i, None]])
        torch.testing.assert_close(torch.tensor(record[6:10]) / 255, color, rtol=0, atol=0.5 / 255 + 1e-6)
        quaternion = (torch.tensor(record[10:]) - 128) / 128
        torch.testing.assert_close(quaternion, gaussians.quaternions[i] / 3, rtol=0, atol=1 / 128)


def test_ends_of_the_range_do_not_wrap_around(tmp_path):
    ends = Gaussians(
        means=torch.zeros(2, 3),
        quaternions=torch.tensor([[1.0, 0, 0, 0], [-1, 0, 0, 0]]),
        scales=torch.ones(2, 3),
        opacities=torch.tensor([0.0, 1.0]),
        colors=torch.tensor([[-0.5, 0, 1], [1.5, 1, 0]]),
    )
    write_splat(tmp_path / "a.splat", ends)
    first, second = struct.iter_unpack("<6f8B", (tmp_path / "a.splat").read_bytes())
    assert first[6:] == (0, 0, 255, 0, 255, 128, 128, 128)
    assert second[6:] == (255, 255, 0, 255, 0, 128, 128, 128)


def test_broken_gaussians_are_left_out_and_nothing_but_these_is_refused(tmp_path):
    gaussians = some()
    gaussians.means[3, 1] = torch.nan
    assert write_splat(tmp_path / "a.splat", gaussians) == 19
    gaussians.opacities[:] = torch.inf
    with pytest.raises(CompleteSplatError, match="all 20 Gaussians"):
        write_splat(tmp_path / "b.splat", gaussians)
    assert [path.name for path in tmp_path.iterdir()] == ["a.splat"]
