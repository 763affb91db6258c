"""The real converter: what it writes is read back by itself and compared; needs Node.js."""

import dataclasses
import gzip
import json
import shutil
import subprocess

import numpy as np
import pytest
import torch

from completesplat.export.formats import write_format
from completesplat.export.ply import read_ply
from completesplat.export.splat_transform import PageView, convert
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("npx") is None and shutil.which("splat-transform") is None, reason="no Node.js"),
]
CAMERA = Cameras(torch.eye(4), pinhole(50, 64), (64, 64))
VIEW = PageView(CAMERA, torch.tensor([0.0, 0, 3]), torch.tensor([0.0, -1, 0]), 0.5)
# Largest errors: positions (units), logarithms of scales, opacities and colours, and of the rotation's entries.
PRECISION = {
    "splat": (1e-6, 1e-5, 0.5 / 255, 0.02),
    "compressed.ply": (4e-3, 0.02, 1 / 255, 0.01),
    "spz": (1 / 4096, 1 / 32 + 1e-4, 1 / 255, 0.005),
    "sog": (1e-3, 0.02, 1 / 255, 0.03),
}


def some(count: int = 400) -> Gaussians:
    """Splats in front of the camera, more to the right than to the left and more below than above."""
    draws = torch.Generator().manual_seed(0)
    means, quaternions, scales, rest = (torch.rand(count, n, generator=draws) for n in (3, 4, 3, 4))
    means = means * torch.tensor([2.0, 3, 4]) + torch.tensor([-0.5, -0.5, 2])
    return Gaussians(means, quaternions * 2 - 1, 10 ** (scales * 2 - 2.5), rest[:, 3] * 0.95 + 0.02, rest[:, :3])


@pytest.fixture(scope="module")
def written(converter, tmp_path_factory):
    """A folder with the scene in all formats, and each of them converted back."""
    folder = tmp_path_factory.mktemp("formats")
    for kind in ("ply", *PRECISION):
        write_format(folder, "a", kind, some(), VIEW)
    for kind in PRECISION:
        convert(converter, folder / f"a.{kind}", folder / f"{kind.partition('.')[0]}_back.ply")
    return folder


@pytest.mark.parametrize("kind", PRECISION)
def test_every_format_reads_back_as_the_same_gaussians_on_the_same_axes(written, kind):
    own = read_ply(written / "a.ply")
    back = read_ply(written / f"{kind.partition('.')[0]}_back.ply")
    distances = torch.cdist(own.means.double(), back.means.double())
    nearest = distances.argmin(1)
    assert sorted(nearest.tolist()) == list(range(own.count))  # each Gaussian is there once
    if kind not in ("sog", "compressed.ply"):  # which sort by place
        assert nearest.tolist() == list(range(own.count))
    back = back[nearest]
    place, scale, byte, rotation = PRECISION[kind]
    assert (own.means - back.means).abs().max() <= place
    assert (own.scales.log() - back.scales.log()).abs().max() <= scale
    assert (own.opacities - back.opacities).abs().max() <= byte + 1e-5
    assert (own.colors - back.colors).abs().max() <= byte * (1.5 if kind == "sog" else 1) + 1e-5
    unit = [dataclasses.replace(g, scales=torch.tensor([3.0, 2, 1]).expand(400, 3)) for g in (own, back)]
    turns = [g.covariances() for g in unit]  # free of the sign of quaternions
    assert (turns[0] - turns[1]).abs().max() <= rotation * 9


def test_spz_has_y_up_and_z_to_the_viewer_as_its_format_says(written):
    """Read without a library: version 3 is gzip, and positions are 24 bits with 12 behind the point."""
    data = gzip.decompress((written / "a.spz").read_bytes())
    assert data[:8] == b"NGSP\x03\0\0\0"
    raw = np.frombuffer(data[16 : 16 + 400 * 9], np.uint8).reshape(400, 3, 3).astype(np.int32)
    fixed = raw[..., 0] | raw[..., 1] << 8 | raw[..., 2] << 16
    means = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed) / 4096
    expected = read_ply(written / "a.ply").means.numpy() * [1, -1, -1]
    assert np.abs(means - expected).max() <= 1 / 4096


def test_both_versions_of_spz_hold_the_same(written, converter):
    """By nianticlabs/spz, README: magic number NGSP, then the version."""
    write_format(written, "four", "spz", some(), VIEW, spz_version=4)
    assert (written / "four.spz").read_bytes()[:8] == b"NGSP\x04\0\0\0"
    convert(converter, written / "four.spz", written / "four_back.ply")
    three = read_ply(written / "spz_back.ply")
    four = read_ply(written / "four_back.ply")
    for name, values in vars(three).items():
        torch.testing.assert_close(getattr(four, name), values, msg=name)


def test_no_opacity_comes_back_from_spz_as_minus_infinity(tmp_path, converter):
    opacities = torch.linspace(0, 1.2 / 255, 400)
    write_format(tmp_path, "a", "spz", dataclasses.replace(some(), opacities=opacities), VIEW)
    convert(converter, tmp_path / "a.spz", tmp_path / "back.ply")
    back = read_ply(tmp_path / "back.ply")  # which refuses infinity
    assert 200 < back.count < 250
    torch.testing.assert_close(back.opacities, torch.full((back.count,), 1 / 255))


# three.js's own reader of the extension; its largest differences of positions, covariances and colours.
READER = """
import fs from 'fs'; globalThis.self = globalThis;
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js';
import { GLTFGaussianSplatLoaderExtension } from 'three/addons/loaders/GLTFGaussianSplatLoaderExtension.js';
const data = fs.readFileSync('a.glb'), loader = new GLTFLoader();
loader.register( parser => new GLTFGaussianSplatLoaderExtension( parser ) );
loader.parse( data.buffer.slice( data.byteOffset, data.byteOffset + data.length ), '', read => {
  read.scene.traverse( part => {
    if ( part.isGaussianSplat ) {
      const { position, covariance, color } = part.splatGeometry.attributes;
      console.log( JSON.stringify( [ position, covariance, color ].map( values => Array.from( values.array ) ) ) );
    }
  } );
} );
"""


def test_three_js_reads_the_same_gaussians_from_glb(tmp_path):
    npm = ["npm", "install", "--silent", "--prefix", str(tmp_path), "three@0.187.0"]
    if subprocess.run(npm, capture_output=True).returncode:
        pytest.skip("three.js cannot be had from npm")
    (tmp_path / "read.mjs").write_text(READER)
    own = some()
    write_format(tmp_path, "a", "glb", own, VIEW)
    done = subprocess.run(["node", "read.mjs"], cwd=tmp_path, capture_output=True, text=True, check=True)
    means, covariances, colors = (torch.tensor(values).view(400, -1) for values in json.loads(done.stdout))
    turn = torch.diag(torch.tensor([1.0, -1, -1]))
    torch.testing.assert_close(means, own.means @ turn)
    i, j = torch.triu_indices(3, 3)
    torch.testing.assert_close(covariances, (turn @ own.covariances() @ turn)[:, i, j], rtol=1e-4, atol=1e-7)
    expected = torch.cat([own.colors, own.opacities[:, None]], dim=1)
    torch.testing.assert_close(colors / 255, expected, rtol=0, atol=0.51 / 255)
