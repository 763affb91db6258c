"""`completesplat fit`: train one stage, then score it."""

import copy
import logging
import math
from pathlib import Path
from typing import Any

from hydra.utils import instantiate as build
from lightning import seed_everything
from lightning.pytorch.callbacks import WeightAveraging
from omegaconf import OmegaConf
from torch import nn

from completesplat.baselines.splatter_image.files import write_trained
from completesplat.baselines.splatter_image.model import PublishedSplatterImage
from completesplat.commands import quieten
from completesplat.commands.evaluate import scored_data, set_scoring
from completesplat.commands.jobs import LAST, METRICS
from completesplat.commands.protocol import checkpoint_facts, protocol, write_json
from completesplat.data.loading.distributed import batch_per_process
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.generator import OneAnswer
from completesplat.opening import without_training
from completesplat.results.tables import Table, evaluation_table, show, table
from completesplat.results.wandb import begin, log_shown
from completesplat.settings.checks import check_image_size, check_optimizer, check_verb
from completesplat.training.checkpoints import newest_whole
from completesplat.training.latent_diffusion import LatentDiffusion
from completesplat.training.loggers import finished
from completesplat.training.reconstruction import ReconstructionModule
from completesplat.training.stopping import stopped_together
from completesplat.weights import RUN_WEIGHTS
from completesplat.weights.checkpoint_reading import check_whole

logger = logging.getLogger(__name__)

OTHER_WEIGHTS = {"pretrained", "checkpoint", "autoreconstructor_checkpoint"}  # settings of weights to start from
EXAMPLES = {
    "root": "DIR",
    "pretrained": "CompVis/stable-diffusion-v1-4, or null for random weights",
    "checkpoint": "RUN/checkpoints/last.ckpt",
    "autoreconstructor_checkpoint": "RUN/checkpoints/last.ckpt of stage 1",
}
"""Examples of settings that may be missing."""
COLUMNS = [("part", "part", ""), ("parameters, millions", "millions", ".2f"), ("of these trained", "trained", ".2f")]


def parameter_table(module: nn.Module) -> Table:
    """A line for each network of a module, and for each part of a network with several, if it has parameters."""
    rows = []
    for name, child in module.named_children():
        parts = [(f"  {part}", grandchild) for part, grandchild in child.named_children()]
        for label, network in [(name, child), *(parts if len(parts) > 1 else [])]:
            sizes = [(parameter.numel(), parameter.requires_grad) for parameter in network.parameters()]
            if sizes:
                millions, trained = sum(n for n, _ in sizes) / 1e6, sum(n for n, learns in sizes if learns) / 1e6
                rows.append({"part": label, "millions": millions, "trained": trained})
    return table("Model", COLUMNS, rows)


def instantiate(config: Any) -> tuple[Any, Any]:
    """Return the LightningDataModule and the LightningModule of a config that `completesplat.compose` returned.

    They are what `completesplat fit` trains. Checkpoints of the model hold its config, which `load_from_checkpoint`
    reads.

    Raises:
        CompleteSplatError: a setting is missing, or does not fit.
        WeightsError: weights to start from cannot be used.
    """
    refuse_missing(config)
    check_verb("fit", config)
    check_image_size(config)
    check_optimizer(config.optimizer)
    data, module = build(config.data, _convert_="all"), build(config.model, _convert_="all")
    check_published_size(module, config)
    if config.test:
        set_scoring(module, config.evaluation)
    model: Any = OmegaConf.create({"model": OmegaConf.to_container(config.model, resolve=True)})
    module.config = OmegaConf.to_container(without_training(model))
    return data, module


@stopped_together()
def run(config: Any, out: Path) -> None:
    """Leave `metrics.csv`, checkpoints and, when all is done, `metrics.json` in the run directory."""
    quieten()
    checkpoint = checkpoint_to_continue(config, out)
    seed_everything(config.seed, verbose=False)
    data, module = instantiate(config)
    # What cannot be scored is refused now, not after the training.
    tested = scored_data(copy.deepcopy(config), config.evaluation) if config.test else None
    callbacks, loggers = _parts(config.callbacks), _parts(config.logger)
    trainer = build(config.trainer, callbacks=callbacks, logger=loggers, _convert_="all")
    share = batch_per_process(data.batch_size, trainer.world_size, trainer.accumulate_grad_batches)
    if trainer.is_global_zero:
        show(parameter_table(module))
        logger.info("batch: %d scenes a step, data.batch_per_process=%d", data.batch_size, share)
    with finished(loggers):
        shown = begin(module, trainer, config, out)
        metrics = _train(trainer, module, data, checkpoint)
        if trainer.is_global_zero:
            export_weights(config, module, data, out / RUN_WEIGHTS)
        if tested is not None:
            metrics |= _test(config, module, tested)
        for one in loggers:  # a run shorter than the logging interval leaves its figures too
            one.log_metrics(metrics, step=trainer.global_step)
            one.save()
        scores = module.test_results() if tested is not None else None
        if not trainer.is_global_zero:
            return
        results = {"steps": trainer.global_step, "epochs": _epochs(trainer), "data.batch_per_process": share}
        results |= metrics
        if scores is not None:
            show(evaluation_table(scores))
            described = protocol(config.evaluation, module, tested, scores, out) | _facts(trainer, out)
            results |= {"upper_bound": module.upper_bound, "test": {"protocol": described} | scores}
        write_json(out / METRICS, results)  # the last file, because it means that the job is done
        if scores is not None:
            log_shown(scores, shown, trainer, out)


def _parts(config: Any) -> list[Any]:
    """Callbacks or loggers: those that are not null."""
    return [part for part in build(config, _convert_="all").values() if part is not None]


def checkpoint_to_continue(config: Any, out: Path) -> str | None:
    """The checkpoint that the run starts from, if any; `WeightsError` if one that is named is missing or damaged.

    The other weights that the configuration names are not needed then.
    """
    last = config.ckpt_path == "last"
    path = newest_whole(out / LAST) if last else None if config.ckpt_path is None else Path(config.ckpt_path)
    if path is None:
        return None
    if not path.is_file():
        raise WeightsError(f"{path}: no such checkpoint")
    if not last:
        check_whole(path)
    for part in (config.autoreconstructor, config.conditioning, config.model):
        for key in OTHER_WEIGHTS & part.keys():
            part[key] = None
    return str(path)


def refuse_missing(config: Any) -> None:
    """`CompleteSplatError` for a setting that data or model need and that is not given; it shows what to give."""
    for part in (config.data, config.model):
        for key in sorted(OmegaConf.missing_keys(part)):
            example = EXAMPLES.get(key.rpartition(".")[2], "VALUE")
            raise CompleteSplatError(f"{key} is needed: give {key}={example}")


def check_published_size(module: Any, config: Any) -> None:
    """`CompleteSplatError`: published weights know pictures of another size than the data have."""
    network = getattr(module, "model", None)
    if isinstance(network, PublishedSplatterImage) and config.data.image_size != network.image_size:
        said = f"{network.file.name} wants {network.image_size}"
        raise CompleteSplatError(f"data.image_size={config.data.image_size}: {said}")


def export_weights(config: Any, module: Any, data: Any, folder: Path) -> None:
    """Write what `predict` and `from_pretrained` read: of either stage, and of Splatter Image, the published one too.

    A network that weights may not name is left out, with a warning.
    """
    if isinstance(module, LatentDiffusion):
        module.completesplat.architecture["training"] = data.training_facts()
        return module.completesplat.save_pretrained(folder)
    if type(module) is not ReconstructionModule:
        return None
    if isinstance(module.model, PublishedSplatterImage):
        return write_trained(folder, module.model.file, module.model.state_dict())
    architecture: Any = {"network": OmegaConf.to_container(config.model.model), "image_size": config.data.image_size}
    try:
        model = OneAnswer.with_trained(architecture, module.model.state_dict(), module.camera)
    except WeightsError as error:
        return logger.warning("no weights are written to %s: %s", folder, error)
    model.architecture["training"] = data.training_facts()
    return model.save_pretrained(folder)


def _train(trainer: Any, module: Any, data: Any, checkpoint: str | None) -> dict[str, float]:
    """Everything that was logged, in the end; a model that has nothing to learn beforehand is not trained."""
    if not any(parameter.requires_grad for parameter in module.parameters()):
        return {}
    trainer.fit(module, datamodule=data, ckpt_path=checkpoint, weights_only=True)
    return {name: value.item() for name, value in trainer.callback_metrics.items()}


def _epochs(trainer: Any) -> int:
    """How many were begun. (`current_epoch` counts the last one in the process alone that came to its end.)"""
    if not trainer.global_step:
        return 0
    steps_of_one = math.ceil(trainer.num_training_batches / trainer.accumulate_grad_batches)
    return int(-(-trainer.global_step // steps_of_one))


def _test(config: Any, module: Any, data: Any) -> dict[str, float]:
    """Score as `completesplat test` does, in the protocol's precision; everything that was logged."""
    progress = build(config.callbacks.progress, _convert_="all")
    settings = {"callbacks": [] if progress is None else [progress], "logger": False, "enable_checkpointing": False}
    trainer = build(config.trainer, precision=config.evaluation.precision, **settings, _convert_="all")
    trainer.test(module, datamodule=data, verbose=False)
    return {name: value.item() for name, value in trainer.callback_metrics.items()}


def _facts(trainer: Any, out: Path) -> dict[str, Any]:
    """Facts of the weights that were scored: those of the last checkpoint, if any was written."""
    facts = checkpoint_facts(out / LAST) if (out / LAST).is_file() else {}
    if facts.get("checkpoint", {}).get("step") == trainer.global_step:
        return facts
    return {"checkpoint": None, "ema": any(isinstance(callback, WeightAveraging) for callback in trainer.callbacks)}
