"""`completesplat fit`: train one stage."""

import json
from pathlib import Path
from typing import Any


def run(config: Any, out: Path) -> None:
    """Train, leaving `metrics.csv`, `metrics.json` and checkpoints in the run directory."""
    from hydra.utils import instantiate
    from lightning import seed_everything

    from completesplat.commands import quieten

    quieten()
    if config.resume is not None:  # the weights come from there
        config.autoreconstructor.pretrained = None
        if "checkpoint" in config.model:
            config.model.checkpoint = None
    seed_everything(config.seed, verbose=False)
    data = instantiate(config.data, _convert_="all")
    module = instantiate(config.model, _convert_="all")
    callbacks = [c for c in instantiate(config.callbacks, _convert_="all").values() if c is not None]
    loggers = [x for x in instantiate(config.logger, _convert_="all").values() if x is not None]
    trainer = instantiate(config.trainer, callbacks=callbacks, logger=loggers, _convert_="all")
    try:
        trainer.fit(module, datamodule=data, ckpt_path=config.resume, weights_only=True)
        if trainer.interrupted:
            raise KeyboardInterrupt
        metrics = {name: value.item() for name, value in trainer.callback_metrics.items()}
        for logger in loggers:  # a run shorter than the logging interval leaves its figures too
            logger.log_metrics(metrics, step=trainer.global_step)
            logger.save()
    finally:
        _finish(loggers)
    summary = {"steps": trainer.global_step, "epochs": trainer.current_epoch, **metrics}
    (out / "metrics.json").write_text(json.dumps(summary, indent=2) + "\n")


def _finish(loggers: list[Any]) -> None:
    """Close what outlives a job: a sweep's next job must not log into this one's W&B run."""
    from lightning.pytorch.loggers import WandbLogger

    for logger in loggers:
        if isinstance(logger, WandbLogger):
            logger.experiment.finish()
