"""Results of a test on Weights & Biases: figures, tables, and the scenes that were tested."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from lightning import Trainer
from lightning.pytorch.loggers import Logger
from omegaconf import OmegaConf
from PIL import Image
from torch import Tensor

from completesplat.export.images import color_depth, image_grid, surface_depth
from completesplat.export.prediction import seen_center
from completesplat.export.video import orbit_views, write_video
from completesplat.files import make_folder
from completesplat.metrics.scoring import BEST, MODEL, Evaluation
from completesplat.results.paper_figures import tables
from completesplat.results.runs import find, flat
from completesplat.results.tables import Table
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.loggers import wandb_runs
from completesplat.training.sample_images import evenly_spaced
from completesplat.training.stage import ScoredScene, Stage

VIEWS, FRAMES = 4, 48
READABLE_SIDE = 128


class SceneTable:
    """Rows of the first `most` scenes that a test scores in this process and passes to `add`.

    Images are strips of views: the reference, then evenly spread targets. Depth and turntable show the first sample;
    the turntables are also written to `folder/00.mp4` and so on.
    """

    def __init__(self, module: Stage, folder: Path, most: int) -> None:
        self.module, self.folder, self.most = module, folder, most
        self.rows: list[dict[str, Any]] = []

    @torch.no_grad()
    def add(self, scene: ScoredScene) -> None:
        """Keep images, video and scores of a scene, up to `most` scenes."""
        if len(self.rows) >= self.most:
            return
        row: dict[str, Any] = {"scene": scene.name, "input": strip(scene.input[None])}
        views = [0, *(1 + place for place in evenly_spaced(len(scene.truth.images) - 1, VIEWS - 1))]
        row["truth"] = strip(scene.truth.images[views])
        row |= {f"sample {n}": strip(images[views]) for n, images in enumerate(scene.images, 1)}
        with torch.autocast(self.module.device.type, enabled=False):
            seen = self.module.rasterizer(scene.gaussians[:1], scene.cameras[views][None])
            row["depth"] = strip(color_depth(surface_depth(seen)[0])[0])
            row["turntable"] = self._turntable(scene)
        self.rows.append(row | scores_of(self.module.evaluation, scene.name))

    def _turntable(self, scene: ScoredScene) -> Path:
        module, gaussians, reference = self.module, scene.gaussians[0], scene.cameras[0]
        up = module.completesplat.up if isinstance(module, LatentDiffusion) else None
        pivot = seen_center(module.rasterizer, gaussians, reference)
        frames, _ = orbit_views(module.rasterizer, gaussians, reference, pivot, FRAMES, module.background, up)
        make_folder(self.folder)
        path = self.folder / f"{len(self.rows):02}.mp4"
        write_video(path, frames.float())
        return path

    def media(self) -> dict[str, Any]:
        """Return `test/scenes` and `test/turntables` for the log; nothing if no scene was tested here."""
        import wandb

        if not self.rows:
            return {}
        table = wandb.Table(list(self.rows[-1]), [[as_media(value) for value in row.values()] for row in self.rows])
        videos = [wandb.Video(str(row["turntable"]), caption=row["scene"]) for row in self.rows]
        return {"test/scenes": table, "test/turntables": videos}


def as_media(value: Any) -> Any:
    """Convert images and videos to W&B's types; leave other values as they are."""
    import wandb

    if isinstance(value, Image.Image):
        return wandb.Image(value)
    return wandb.Video(str(value)) if isinstance(value, Path) else value


def strip(images: Float[Tensor, "view 3 height width"]) -> Image.Image:
    """Join views side by side, each enlarged by a whole factor to about 128 px."""
    factor = max(1, round(READABLE_SIDE / max(images.shape[-2:])))
    return image_grid(images.float().nan_to_num(), factor=factor)


def scores_of(evaluation: Evaluation, name: str) -> dict[str, float]:
    """Return the model's scores for a scene, and those of its best sample, by `region_view_metric`."""
    model, best = (evaluation.scores.get(predictor, {}).get(name, {}) for predictor in (MODEL, BEST))
    return {"_".join(key): x for key, x in model.items()} | {f"{BEST}/{'_'.join(key)}": x for key, x in best.items()}


def begin(module: Stage, trainer: Trainer, config: Any, out: Path) -> SceneTable | None:
    """Begin W&B's run and collect a test's scenes for it; return None if W&B is not among the loggers."""
    runs = wandb_runs(trainer.loggers)
    if not runs or not trainer.is_global_zero:
        return None
    for run in runs:
        run.log_hyperparams(OmegaConf.to_container(config, resolve=True))
    table = SceneTable(module, out / "turntables", max(run.scenes for run in runs))
    module.on_scene_scored = table.add
    return table


def log_shown(results: dict[str, Any], scenes: SceneTable | None, trainer: Trainer, out: Path) -> None:
    """Log tables, images and videos of a test to W&B.

    `scenes` is what `begin` returned, `out` the run directory with the results in its `metrics.json`.
    """
    runs = wandb_runs(trainer.loggers)
    if not runs:
        return
    media = {} if scenes is None else scenes.media()
    media |= {"test/predictors": predictor_table({predictor: flat(scores) for predictor, scores in results.items()})}
    ours = [table for table in tables(find(out)) if any(row.source == "ours" for row in table.rows)]
    media |= {f"report/{table.name}": as_wandb(table) for table in ours}
    for run in runs:
        run.log_metrics(media, step=trainer.global_step)


def log_modes(results: Mapping[str, Mapping[str, float]], figure: Path, config: Any, loggers: Sequence[Logger]) -> None:
    """Log `hidden_modes/METHOD/FIGURE`; for W&B also the figure."""
    numbers = {f"hidden_modes/{method}/{name}": x for method, values in results.items() for name, x in values.items()}
    for logger in loggers:
        logger.log_metrics(numbers, step=0)
        logger.save()
    for run in wandb_runs(loggers):
        import wandb

        run.log_hyperparams(OmegaConf.to_container(config, resolve=True))
        run.log_metrics({"hidden_modes": wandb.Image(str(figure))}, step=0)


def predictor_table(flat: dict[str, dict[str, float]]) -> Any:
    """Return a table with a row for each predictor; scores that were not measured stay empty."""
    import wandb

    columns = list(dict.fromkeys(name for scores in flat.values() for name in scores))
    rows = [[predictor, *(scores.get(name) for name in columns)] for predictor, scores in flat.items()]
    return wandb.Table(columns=["predictor", *columns], data=rows)


def as_wandb(table: Table) -> Any:
    """Convert a table of a report; its last rows are the remarks and notes."""
    import wandb

    columns: list[str | int] = [heading.joined() for heading in table.headings]
    rows = [[cell.text for cell in row.cells] for row in table.rows]
    return wandb.Table(columns, [*rows, *([line] + [""] * (len(columns) - 1) for line in table.below())])
