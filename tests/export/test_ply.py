import dataclasses
from unittest.mock import Mock

import numpy as np
import pytest
import torch
from plyfile import PlyData

from completesplat.errors import PlyError
from completesplat.export.ply import read_ply, write_ply
from completesplat.gaussians import DirectionalGaussians, Gaussians, merge_gaussians
from completesplat.ply_files import vertex_header

C0 = 0.5 / np.sqrt(np.pi)
NAMES = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity"]
NAMES += ["scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def random_gaussians(count=500, dtype=torch.float32):
    draws = torch.Generator().manual_seed(0)
    means, quaternions, scales, rest = (torch.rand(count, n, generator=draws, dtype=dtype) for n in (3, 4, 3, 4))
    opacities = rest[:, 3] * 0.998 + 0.001
    return Gaussians(means * 8 - 4, quaternions * 2 - 1, 10 ** (scales * 5 - 4), opacities, rest[:, :3])


@pytest.fixture
def written(tmp_path):
    """A good file of ten Gaussians, and its bytes."""
    path = tmp_path / "good.ply"
    write_ply(path, random_gaussians(10))
    return path, path.read_bytes()


def test_plyfile_reads_the_layout_and_the_stated_formulas(tmp_path):
    gaussians = random_gaussians(dtype=torch.float64)
    assert write_ply(tmp_path / "a.ply", gaussians) == 500
    ply = PlyData.read(tmp_path / "a.ply")
    vertex = ply["vertex"]
    assert [element.name for element in ply.elements] == ["vertex"]
    assert [p.name for p in vertex.properties] == NAMES
    assert {p.val_dtype for p in vertex.properties} == {"f4"}
    assert (ply.text, ply.byte_order) == (False, "<")
    alpha = gaussians.opacities.numpy()
    unit = gaussians.quaternions / gaussians.quaternions.norm(dim=-1, keepdim=True)
    expected = {
        "x": gaussians.means[:, 0].numpy(),
        "z": gaussians.means[:, 2].numpy(),
        "ny": np.zeros(500),
        "f_dc_1": (gaussians.colors[:, 1].numpy() - 0.5) / C0,
        "opacity": np.log(alpha) - np.log1p(-alpha),
        "scale_2": np.log(gaussians.scales[:, 2].numpy()),
        "rot_0": unit[:, 0].numpy(),
        "rot_3": unit[:, 3].numpy(),
    }
    for name, values in expected.items():
        np.testing.assert_allclose(vertex[name], values.astype(np.float32), rtol=2e-7, atol=1e-7, err_msg=name)


def test_reading_returns_what_was_written_and_writing_that_the_same_bytes(tmp_path):
    edges = Gaussians(
        means=torch.zeros(4, 3),
        quaternions=torch.tensor([[0, 0, 0, 0], [2, 0, 0, 0], [1e-3, 1e-3, 0, 0], [-1, 1, -1, 1]]).float(),
        scales=torch.tensor([[1, 0.99, 1.01], [1e-7, 1e-20, 2], [50, 1e6, 0.5], [1 / 3, 3, 2 / 3]]),
        opacities=torch.tensor([0.5, 2e-6, 1 - 2e-6, 1 / 3]),
        colors=torch.tensor([[0, 0.5, 1], [1e-9, 1e-7, 1e-3], [0.9999999, 1.5, 0.25], [0, 0, 0]]),
    )
    gaussians = random_gaussians(20_000)
    write_ply(tmp_path / "a.ply", merge_gaussians([gaussians, edges]))
    back = read_ply(tmp_path / "a.ply")
    write_ply(tmp_path / "b.ply", back)
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    back = back[:20_000]
    assert torch.equal(back.means, gaussians.means)
    torch.testing.assert_close(back.scales, gaussians.scales, rtol=1e-6, atol=0)
    torch.testing.assert_close(back.opacities, gaussians.opacities, rtol=1e-6, atol=0)
    torch.testing.assert_close(back.colors, gaussians.colors, rtol=0, atol=1e-7)
    torch.testing.assert_close(back[:500].covariances(), gaussians[:500].covariances(), rtol=1e-4, atol=1e-6)


def test_opacities_of_0_and_1_are_clamped_and_colours_below_0_read_as_0(tmp_path):
    colors = torch.tensor([[-0.5, 0.25, 1.5]] * 2)
    write_ply(tmp_path / "a.ply", dataclasses.replace(random_gaussians(2), opacities=torch.arange(2.0), colors=colors))
    limit = np.log(1e-6 / (1 - 1e-6))
    np.testing.assert_allclose(PlyData.read(tmp_path / "a.ply")["vertex"]["opacity"], [limit, -limit], rtol=1e-6)
    torch.testing.assert_close(read_ply(tmp_path / "a.ply").colors, colors.clamp(min=0), rtol=0, atol=1e-6)


def test_comments_are_kept_one_a_line(tmp_path):
    write_ply(tmp_path / "a.ply", random_gaussians(3), ["seed 7", "two\nend_header\nlines", "größe"])
    ply = PlyData.read(tmp_path / "a.ply")
    assert "+y down" in ply.comments[0]
    assert ply.comments[1:] == ["seed 7", "two end_header lines", "gr\\xf6\\xdfe"]
    assert read_ply(tmp_path / "a.ply").count == 3


def test_gaussians_that_cannot_be_stored_are_left_out(tmp_path, caplog):
    good = random_gaussians(5, dtype=torch.float64)
    scales = good.scales.clone()
    means = good.means.clone()
    scales[0, 1], scales[3, 2], means[4, 0] = 0, -1, 1e300
    assert write_ply(tmp_path / "a.ply", dataclasses.replace(good, scales=scales, means=means)) == 2
    assert torch.equal(read_ply(tmp_path / "a.ply").means, good.means[[1, 2]].float())
    assert "left out 3 of 5" in caplog.text
    assert write_ply(tmp_path / "a.ply", good[:0]) == read_ply(tmp_path / "a.ply").count == 0


def test_a_folder_is_no_file(tmp_path):
    with pytest.raises(PlyError, match="no such file"):
        read_ply(tmp_path)


def test_a_write_that_fails_leaves_the_old_file(tmp_path, written, monkeypatch):
    monkeypatch.setattr("os.replace", Mock(side_effect=OSError("full")))
    with pytest.raises(OSError, match="full"):
        write_ply(written[0], random_gaussians(99))
    assert [p.read_bytes() for p in tmp_path.iterdir()] == [written[1]]


def directional(degree, count=20):
    harmonics = torch.randn(count, (degree + 1) ** 2 - 1, 3, generator=torch.Generator().manual_seed(1)) * 0.2
    return DirectionalGaussians(**vars(random_gaussians(count)), harmonics=harmonics)


@pytest.mark.parametrize("degree", [1, 2])
def test_harmonics_are_written_channel_by_channel_and_read_again(degree, tmp_path):
    gaussians = directional(degree)
    write_ply(tmp_path / "a.ply", gaussians)
    vertex = PlyData.read(tmp_path / "a.ply")["vertex"]
    count = gaussians.harmonics.shape[1]
    names = [*NAMES[:9], *(f"f_rest_{index}" for index in range(3 * count)), *NAMES[9:]]
    assert [p.name for p in vertex.properties] == names
    for channel in range(3):
        for index in range(count):
            values = gaussians.harmonics[:, index, channel].numpy()
            np.testing.assert_array_equal(vertex[f"f_rest_{channel * count + index}"], values)
    again = read_ply(tmp_path / "a.ply")
    assert torch.equal(again.harmonics, gaussians.harmonics)
    torch.testing.assert_close(again.colors, gaussians.colors)


def test_a_color_seen_along_a_direction_is_that_of_the_formula_of_3d_gaussian_splatting(tmp_path):
    """The formula of degree 1, with its signs, evaluated on the file's own columns."""
    write_ply(tmp_path / "a.ply", directional(1))
    vertex = PlyData.read(tmp_path / "a.ply")["vertex"]
    eye = np.array([1.0, -2.0, 9.0])
    d = np.stack([vertex[axis] for axis in "xyz"], -1) - eye
    x, y, z = (d / np.linalg.norm(d, axis=-1, keepdims=True)).T
    c1 = np.sqrt(3 / (4 * np.pi))
    for channel in range(3):
        rest = [vertex[f"f_rest_{3 * channel + index}"] for index in range(3)]
        color = 0.5 + C0 * vertex[f"f_dc_{channel}"] - c1 * y * rest[0] + c1 * z * rest[1] - c1 * x * rest[2]
        seen = read_ply(tmp_path / "a.ply").seen_from(torch.tensor(eye, dtype=torch.float32)).colors[:, channel]
        np.testing.assert_allclose(seen, np.maximum(color, 0), atol=1e-5)


@pytest.mark.parametrize(("properties", "kept", "warning"), [(72, 15, "above degree 3"), (10, 0, "no degree")])
def test_harmonics_that_are_not_known_are_left_out_with_a_warning(properties, kept, warning, tmp_path, caplog):
    path = tmp_path / "a.ply"
    write_ply(path, random_gaussians(4))
    rows = np.fromfile(path, "<f4", offset=path.read_bytes().index(b"end_header\n") + 11).reshape(4, -1)
    rest = np.arange(4 * properties, dtype="<f4").reshape(4, -1)
    names = [*NAMES, *(f"f_rest_{index}" for index in range(properties))]
    path.write_bytes(vertex_header(4, [(name, "float") for name in names]) + np.hstack([rows, rest]).tobytes())
    gaussians = read_ply(path)
    assert warning in caplog.text
    assert isinstance(gaussians, DirectionalGaussians) == (kept > 0)
    if kept:
        expected = torch.from_numpy(rest.reshape(4, 3, 24)[:, :, :kept].copy()).mT
        assert torch.equal(gaussians.harmonics, expected)
