"""Writer of `.usdz`, with the prim for splats of OpenUSD 26.03 (`ParticleField3DGaussianSplat`), by usd-core."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from completesplat.errors import CompleteSplatError, needing
from completesplat.export.cleaning import cleaned
from completesplat.export.gltf import TO_GLTF
from completesplat.files import atomic_path
from completesplat.gaussians import Gaussians
from completesplat.geometry.harmonics import SH_C0
from completesplat.geometry.rotations import normalize_quaternion

PRIM = "/Splats"
SIGMAS = 3.0  # of a Gaussian that the prim's extent holds


def check_available() -> None:
    """Raise CompleteSplatError unless usd-core is installed."""
    with needing("usd", "usdz needs usd-core"):
        import pxr.Usd  # noqa: F401


def write_usdz(path: str | Path, gaussians: Gaussians, comments: Sequence[str] = ()) -> int:
    """Write one unbatched set of Gaussians, with +y up and +z backward.

    The prim has means, orientations, scales (linear), opacities (linear) and colours as zeroth spherical harmonic, as
    its schema says (OpenUSD, `pxr/usd/usdVol/schema.usda`). Readers that do not know it find colours of points.

    Args:
        comments: lines of metadata, for the layer's comment.

    Returns:
        Number of Gaussians in the file.

    Raises:
        CompleteSplatError: usd-core is missing, or no Gaussian can be stored.
    """
    check_available()
    from pxr import UsdUtils

    stored = cleaned(gaussians, path).detach().to("cpu", torch.float32).transform(TO_GLTF)
    if not stored.count:
        raise CompleteSplatError(f"{path}: usdz has no empty sets of Gaussians")
    with tempfile.TemporaryDirectory() as folder, atomic_path(path) as temporary:
        layer = Path(folder) / "splats.usdc"
        stage = _stage(layer, stored, comments)
        stage.GetRootLayer().Save()
        if not UsdUtils.CreateNewUsdzPackage(str(layer), str(temporary)):
            raise CompleteSplatError(f"{path}: usd-core has not written it")
    return stored.count


def _stage(layer: Path, gaussians: Gaussians, comments: Sequence[str]) -> Any:
    from pxr import Sdf, Usd, UsdGeom, UsdVol, Vt

    def array(kind: Any, values: Tensor) -> Any:
        return kind.FromNumpy(np.ascontiguousarray(values.numpy().astype("<f4")))

    stage = Usd.Stage.CreateNew(str(layer))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.GetRootLayer().comment = "\n".join(comments)
    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, PRIM)
    stage.SetDefaultPrim(splats.GetPrim())
    reach = SIGMAS * gaussians.scales.amax(-1, keepdim=True)
    lowest = (gaussians.means - reach).amin(0)
    highest = (gaussians.means + reach).amax(0)
    splats.CreateExtentAttr(array(Vt.Vec3fArray, torch.stack([lowest, highest])))
    splats.CreatePositionsAttr(array(Vt.Vec3fArray, gaussians.means))
    imaginary_first = normalize_quaternion(gaussians.quaternions).roll(-1, dims=-1)
    splats.CreateOrientationsAttr(array(Vt.QuatfArray, imaginary_first))
    splats.CreateScalesAttr(array(Vt.Vec3fArray, gaussians.scales))
    splats.CreateOpacitiesAttr(array(Vt.FloatArray, gaussians.opacities))
    splats.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    coefficients = (gaussians.colors - 0.5) / SH_C0
    splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(array(Vt.Vec3fArray, coefficients))
    shown = UsdGeom.PrimvarsAPI(splats).CreatePrimvar(
        "displayColor", Sdf.ValueTypeNames.Color3fArray, UsdGeom.Tokens.vertex
    )
    shown.Set(array(Vt.Vec3fArray, gaussians.colors.clamp(0, 1)))
    return stage
