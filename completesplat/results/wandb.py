"""Weights & Biases: one run for each directory, and the results of tests in it: figures, tables, scenes."""

import logging
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

import torch
from jaxtyping import Float
from lightning import Trainer
from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.pytorch.loggers import Logger, WandbLogger
from lightning.pytorch.utilities import rank_zero_only
from omegaconf import DictConfig, OmegaConf
from PIL import Image
from torch import Tensor

from completesplat.errors import CompleteSplatError
from completesplat.export.images import color_depth, image_grid, surface_depth
from completesplat.export.prediction import seen_center
from completesplat.export.video import orbit_views, write_video
from completesplat.files import make_folder, write_text
from completesplat.metrics.scoring import BEST, MODEL, Evaluation
from completesplat.results.runs import flat
from completesplat.training.sample_images import evenly_spaced
from completesplat.training.stage import ScoredScene, Stage

MODES = ("online", "offline", "disabled")
VIEWS, FRAMES = 4, 48
READABLE_SIDE = 128
START_SECONDS = 6
"""Time for a server to start a run; it delays training at most by this."""
AXIS, DATA = "trainer/global_step", "WANDB_DATA_DIR"

log = logging.getLogger(__name__)


class WandbRun(WandbLogger):
    """Logger of a directory's only W&B run. Its id is in `save_dir/wandb_id`, so a resumed run continues it.

    `mode=online` becomes `offline`, with a warning, if the server does not answer or refuses; `wandb sync` uploads the
    log later. If W&B's own process dies, training goes on without it.

    Args:
        mode: online, offline or disabled.
        group, name: by default the sweep's folder (in a sweep), and the directory's name.
        scenes: number of scenes of a test that are logged.
    """

    def __init__(
        self,
        save_dir: str,
        mode: str,
        project: str,
        group: str | None = None,
        name: str | None = None,
        job_type: str | None = None,
        scenes: int = 16,
    ) -> None:
        if mode not in MODES:
            raise CompleteSplatError(f"wandb.mode={mode}: choose one of {', '.join(MODES)}")
        self.folder = Path(save_dir).absolute()
        if group is None and (self.folder.parent / "multirun.yaml").is_file():  # Hydra's file in a sweep's folder
            group = self.folder.parent.name
        try:
            options: dict[str, Any] = {"mode": mode, "group": group, "job_type": job_type}
            super().__init__(name=name or self.folder.name, save_dir=save_dir, project=project, **options)
        except ModuleNotFoundError as error:
            raise CompleteSplatError("logger=wandb needs wandb: pip install wandb, or leave it out") from error
        self._wandb_init.pop("anonymous", None)  # W&B would warn that Lightning gives it
        self.scenes = scenes
        self.lost = False

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:
        """Return W&B's run, which begins at the first access."""
        if self._experiment is None:
            run = self._experiment = self._begin()
            run.define_metric(AXIS)
            run.define_metric("*", step_metric=AXIS, step_sync=True)
        return self._experiment

    def _begin(self) -> Any:
        import wandb

        path = self.folder / "wandb_id"
        if not (path.is_file() and path.read_text().strip()):
            write_text(path, secrets.token_hex(4) + "\n")
        settings = {"id": path.read_text().strip(), "settings": wandb.Settings(init_timeout=START_SECONDS)}
        try:
            return wandb.init(**self._wandb_init | settings)
        except wandb.Error as error:
            reason = str(error).partition("\n")[0]
            log.warning("W&B: %s; the run is kept offline, `wandb sync` uploads it later", reason)
        return wandb.init(**self._wandb_init | settings | {"mode": "offline"})

    @rank_zero_only
    def log_hyperparams(self, params: Mapping[str, Any]) -> None:  # type: ignore[override]
        """Add options to the run's config."""
        with self._dispensable():
            self.experiment.config.update(params, allow_val_change=True)

    @rank_zero_only
    def log_metrics(self, metrics: Mapping[str, Any], step: int | None = None) -> None:
        """Log numbers, or W&B's images, histograms, tables and videos."""
        with self._dispensable(), self._data_in_folder():
            self.experiment.log({**metrics, **({} if step is None else {AXIS: step})})

    @rank_zero_only
    def finish(self, exit_code: int) -> None:
        """Close the run if it has begun."""
        import wandb

        if self._experiment is None:
            return
        with self._dispensable():
            self._experiment.finish(exit_code=exit_code)
        self._experiment = None
        if self.lost:
            with suppress(ConnectionError):
                wandb.teardown()  # so that the next job of a sweep gets a new process

    @contextmanager
    def _data_in_folder(self) -> Iterator[None]:
        """Let W&B copy the media of tables to the run's folder, because they would fill the user's home."""
        previous = os.environ.get(DATA)
        os.environ[DATA] = previous or str(self.folder / "wandb")
        try:
            yield
        finally:
            if previous is None:
                del os.environ[DATA]

    @contextmanager
    def _dispensable(self) -> Iterator[None]:
        try:
            yield
        except ConnectionError as error:
            if not self.lost:
                log.warning("W&B: its process ended (%s); metrics.csv goes on without it", error)
            self.lost = True


@contextmanager
def finished(loggers: Iterable[Logger]) -> Iterator[None]:
    """Close W&B's runs in the end, so that the next job does not log to them; exit code 1 after an error."""
    exit_code = 1
    try:
        yield
        exit_code = 0
    finally:
        for logger in wandb_runs(loggers):
            logger.finish(exit_code)


def wandb_runs(loggers: Iterable[Logger]) -> list[WandbRun]:
    """Return the loggers that log to W&B."""
    return [logger for logger in loggers if isinstance(logger, WandbRun)]


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
            rendering = self.module.rasterizer(scene.gaussians[:1], scene.cameras[views][None])
            row["depth"] = strip(color_depth(surface_depth(rendering)[0])[0])
            row["turntable"] = self._turntable(scene)
        self.rows.append(row | scores_of(self.module.evaluation, scene.name))

    def _turntable(self, scene: ScoredScene) -> Path:
        module, gaussians, reference = self.module, scene.gaussians[0], scene.cameras[0]
        pivot = seen_center(module.rasterizer, gaussians, reference)
        frames, _ = orbit_views(module.rasterizer, gaussians, reference, pivot, FRAMES, module.background, module.up)
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


def as_media(value: object) -> object:
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


def begin(module: Stage, trainer: Trainer, config: DictConfig, out: Path) -> SceneTable | None:
    """Begin W&B's run and collect a test's scenes for it; return None if W&B is not among the loggers."""
    runs = wandb_runs(trainer.loggers)
    if not runs or not trainer.is_global_zero:
        return None
    for run in runs:
        run.log_hyperparams(plain(config))
    table = SceneTable(module, out / "turntables", max(run.scenes for run in runs))
    module.on_scene_scored = table.add
    return table


def log_test(results: Mapping[str, Any], scenes: SceneTable | None, trainer: Trainer) -> None:
    """Log the tables, images and videos of a test to W&B; `begin` returned `scenes`."""
    runs = wandb_runs(trainer.loggers)
    if not runs:
        return
    media = {} if scenes is None else scenes.media()
    media |= {"test/predictors": predictor_table({predictor: flat(scores) for predictor, scores in results.items()})}
    for run in runs:
        run.log_metrics(media, step=trainer.global_step)


def log_modes(
    results: Mapping[str, Mapping[str, float]], figure: Path, config: DictConfig, loggers: Sequence[Logger]
) -> None:
    """Log `hidden_modes/METHOD/SCORE`; for W&B also the figure."""
    numbers = {f"hidden_modes/{method}/{name}": x for method, values in results.items() for name, x in values.items()}
    for logger in loggers:
        logger.log_metrics(numbers, step=0)
        logger.save()
    for run in wandb_runs(loggers):
        import wandb

        run.log_hyperparams(plain(config))
        run.log_metrics({"hidden_modes": wandb.Image(str(figure))}, step=0)


def plain(config: DictConfig) -> dict[str, Any]:
    """Return a config's values."""
    return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True))


def predictor_table(flat: Mapping[str, Mapping[str, float]]) -> object:
    """Return a table with a row for each predictor; missing scores stay empty."""
    import wandb

    columns = list(dict.fromkeys(name for scores in flat.values() for name in scores))
    rows = [[predictor, *(scores.get(name) for name in columns)] for predictor, scores in flat.items()]
    return wandb.Table(columns=["predictor", *columns], data=rows)
