"""Binary glTF, read back by the specification's text alone."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from completesplat.errors import CompleteSplatError
from completesplat.export.gltf import write_glb
from completesplat.gaussians import Gaussians

# By the extension's text: component types (here floats) and numbers of components of the attributes that it requires.
REQUIRED = {"ROTATION": 4, "SCALE": 3, "OPACITY": 1, "SH_DEGREE_0_COEF_0": 3}
PREFIX = "KHR_gaussian_splatting:"
COMPONENTS = {5126: "<f4", 5123: "<u2"}
NUMBERS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def some(count: int = 30) -> Gaussians:
    draws = torch.Generator().manual_seed(0)
    means, quaternions, scales, rest = (torch.rand(count, n, generator=draws) for n in (3, 4, 3, 4))
    return Gaussians(means * 8 - 4, quaternions * 4 - 2, scales + 0.01, rest[:, 3], rest[:, :3])


def read(path: Path) -> tuple[dict, dict[str, np.ndarray]]:
    """The description, and the only primitive's attributes as arrays."""
    data = path.read_bytes()
    magic, version, length, size, kind = struct.unpack_from("<4sIII4s", data)
    assert (magic, version, length, kind) == (b"glTF", 2, len(data), b"JSON")
    description = json.loads(data[20 : 20 + size])
    start = 20 + size
    binary, kind = struct.unpack_from("<I4s", data, start)
    assert (start % 4, binary % 4, kind, start + 8 + binary) == (0, 0, b"BIN\0", length)
    assert [buffer["byteLength"] for buffer in description["buffers"]] == [binary]
    arrays = {}
    for name, index in description["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = description["accessors"][index]
        view = description["bufferViews"][accessor["bufferView"]]
        kind = np.dtype(COMPONENTS[accessor["componentType"]])
        shape = accessor["count"], NUMBERS[accessor["type"]]
        assert (view["byteOffset"] % 4, view["byteLength"]) == (0, shape[0] * shape[1] * kind.itemsize)
        arrays[name] = np.frombuffer(data, kind, shape[0] * shape[1], start + 8 + view["byteOffset"]).reshape(shape)
    return description, arrays


def test_a_file_says_what_the_specifications_ask_for(tmp_path):
    assert write_glb(tmp_path / "a.glb", some(), ["seed 7"]) == 30
    description, arrays = read(tmp_path / "a.glb")
    assert description["asset"]["version"] == "2.0"
    assert description["asset"]["extras"] == {"comments": ["seed 7"]}
    assert description["extensionsUsed"] == ["KHR_gaussian_splatting"]
    assert "extensionsRequired" not in description  # others may show points
    (primitive,) = description["meshes"][0]["primitives"]
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert primitive["mode"] == 0
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    assert extension.get("projection", "perspective") == "perspective"
    assert extension.get("sortingMethod", "cameraDistance") == "cameraDistance"
    splats = {PREFIX + name: (np.float32, (30, size)) for name, size in REQUIRED.items()}
    expected = splats | {"POSITION": (np.float32, (30, 3)), "COLOR_0": (np.uint16, (30, 4))}
    assert {name: (array.dtype, array.shape) for name, array in arrays.items()} == expected
    accessors = {name: description["accessors"][index] for name, index in primitive["attributes"].items()}
    assert accessors["POSITION"]["min"] == arrays["POSITION"].min(0).tolist()
    assert accessors["POSITION"]["max"] == arrays["POSITION"].max(0).tolist()
    assert [name for name, accessor in accessors.items() if accessor.get("normalized")] == ["COLOR_0"]


def test_the_same_gaussians_are_read_back_with_y_up_and_z_to_the_viewer(tmp_path):
    own = some()
    write_glb(tmp_path / "a.glb", own)
    _, arrays = read(tmp_path / "a.glb")
    turn = np.diag([1.0, -1, -1])
    np.testing.assert_array_equal(arrays["POSITION"], own.means.numpy() @ turn)
    quaternions = arrays[PREFIX + "ROTATION"]
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1, atol=1e-6)
    root = Rotation.from_quat(quaternions).as_matrix() * arrays[PREFIX + "SCALE"][:, None, :]  # SciPy: x, y, z, w
    np.testing.assert_allclose(root @ root.mT, turn @ own.covariances().numpy() @ turn, atol=1e-5)
    np.testing.assert_array_equal(arrays[PREFIX + "OPACITY"][:, 0], own.opacities.numpy())
    colors = arrays[PREFIX + "SH_DEGREE_0_COEF_0"] * 0.2820947917738781 + 0.5
    np.testing.assert_allclose(colors, own.colors.numpy(), atol=1e-6)


def test_points_have_linear_colours_and_the_opacity(tmp_path):
    grey = torch.tensor([0.0, 0.03, 0.5, 1.0, 1.7])
    scene = replace(some(5), colors=grey[:, None].expand(5, 3), opacities=torch.tensor([0.0, 0.25, 0.5, 0.75, 1.0]))
    write_glb(tmp_path / "a.glb", scene)
    points = read(tmp_path / "a.glb")[1]["COLOR_0"] / 65535
    # By the table of sRGB: 0.03 is on its straight part, 0.5 becomes 0.2140.
    np.testing.assert_allclose(points[:, 0], [0, 0.03 / 12.92, 0.214041, 1, 1], atol=1e-5)
    np.testing.assert_allclose(points[:, 3], scene.opacities.numpy(), atol=1e-5)


def test_broken_gaussians_are_left_out_and_an_empty_set_is_refused(tmp_path):
    broken = some(3)
    broken.means[1, 0] = torch.nan
    assert write_glb(tmp_path / "a.glb", broken) == 2
    assert len(read(tmp_path / "a.glb")[1]["POSITION"]) == 2
    with pytest.raises(CompleteSplatError, match="no empty sets"):
        write_glb(tmp_path / "b.glb", broken[:0])
    assert [path.name for path in tmp_path.iterdir()] == ["a.glb"]
