"""Export of one scene to several file formats, and the writer of the simplest one, `.splat`."""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.export.cleaning import cleaned, transparent
from completesplat.export.gltf import write_glb
from completesplat.export.ply import write_ply
from completesplat.export.splat_transform import PageView, SplatTransform, write_page
from completesplat.files import write_bytes
from completesplat.gaussians import Gaussians
from completesplat.geometry.rotations import normalize_quaternion

FORMATS = ("ply", "splat", "glb", "spz", "sog", "html")
CONVERTED = ("spz", "sog", "html")
RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("colors", "u1", 4), ("quaternions", "u1", 4)])


def write_formats(
    folder: Path,
    name: str,
    gaussians: Gaussians,
    formats: Sequence[str],
    view: PageView,
    converter: SplatTransform | None,
    comments: Sequence[str] = (),
) -> dict[str, str]:
    """Write one scene as `NAME.ply`, `NAME.spz` and so on.

    All formats except `.ply` get colours clipped to [0, 1], because only some formats and readers would clip them. The
    `.ply` keeps colours above 1, because Gaussians may be seen through others. All files keep the frame of the given
    Gaussians, except the page, which is turned upright. `.ply`, `.splat` and `.sog` keep our axes (+y down). `.glb` and
    `.spz` prescribe +y up and +z towards the viewer; readers of `.spz` undo this. `.spz` omits `transparent` Gaussians.

    Returns:
        File names by purpose: `NAME` for the `.ply`, `NAME_spz` and so on for the others.

    Raises:
        CompleteSplatError: there is nothing to write, or the converter (for `CONVERTED` formats) is missing or fails.
    """
    if converter is None and set(formats) & set(CONVERTED):
        raise CompleteSplatError(f"a converter is needed for {', '.join(set(formats) & set(CONVERTED))}")
    if "ply" in formats:
        write_ply(folder / f"{name}.ply", gaussians, comments)
    gaussians = replace(gaussians, colors=gaussians.colors.clamp(0, 1))
    with tempfile.TemporaryDirectory() as temporary:
        source = Path(temporary) / f"{name}.ply"
        write_ply(source, gaussians, comments)
        for kind in formats:
            target = folder / f"{name}.{kind}"
            if kind == "splat":
                write_splat(target, gaussians)
            elif kind == "glb":
                write_glb(target, gaussians, comments)
            elif kind == "html" and converter is not None:
                write_page(target, gaussians, view, converter)
            elif kind == "spz" and converter is not None:
                visible, seen = Path(temporary) / "visible.ply", gaussians.keep(~transparent(gaussians))
                if not seen.count:
                    raise CompleteSplatError(f"{target}: all {gaussians.count} Gaussians are transparent")
                write_ply(visible, seen, comments)
                converter.convert(visible, target)
            elif kind in CONVERTED and converter is not None:
                converter.convert(source, target)
    return {name if kind == "ply" else f"{name}_{kind}": f"{name}.{kind}" for kind in formats}


def write_splat(path: str | Path, gaussians: Gaussians) -> int:
    """Write one unbatched set of Gaussians in its order, as `write_ply` does; clamp colours to [0, 1]."""
    stored = cleaned(gaussians, path).detach()
    records = np.zeros(stored.count, RECORD)
    records["means"], records["scales"] = stored.means.cpu(), stored.scales.cpu()
    records["colors"] = _bytes(torch.cat([stored.colors, stored.opacities[:, None]], dim=-1) * 255)
    records["quaternions"] = _bytes(normalize_quaternion(stored.quaternions) * 128 + 128)
    write_bytes(path, records.tobytes())
    return stored.count


def _bytes(values: Tensor) -> UInt8[np.ndarray, "*shape"]:
    return values.round().clamp(0, 255).to(torch.uint8).cpu().numpy()
