"""`.usdz`, read by OpenUSD itself."""

import re
import sys

import numpy as np
import pytest
import torch
from support import round_gaussians

from completesplat.errors import CompleteSplatError
from completesplat.export.formats import write_format
from completesplat.export.scene_files import OutputFiles
from completesplat.export.splat_transform import PageView
from completesplat.export.usdz import write_usdz
from completesplat.gaussians import Gaussians
from completesplat.geometry.cameras import Cameras, pinhole
from completesplat.geometry.harmonics import SH_C0
from completesplat.geometry.rotations import normalize_quaternion
from completesplat.installation import install_command

usd = pytest.importorskip("pxr.Usd")
from pxr import UsdGeom, UsdUtils, UsdVol  # noqa: E402

VIEW = PageView(
    Cameras(torch.eye(4), pinhole(50, 64), (64, 64)), torch.tensor([0.0, 0, 3]), torch.tensor([0.0, -1, 0]), 0.5
)
TURN = torch.diag(torch.tensor([1.0, -1, -1]))  # half a turn about x: +y up, +z to the viewer


def some(count: int = 20) -> Gaussians:
    means, quaternions, scales, rest = (
        torch.rand(count, n, generator=torch.Generator().manual_seed(n)) for n in (3, 4, 5, 6)
    )
    return Gaussians(means, quaternions * 2 - 1, scales[:, :3] + 0.01, rest[:, 3], rest[:, :3] * 1.2)


def test_openusd_reads_the_same_gaussians(tmp_path):
    own = some()
    write_format(tmp_path, "a", "usdz", own, VIEW, ["seed 3"])
    stage = usd.Stage.Open(str(tmp_path / "a.usdz"))
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert splats
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert stage.GetRootLayer().comment == "seed 3"

    def read(attribute) -> torch.Tensor:
        return torch.from_numpy(np.array(attribute.Get(), np.float32))

    torch.testing.assert_close(read(splats.GetPositionsAttr()), own.means @ TURN)
    torch.testing.assert_close(read(splats.GetScalesAttr()), own.scales)
    torch.testing.assert_close(read(splats.GetOpacitiesAttr()), own.opacities)
    assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 0
    colors = read(splats.GetRadianceSphericalHarmonicsCoefficientsAttr()) * SH_C0 + 0.5
    torch.testing.assert_close(colors, own.colors.clamp(0, 1))
    turns = [[turn.real, *turn.imaginary] for turn in splats.GetOrientationsAttr().Get()]
    there = Gaussians(own.means @ TURN, torch.tensor(turns), own.scales, own.opacities, own.colors)
    torch.testing.assert_close(normalize_quaternion(there.quaternions), there.quaternions)
    torch.testing.assert_close(there.covariances(), TURN @ own.covariances() @ TURN)
    lowest, highest = read(splats.GetExtentAttr())
    assert (there.means > lowest).all()
    assert (there.means < highest).all()
    assert UsdUtils.ComputeAllDependencies(str(tmp_path / "a.usdz"))[2] == []  # unresolved


def test_without_the_extra_it_is_refused_before_anything_runs(monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr.Usd", None)
    with pytest.raises(CompleteSplatError, match=re.escape(install_command("usd"))):
        OutputFiles(("usdz",))


def test_an_empty_set_is_refused(tmp_path):
    with pytest.raises(CompleteSplatError, match="empty"):
        write_usdz(tmp_path / "a.usdz", round_gaussians(torch.zeros(0, 3), 1.0, 1.0, 0.5))
    assert list(tmp_path.iterdir()) == []
