"""`completesplat test`: score a checkpoint beside two naive predictors."""

import json
from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError, WeightsError

# What training needed of weights from elsewhere, before its first step and for its loss.
ONLY_FOR_TRAINING = (
    "model.autoreconstructor_checkpoint",
    "model.checkpoint",
    "model.model.pretrained",
    "model.completesplat.conditioning.pretrained",
    "model.loss.terms.lpips",
)


def run(config: Any, out: Path) -> None:
    """Write `metrics.json` and print the table."""
    from hydra.utils import instantiate
    from lightning import seed_everything
    from omegaconf import OmegaConf

    from completesplat.commands import quieten
    from completesplat.reports.evaluation_table import evaluation_table, show
    from completesplat.training.checkpoints import load_part

    run_config = config_of_run(Path(config.ckpt), list(config.overrides))
    quieten()
    seed_everything(config.seed, verbose=False)
    data = instantiate(run_config.data, _convert_="all")
    module = instantiate(run_config.model, _convert_="all")
    load_part(module, config.ckpt, prefix="")
    if config.get("sampler") is not None:
        diffusion_of(module).replace_sampler(OmegaConf.to_container(config.sampler))
    trainer = instantiate(config.trainer, logger=False, _convert_="all")
    trainer.test(module, datamodule=data, verbose=False)
    results = module.evaluation.results()
    (out / "metrics.json").write_text(json.dumps(results, indent=2, allow_nan=False) + "\n")
    show(evaluation_table(results))


def diffusion_of(module: Any) -> Any:
    """The generator of a latent diffusion model.

    Raises:
        CompleteSplatError: the model is another one.
    """
    from completesplat.training.latent_diffusion import LatentDiffusion

    if not isinstance(module, LatentDiffusion):
        raise CompleteSplatError("this checkpoint is of a model that draws no samples; a diffusion model is needed")
    return module.completesplat


def config_of_run(checkpoint: Path, overrides: list[str]) -> Any:
    """The configuration saved beside a checkpoint's folder, with changes.

    Raises:
        WeightsError: the checkpoint or its run's configuration is missing.
    """
    from omegaconf import OmegaConf

    path = checkpoint.parent.parent / "config.yaml"
    if not checkpoint.is_file():
        raise WeightsError(f"{checkpoint}: no such checkpoint")
    if not path.is_file():
        raise WeightsError(f"{checkpoint}: the run's configuration {path} is missing")
    config = OmegaConf.merge(OmegaConf.load(path), OmegaConf.from_dotlist(overrides))
    # The weights come from this checkpoint.
    for key in ONLY_FOR_TRAINING:
        if OmegaConf.select(config, key) is not None:
            OmegaConf.update(config, key, None)
    return config
