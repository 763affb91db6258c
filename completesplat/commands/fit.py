"""`completesplat fit`: train one stage, then score it."""

import copy
import logging
from pathlib import Path
from typing import Any

import hydra.utils
from lightning import Trainer, seed_everything
from lightning.fabric.utilities.exceptions import MisconfigurationException
from lightning.pytorch.callbacks import Checkpoint, WeightAveraging
from lightning.pytorch.utilities.model_summary.model_summary import ModelSummary
from omegaconf import DictConfig, OmegaConf

from completesplat.commands import quieten
from completesplat.commands.earlier_stage import take_architecture
from completesplat.commands.evaluate import built_parts
from completesplat.data.loading.data_module import SceneDataModule
from completesplat.data.loading.distributed import batch_per_process
from completesplat.errors import CompleteSplatError, DivergenceError, WeightsError, own_errors
from completesplat.evaluation.board_results import prepare_for_board, write_for_board
from completesplat.evaluation.protocol import describe_test, scored_data, set_metrics
from completesplat.evaluation.provenance import checkpoint_facts
from completesplat.evaluation.records import SCORES, read_record
from completesplat.evaluation.score_tables import evaluation_table
from completesplat.evaluation.scorer import Scorer
from completesplat.evaluation.table_writers import show
from completesplat.files import write_json
from completesplat.settings import checks
from completesplat.training.checkpoints import newest_whole
from completesplat.training.loggers import WandbRun, wandb_runs
from completesplat.training.stage import Stage
from completesplat.training.stopping import stopped_together
from completesplat.weights import RUN_CHECKPOINT, RUN_WEIGHTS
from completesplat.weights.checkpoint_reading import check_whole, not_finite
from completesplat.wording import counted

logger = logging.getLogger(__name__)


def instantiate(config: DictConfig) -> tuple[SceneDataModule, Scorer]:
    """Return the LightningDataModule and the LightningModule of a config that `completesplat.compose` returned.

    They are what `completesplat fit` trains. Checkpoints of the model hold its config, which `load_from_checkpoint`
    reads. Stage 2 takes the architecture of its stage 1 (`take_architecture`); the config itself stays as it is.

    Raises:
        CompleteSplatError: a setting is missing, or does not fit.
        WeightsError: weights to start from cannot be used.
    """
    config = copy.deepcopy(config)
    refuse_missing(config)
    take_architecture(config)
    checks.check_values("fit", config)
    checks.check_parts(config)
    checks.check_image_size(config)
    checks.check_optimizer(config.optimizer)
    with own_errors():
        data = hydra.utils.instantiate(config.data, _convert_="all")
        module = hydra.utils.instantiate(config.model, _convert_="all")
        if config.test:
            set_metrics(module, config.evaluation)
    if isinstance(module, Stage):
        module.keep_config(config.model)
    return data, module


@stopped_together()
def run(config: DictConfig, out: Path) -> None:
    """Train and test.

    Write `metrics.csv`, checkpoints and at the end `metrics.json` into the run directory.
    """
    quieten()
    checkpoint = checkpoint_to_continue(config, out)
    refuse_without_effect(config, out)
    seed_everything(config.seed, verbose=False)
    data, module = instantiate(config)
    # A test that cannot work is refused now, not after the training.
    tested = scored_data(copy.deepcopy(config), config.evaluation) if config.test else None
    callbacks = built_parts(config.get("callbacks"))
    loggers = built_parts(config.get("logger"))
    parts = {"callbacks": callbacks, "logger": loggers}
    keeps = any(isinstance(callback, Checkpoint) for callback in callbacks)  # else Lightning would add one of its own
    trainer: Trainer = hydra.utils.instantiate(config.trainer, **parts, enable_checkpointing=keeps, _convert_="all")
    share = batch_per_process(data.batch_size, trainer.world_size, trainer.accumulate_grad_batches)
    if tested is not None:
        tested.check_test()
    if trainer.is_global_zero:
        _print_layers(module)
        logger.info("batch: %s a step, data.batch_per_process=%d", counted(data.batch_size, "scene"), share)
    metrics = {}
    with wandb_runs(loggers, config, out):
        if isinstance(module, Stage):
            metrics.update(_train(trainer, module, data, checkpoint, out))
        if tested is not None:
            metrics.update(_test(config, module, tested))
        for run_logger in loggers:  # a run shorter than the logging interval has its figures too
            run_logger.log_metrics(metrics, step=trainer.global_step)
            run_logger.save()
            if isinstance(run_logger, WandbRun) and isinstance(module, Stage):
                run_logger.log_weights(out / RUN_WEIGHTS, metrics)
        # Every process calls this, because per-scene fits gather their empty pixels in it.
        scores = module.test_results() if tested is not None else None
        if not trainer.is_global_zero:
            return
        results: dict[str, object] = {"steps": trainer.global_step, "data.batch_per_process": share, **metrics}
        if tested is not None and scores is not None:
            evaluation: Any = OmegaConf.to_container(config.evaluation, resolve=True)
            described = describe_test(evaluation, module, tested, scores, out) | _facts(trainer, out)
            test = {"protocol": described, **scores}
            results["upper_bound"] = module.upper_bound
            results["test"] = test
            show(evaluation_table(test), width=160)
            write_for_board(module, evaluation, described, None, out)
        write_json(out / SCORES, results)  # the last file, because it means that the job is done


def _print_layers(module: Scorer) -> None:
    """Print the parts of a module with their sizes."""
    for row in str(ModelSummary(module, max_depth=2)).splitlines():
        # The last column and line count floating-point operations, which are 0 before the first step.
        if not row.endswith("Total Flops"):
            print(row.rpartition("|")[0] or row)


def _train(trainer: Trainer, module: Stage, data: SceneDataModule, resumed: str | None, out: Path) -> dict[str, float]:
    """Train, save the weights, and return all logged figures.

    Raises:
        WeightsError: the checkpoint to continue from is of another model.
        CompleteSplatError: Lightning refuses a setting of its trainer.
        DivergenceError: the weights are not finite.
    """
    try:
        trainer.fit(module, datamodule=data, ckpt_path=resumed, weights_only=True)
    except MisconfigurationException as error:
        raise CompleteSplatError(f"trainer: {error}") from error
    except RuntimeError as error:
        if resumed is None or "loading state_dict" not in str(error):
            raise
        raise WeightsError(f"{resumed}: of another model; give the settings of its run") from error
    metrics = _logged(trainer)
    name = not_finite(module.state_dict())
    if name is not None:  # of the average, or where `callbacks.bad_steps` is off
        raise DivergenceError(f"{name} is not finite, so no weights are written; lower optimizer.lr")
    if trainer.is_global_zero:
        module.save_weights(out / RUN_WEIGHTS)
    return metrics


def checkpoint_to_continue(config: DictConfig, out: Path) -> str | None:
    """Return the checkpoint that the run continues from, if any, and remove other weights from the config."""
    if config.ckpt_path is None:
        return None
    if config.ckpt_path == "last":
        newest = newest_whole(out / RUN_CHECKPOINT)
        if newest is None:
            logger.info("ckpt_path=last: there is no checkpoint in %s, so the training begins", out)
            return None
        path = Path(newest)
    else:
        path = Path(config.ckpt_path)
    if path.is_dir():
        path = path / RUN_CHECKPOINT
    if not path.is_file():
        raise WeightsError(f"{path}: no such checkpoint")
    check_whole(path)  # now, because data may be made first
    checks.remove_start_weights(config.model)
    return str(path)


def refuse_without_effect(config: DictConfig, out: Path) -> None:
    """Raise CompleteSplatError for a setting that the user gives to a single run, but that its model does not use.

    The settings of a sweep are not refused, because they may be meant for another of its models.
    """
    stage = hydra.utils.get_class(config.model._target_)
    record = read_record(out)
    unused: tuple[str, ...] = getattr(stage, "unused_settings", ())
    if record.get("sweep") is not None:
        return
    # A model that does not use the end of the training (`trainer.max_steps` and others) does not train.
    if "trainer.max_" in unused and not config.test:
        raise CompleteSplatError(f"test=false: {stage.__name__} only fits the scenes of a test; leave it out")
    for setting in record.get("overrides", []):
        if setting.lstrip("+~").startswith(unused):
            raise CompleteSplatError(f"{setting}: {stage.__name__} does nothing with it; leave it out")


def refuse_missing(config: DictConfig) -> None:
    """Raise CompleteSplatError, with an example, for a setting of data or model that is missing or an empty text."""
    examples = {"root": "DIR", **checks.START_WEIGHTS}
    missing = sorted(OmegaConf.missing_keys(config.data)) + sorted(OmegaConf.missing_keys(config.model))
    for key in sorted(examples):
        if config.model.get(key) == "":
            missing.append(f"model.{key}")
    if missing:
        example = examples.get(missing[0].rpartition(".")[2], "VALUE")
        raise CompleteSplatError(f"{missing[0]} is needed: give {missing[0]}={example}")


def _logged(trainer: Trainer) -> dict[str, float]:
    return {name: value.item() for name, value in trainer.callback_metrics.items()}


def _test(config: DictConfig, module: Scorer, data: SceneDataModule) -> dict[str, float]:
    """Score as `completesplat test` does, in the protocol's precision, and return all logged figures."""
    progress = hydra.utils.instantiate(OmegaConf.select(config, "callbacks.progress"), _convert_="all")
    trainer = hydra.utils.instantiate(
        config.trainer,
        precision=config.evaluation.precision,
        callbacks=[] if progress is None else [progress],
        logger=False,
        enable_checkpointing=False,
        _convert_="all",
    )
    prepare_for_board(module, config.evaluation)
    trainer.test(module, datamodule=data, verbose=False)
    return _logged(trainer)


def _facts(trainer: Trainer, out: Path) -> dict[str, Any]:
    """Return facts of the scored weights: those of the last checkpoint, if one was written."""
    facts = checkpoint_facts(out / RUN_CHECKPOINT) if (out / RUN_CHECKPOINT).is_file() else {}
    if facts.get("checkpoint", {}).get("step") == trainer.global_step:
        return facts
    callbacks: list[object] = trainer.callbacks  # type: ignore[attr-defined]
    return {"checkpoint": None, "ema": any(isinstance(callback, WeightAveraging) for callback in callbacks)}
