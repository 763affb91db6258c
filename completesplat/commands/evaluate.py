"""`completesplat test`: score a trained model's images against true ones, and its samples against hidden modes."""

import logging
import re
import shlex
from functools import partial
from pathlib import Path
from typing import Any, Unpack

import torch
from hydra.utils import instantiate
from lightning import Trainer, seed_everything
from lightning.pytorch.loggers import Logger
from omegaconf import OmegaConf
from rich.console import Console
from rich.progress import track

from completesplat.commands import quieten
from completesplat.commands.trained import GivenScenes, RunCheckpoint, trained_model
from completesplat.evaluation.board_results import board_result, prepare_for_board, write_for_board, write_result
from completesplat.evaluation.mode_benchmark import (
    HiddenModesEvaluation,
    describe_mode_test,
    score_hidden_modes,
    write_modes,
)
from completesplat.evaluation.mode_tables import mode_results_table
from completesplat.evaluation.protocol import Config, describe_test, scored_data, set_metrics, tested_names
from completesplat.evaluation.records import CONFIG, MODEL, PROTOCOL, SCORES, read_record
from completesplat.evaluation.score_tables import evaluation_table
from completesplat.evaluation.table_writers import show
from completesplat.files import write_json
from completesplat.settings.schema import EvaluationSettings, TestSettings
from completesplat.training.loggers import wandb_runs
from completesplat.training.stopping import stopped_together
from completesplat.wording import counted, printable

log = logging.getLogger(__name__)
METRIC = re.compile(r"\+*evaluation\.metrics\.(\w+)")


def built_parts(group: Config | None) -> list[Any]:
    """Build the parts of a config group, without those that are null.

    Where a group is left out (`callbacks=null`), an experiment may still set an option of one of its parts. A warning
    names it.
    """
    parts = []
    for name, part in (group or {}).items():
        if part is not None and "_target_" not in part:
            log.warning("%s: no _target_, left out", name)
        elif part is not None:
            parts.append(instantiate(part, _convert_="all"))
    return parts


@stopped_together()
def run(
    evaluation: EvaluationSettings,
    trainer: Config,
    out: Path,
    logger: Config | None = None,
    **trained: Unpack[TestSettings],
) -> None:
    """Write `metrics.json` and print the table.

    Args:
        evaluation, trainer, logger: configs of the protocol, the trainer (without precision), loggers by name.
    """
    tested = trained_model(**trained)
    run_config = tested.configuration()
    if isinstance(tested, GivenScenes) and evaluation["resolution"] is not None:
        run_config.data.image_size = evaluation["resolution"]  # files are rendered at any size
    quieten()
    seed_everything(tested.seed, verbose=False)
    data = scored_data(run_config, evaluation)
    module = tested.open_module(run_config)
    set_metrics(module, evaluation)
    prepare_for_board(module, evaluation)
    loggers = built_parts(logger)
    tester: Trainer = instantiate(trainer, precision=evaluation["precision"], logger=loggers, _convert_="all")
    with wandb_runs(loggers, OmegaConf.load(out / CONFIG), out):
        tester.test(module, datamodule=data, verbose=False)
        scores = module.test_results()
        if not tester.is_global_zero:
            return
        described = describe_test(evaluation, module, data, scores, out) | tested.facts()
        results = {PROTOCOL: described, **scores}
        write_json(out / SCORES, results)
        write_for_board(module, evaluation, described, tested.label, out)
    label = module.method if isinstance(tested, GivenScenes) else MODEL
    show(evaluation_table(results, label), width=160)
    for name, reason in described["missing"].items():
        print(f"{name}: {reason}")
    left_out = metrics_left_out(tested.checkpoint if isinstance(tested, RunCheckpoint) else None, evaluation)
    if left_out:
        print(f"metrics of the run are left out; give them again: {shlex.join(left_out)}")


def metrics_left_out(checkpoint: Path | None, evaluation: Config) -> list[str]:
    """Return the overrides by which a checkpoint's run was given metrics that the evaluation lacks."""
    if checkpoint is None:
        return []
    overrides = []
    for override in map(printable, read_record(checkpoint.absolute().parents[1]).get("overrides", [])):
        named = METRIC.match(override)
        if named is not None and named[1] not in evaluation["metrics"]:
            overrides.append(override)
    return overrides


def run_hidden_modes(
    evaluation: HiddenModesEvaluation,
    trainer: Config,
    out: Path,
    logger: Config | None = None,
    **trained: Unpack[TestSettings],
) -> None:
    """Write JSON files of hidden modes, shares and protocol, draw `hidden_modes.png`, and print the table.

    Args:
        trainer: only its `accelerator` has an effect; "cpu" leaves a GPU alone.
    """
    tested = trained_model(**trained)
    quieten()
    module, data = tested.open()
    data.tested_names = tested_names(evaluation)
    data.prepare_data()
    data.setup("test")
    use_gpu = trainer["accelerator"] != "cpu" and torch.cuda.is_available()
    module.to("cuda" if use_gpu else "cpu").eval()
    progress = partial(track, description="Hidden modes", console=Console(stderr=True))
    measured = score_hidden_modes(module, data, evaluation, progress)
    write_modes(measured, evaluation["samples"], out)
    described = describe_mode_test(evaluation, module, data, measured, out) | tested.facts()
    write_json(out / "protocol.json", described)
    if evaluation["board"] is not None:
        result = board_result(evaluation, described, measured.by_scene(), tested.label)
        write_result(result, out)
    results = measured.results(evaluation["samples"])
    scores = {f"hidden_modes/{method}/{name}": x for method, values in results.items() for name, x in values.items()}
    loggers: list[Logger] = built_parts(logger)
    with wandb_runs(loggers, OmegaConf.load(out / CONFIG), out):
        for each in loggers:
            each.log_metrics(scores, step=0)
            each.save()
    label = module.method if isinstance(tested, GivenScenes) else MODEL
    show(mode_results_table(results, label), width=140)
    if measured.skipped:
        print(f"{counted(len(measured.skipped), 'scene')} skipped; the first: {measured.skipped[0]}")
