"""The results of a test, for the loggers of a run."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lightning import Trainer
from lightning.pytorch.loggers import Logger
from omegaconf import OmegaConf

from completesplat.metrics.evaluation import REGIONS
from completesplat.reports.comparison.building import tables
from completesplat.reports.comparison.cells import Table
from completesplat.reports.dashboard.scenes import SceneTable
from completesplat.training.scene_module import SceneModule
from completesplat.training.wandb_run import wandb_runs


def begin(module: SceneModule, trainer: Trainer, config: Any, out: Path) -> SceneTable | None:
    """If W&B is among the loggers, begin its run, and collect what it is to show of the scenes of a test."""
    runs = wandb_runs(trainer.loggers)
    if not runs or not trainer.is_global_zero:
        return None
    for run in runs:
        run.log_hyperparams(OmegaConf.to_container(config, resolve=True))
    table = SceneTable(module, out / "turntables", max(run.scenes for run in runs))
    module.on_scene_scored = table.add
    return table


def log_test(results: dict[str, Any], scenes: SceneTable | None, trainer: Trainer, out: Path) -> None:
    """Log `test/PREDICTOR/REGION_VIEW_METRIC`; for W&B also tables, pictures and videos.

    Args:
        results: of `SceneModule.test_results`.
        scenes: of `begin`.
        out: the run directory, with the results in its `metrics.json`.
    """
    flat = {predictor: by_name(scores) for predictor, scores in results.items()}
    numbers = {f"test/{predictor}/{name}": x for predictor, scores in flat.items() for name, x in scores.items()}
    for logger in trainer.loggers:
        logger.log_metrics(numbers, step=trainer.global_step)
        logger.save()
    runs = wandb_runs(trainer.loggers)
    if not runs:
        return
    media = {} if scenes is None else scenes.media()
    media |= {"test/predictors": predictor_table(flat)}
    media |= {f"report/{table.name}": as_wandb(table) for table in tables(out)[0] if holds_ours(table)}
    for run in runs:
        run.log_metrics(media, step=trainer.global_step)


def log_modes(results: Mapping[str, Mapping[str, float]], figure: Path, config: Any, loggers: Sequence[Logger]) -> None:
    """Log `hidden_modes/METHOD/FIGURE`; for W&B also the picture."""
    numbers = {f"hidden_modes/{method}/{name}": x for method, found in results.items() for name, x in found.items()}
    for logger in loggers:
        logger.log_metrics(numbers, step=0)
        logger.save()
    for run in wandb_runs(loggers):
        import wandb

        run.log_hyperparams(OmegaConf.to_container(config, resolve=True))
        run.log_metrics({"hidden_modes": wandb.Image(str(figure))}, step=0)


def by_name(scores: dict[str, Any]) -> dict[str, float]:
    """A predictor's results by `region_view_metric`."""
    return {
        f"{region}_{view}_{metric}": value
        for region in REGIONS
        for view, metrics in scores[region].items()
        for metric, value in metrics.items()
    }


def predictor_table(flat: dict[str, dict[str, float]]) -> Any:
    """A row for each predictor; what was not measured for one stays empty."""
    import wandb

    columns = list(dict.fromkeys(name for scores in flat.values() for name in scores))
    rows = [[predictor, *(scores.get(name) for name in columns)] for predictor, scores in flat.items()]
    return wandb.Table(columns=["predictor", *columns], data=rows)


def holds_ours(table: Table) -> bool:
    """Whether there is more in it than what is published."""
    return any(row.source == "ours" for row in table.rows)


def as_wandb(table: Table) -> Any:
    """A table of a report with its texts, and in its last rows what stands below it."""
    import wandb

    columns: list[str | int] = [
        ": ".join(part for part in (heading.group, heading.text) if part) for heading in table.headings
    ]
    rows = [[cell.text for cell in row.cells] for row in table.rows]
    return wandb.Table(columns, [*rows, *([line] + [""] * (len(columns) - 1) for line in table.below())])
