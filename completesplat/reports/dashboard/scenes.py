"""A table of tested scenes for Weights & Biases: pictures, turntables and scores."""

from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from completesplat.export.depth_colors import color_depth
from completesplat.export.maps import surface_depth
from completesplat.export.pixels import enlarge, to_bytes
from completesplat.export.prediction import seen_center
from completesplat.export.video import write_video
from completesplat.export.views import orbit_views
from completesplat.metrics.evaluation import BEST, MODEL, Evaluation, Scores
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.samples import evenly_spaced
from completesplat.training.scene_module import SceneModule, ScoredScene

VIEWS, FRAMES = 4, 48
READABLE_SIDE = 128


class SceneTable:
    """Rows of the first scenes that a test scores in this process, of which the module must tell it (`add`).

    Pictures are rows of views: the reference's, then targets, evenly spread. Depth and turntable are of the first
    sample; the turntables are also `folder/00.mp4` and so on.

    Args:
        folder: of the videos.
        most: scenes.
    """

    def __init__(self, module: SceneModule, folder: Path, most: int) -> None:
        self.module, self.folder, self.most = module, folder, most
        self.columns: list[str | int] = []
        self.rows: list[list[Any]] = []
        self.videos: list[Path] = []
        self.names: list[str] = []

    @torch.no_grad()
    def add(self, scene: ScoredScene) -> None:
        """Keep what is shown of a scene."""
        if len(self.rows) >= self.most:
            return
        row: dict[str, Any] = {"scene": scene.name, "input": strip(scene.input[None])}
        views = [0, *(1 + place for place in evenly_spaced(len(scene.truth.images) - 1, VIEWS - 1))]
        row["truth"] = strip(scene.truth.images[views])
        row |= {f"sample {n}": strip(images[views]) for n, images in enumerate(scene.images, 1)}
        with torch.autocast(self.module.device.type, enabled=False):
            seen = self.module.rasterizer(scene.gaussians[:1], scene.cameras[views][None])
            row["depth"] = strip(color_depth(surface_depth(seen)[0])[0])
            self.videos.append(self._turntable(scene))
        row |= {"turntable": self.videos[-1], **scores_of(self.module.evaluation, scene.name)}
        self.names.append(scene.name)
        self.columns = list(row)
        self.rows.append(list(row.values()))

    def _turntable(self, scene: ScoredScene) -> Path:
        module, gaussians, reference = self.module, scene.gaussians[0], scene.cameras[0]
        up = module.completesplat.up if isinstance(module, LatentDiffusion) else None
        pivot = seen_center(module.rasterizer, gaussians, reference)
        frames, _ = orbit_views(module.rasterizer, gaussians, reference, pivot, FRAMES, module.background, up)
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self.folder / f"{len(self.rows):02}.mp4"
        write_video(path, frames.float())
        return path

    def media(self) -> dict[str, Any]:
        """What is logged: `test/scenes` and `test/turntables`; nothing if no scene was tested here."""
        import wandb

        if not self.rows:
            return {}
        table = wandb.Table(self.columns, [[as_media(value) for value in row] for row in self.rows])
        videos = [wandb.Video(str(p), caption=name) for p, name in zip(self.videos, self.names, strict=True)]
        return {"test/scenes": table, "test/turntables": videos}


def as_media(value: Any) -> Any:
    """Pictures and videos as W&B's; all else as it is."""
    import wandb

    if isinstance(value, Image.Image):
        return wandb.Image(value)
    return wandb.Video(str(value)) if isinstance(value, Path) else value


def strip(images: Float[Tensor, "view 3 height width"]) -> Image.Image:
    """Views side by side, each enlarged by a whole factor to about 128 px."""
    factor = max(1, round(READABLE_SIDE / max(images.shape[-2:])))
    row = torch.cat(list(images.float().nan_to_num()), dim=-1)
    return Image.fromarray(to_bytes(enlarge(row, factor)))


def scores_of(evaluation: Evaluation, name: str) -> dict[str, float]:
    """The model's scores for a scene, and those of the best of several samples, by `region_view_metric`."""
    found: dict[str, float] = {}
    for predictor, prefix in ((MODEL, ""), (BEST, f"{BEST}/")):
        scores: Scores = evaluation.scores[predictor].get(name, {}) if predictor in evaluation.scores else {}
        found |= {prefix + "_".join(key): value for key, value in scores.items()}
    return found
