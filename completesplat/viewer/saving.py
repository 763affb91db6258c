"""Files of what the page shows."""

from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path

import viser

from completesplat.errors import CompleteSplatError
from completesplat.export.atomic import atomic_path
from completesplat.export.ply import write_ply
from completesplat.export.video import write_video
from completesplat.export.views import orbit_views
from completesplat.rasterizers import Rasterizer
from completesplat.viewer.samples import Sample
from completesplat.viewer.stage import Stage


class Saver:
    """Writes numbered files into a folder; nothing is overwritten.

    Args:
        make_rasterizer: called when the first video is wanted, as it may have to be compiled.
        frames: of a video.
        background: its grey value where a scene leaves a pixel open.
    """

    def __init__(
        self, folder: Path, stage: Stage, make_rasterizer: Callable[[], Rasterizer], frames: int, background: float
    ) -> None:
        self.folder, self.stage, self.frames, self.background = folder, stage, frames, background
        self._make_rasterizer = make_rasterizer

    @cached_property
    def rasterizer(self) -> Rasterizer:
        return self._make_rasterizer()

    def save(self, kind: str, samples: Sequence[Sample]) -> list[Path]:
        """Write these samples as `ply` or `video`, or the page as it stands as `html`.

        Raises:
            CompleteSplatError: nothing is shown yet.
        """
        if not samples:
            raise CompleteSplatError("there is nothing to save yet: draw samples first")
        if kind == "html":
            return [self.html(self._next("page", ".html"))]
        return [self.ply(sample) if kind == "ply" else self.video(sample) for sample in samples]

    def ply(self, sample: Sample) -> Path:
        """All layers of the sample, in its reference camera's frame."""
        path = self._next("sample", ".ply")
        write_ply(path, sample.for_viewers(), [f"{name} {value}" for name, value in sample.settings.items()])
        return path

    def video(self, sample: Sample) -> Path:
        """A turn about the sample."""
        path = self._next("orbit", ".mp4")
        reference = sample.reference
        up = reference.intrinsics.new_tensor(self.stage.up.tolist())
        frames, _ = orbit_views(
            self.rasterizer, sample.gaussians, reference, sample.pivot(), self.frames, self.background, up
        )
        write_video(path, frames)
        return path

    def html(self, path: Path) -> Path:
        """The scene as one file that needs no server, without the controls."""
        return write_page(self.stage.server, path)

    def _next(self, stem: str, suffix: str) -> Path:
        taken = {path.name for path in self.folder.glob(f"{stem}_*{suffix}")}
        return self.folder / next(name for i in range(10**6) if (name := f"{stem}_{i:02}{suffix}") not in taken)


def write_page(server: viser.ViserServer, path: Path) -> Path:
    """What the server shows, as one offline HTML file."""
    text = server.get_scene_serializer().as_html()
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return path
