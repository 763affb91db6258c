"""`completesplat test`: score a checkpoint; which file that is, and the configuration that it was trained with."""

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
    """Measure what the chosen protocol says (`conf/evaluation/`)."""
    from hydra.utils import get_method

    get_method(config.evaluation.task)(config, out)


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
