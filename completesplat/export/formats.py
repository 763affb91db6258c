"""Names of the file formats that a scene is exported to, and the writing of one scene in any of them."""

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

from completesplat.errors import CompleteSplatError
from completesplat.export.compressed import SpzVersion, write_compressed_ply, write_spz
from completesplat.export.gltf import write_glb, write_mesh
from completesplat.export.mesh import mesh_of
from completesplat.export.ply import write_ply
from completesplat.export.splat import write_splat
from completesplat.export.splat_transform import PageView, convert, find_splat_transform, write_turning_page
from completesplat.export.usdz import write_usdz
from completesplat.gaussians import Gaussians
from completesplat.quantities import Format
from completesplat.rasterizers import Rasterizer

FORMATS: tuple[str, ...] = get_args(Format)
CONVERTED = ("sog", "html")


def write_format(
    folder: Path,
    name: str,
    kind: str,
    gaussians: Gaussians,
    view: PageView,
    comments: Sequence[str] = (),
    rasterizer: Rasterizer | None = None,
    spz_version: SpzVersion = 3,
) -> dict[str, str]:
    """Write one scene in the format `kind`, as `NAME.ply`, `NAME.spz` and so on, or its mesh as `NAME_mesh.glb`.

    All formats except `.ply` get colours clipped to [0, 1], because only some formats and readers would clip them, and
    the colours that the reference camera sees, if these depend on the direction. The `.ply` keeps colours above 1,
    because Gaussians may be seen through others, and all harmonics. All files keep the frame of the given Gaussians,
    except the page, which is turned upright. `.ply`, `.compressed.ply`, `.splat` and `.sog` keep our axes (+y down).
    `.glb`, `.usdz` and `.spz` prescribe +y up and +z towards the viewer. `.spz` omits `transparent` Gaussians.

    Returns:
        The file's name by its purpose: `NAME` for the `.ply`, `NAME_spz` and so on for the others.

    Raises:
        CompleteSplatError: there is nothing to write, the converter (for `CONVERTED` formats) or the rasterizer (for a
            mesh) is missing, or one of them fails.
    """
    path = folder / f"{name}{suffix(kind)}"
    if kind == "ply":
        write_ply(path, gaussians, comments)
        return {name: path.name}
    one_color = gaussians.seen_from(view.reference.centers)
    clipped = replace(one_color, colors=one_color.colors.clamp(0, 1))
    if kind == "splat":
        write_splat(path, clipped)
    elif kind == "compressed.ply":
        write_compressed_ply(path, clipped)
    elif kind == "spz":
        write_spz(path, clipped, spz_version)
    elif kind == "glb":
        write_glb(path, clipped, comments)
    elif kind == "usdz":
        write_usdz(path, clipped, comments)
    elif kind == "mesh":
        if rasterizer is None:
            raise CompleteSplatError(f"a rasterizer is needed for {kind}")
        write_mesh(path, mesh_of(rasterizer, clipped, view.reference, view.pivot), comments)
    elif kind == "html":
        write_turning_page(path, clipped, view)
    else:
        with tempfile.TemporaryDirectory() as temporary:
            source = Path(temporary) / f"{path.stem}.ply"
            write_ply(source, clipped, comments)
            convert(find_splat_transform(), source, path)
    return {f"{name}_{kind}": path.name}


def suffix(kind: str) -> str:
    """Return the end of the names of a format's files."""
    return "_mesh.glb" if kind == "mesh" else f".{kind}"
