"""Files of one scene: splats in several formats, and videos."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from completesplat.export import mesh, usdz
from completesplat.export.cleaning import with_screen_space_dilation
from completesplat.export.compressed import SpzVersion
from completesplat.export.formats import suffix as format_suffix
from completesplat.export.formats import write_format
from completesplat.export.placed_scene import PlacedScene
from completesplat.export.splat_transform import PageView
from completesplat.export.subject import all_around, subject_of
from completesplat.export.video import render_views, write_video
from completesplat.geometry.trajectories import PATHS
from completesplat.quantities import CameraPath, Format
from completesplat.rasterizers import Rasterizer


@dataclass(frozen=True)
class OutputFiles:
    """Selection of the files that are written for each scene.

    Raises:
        CompleteSplatError: a format needs a package that is missing.

    Args:
        formats: scene formats; some need `find_splat_transform`.
        videos: camera paths; each video has `frames` frames.
        background: grey value behind the scene.
        maps: whether a prediction gets the depth, normals and opacity of the photo's view.
        screen_space_dilation: whether to store Gaussians `with_screen_space_dilation`.
        spz_version: version of `.spz` files.
    """

    formats: Sequence[Format] = ("ply",)
    videos: Sequence[CameraPath] = ("orbit",)
    frames: int = 48
    background: float = 0.5
    maps: bool = False
    screen_space_dilation: bool = True
    spz_version: SpzVersion = 3

    def __post_init__(self) -> None:
        if "mesh" in self.formats:
            mesh.check_available()
        if "usdz" in self.formats:
            usdz.check_available()


def write_scene(
    folder: Path,
    name: str,
    suffix: str,
    scene: PlacedScene,
    rasterizer: Rasterizer,
    outputs: OutputFiles,
    comments: Sequence[str],
    on_file: Callable[[str], None] = lambda name: None,
) -> dict[str, str]:
    """Write a scene's splats (`NAME.ply`, ...) in the coordinates of files, and videos (`orbitSUFFIX.mp4`).

    Args:
        comments: lines of metadata for formats that have them.
        on_file: called with the name of each file before it is written.

    Returns:
        File names by purpose.
    """
    gaussians = scene.gaussians
    subject = subject_of(scene, rasterizer)
    around = all_around(scene.camera, subject)
    dilated = with_screen_space_dilation(gaussians, scene.camera) if outputs.screen_space_dilation else gaussians
    stored = scene.coordinates.gaussians(dilated)
    camera = scene.coordinates.camera(scene.camera)
    view = PageView(camera, scene.coordinates.points(subject.center), scene.up, outputs.background)
    files: dict[str, str] = {}
    for kind in outputs.formats:
        on_file(name + format_suffix(kind))
        files.update(write_format(folder, name, kind, stored, view, comments, rasterizer, outputs.spz_version))
    for path in outputs.videos:
        video = f"{path}{suffix}.mp4"
        on_file(video)
        cameras = PATHS[path](around, subject.center, scene.up, outputs.frames)
        frames, _ = render_views(rasterizer, gaussians, cameras, outputs.background)
        write_video(folder / video, frames)
        files[f"{path}{suffix}"] = video
    return files
