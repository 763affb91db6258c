"""What is to be measured: a run's checkpoint with its configuration, or a folder of weights and data."""

import json
from pathlib import Path
from typing import Any

from completesplat.errors import CompleteSplatError, WeightsError

# What training needed of weights from elsewhere, before its first step and for its loss.
ONLY_FOR_TRAINING = (
    "model.autoreconstructor_checkpoint",
    "model.checkpoint",
    "model.model.pretrained",
    "model.completesplat.autoreconstructor.pretrained",
    "model.completesplat.conditioning.pretrained",
    "model.loss.terms.lpips",
)


def configuration(config: Any) -> Any:
    """Model and data: of the run that `ckpt` belongs to, or of `weights` with the group `data`.

    Raises:
        WeightsError: the checkpoint, its run's configuration or the weights are missing.
        CompleteSplatError: neither is given, or both, or weights without data.
    """
    if (config.ckpt is None) == (config.get("weights") is None):
        raise CompleteSplatError("give ckpt=RUN/checkpoints/last.ckpt, or weights=DIR data=NAME data.root=DIR")
    if config.ckpt is not None:
        if config.get("data") is not None:
            raise CompleteSplatError("a checkpoint's data are its run's: change them by overrides=['data.root=DIR']")
        return config_of_run(Path(config.ckpt), list(config.overrides))
    if config.get("data") is None:
        raise CompleteSplatError("weights know no data: give data=NAME data.root=DIR")
    return _config_of_weights(config)


def open_module(config: Any, found: Any) -> Any:
    """The model of a `configuration`, with its weights, and the sampler that is asked for.

    Raises:
        WeightsError: the weights do not fit.
        CompleteSplatError: a sampler for a model that draws nothing.
    """
    from hydra.utils import instantiate
    from omegaconf import OmegaConf

    from completesplat.training.checkpoints import load_part

    module = instantiate(found.model, _convert_="all")
    if config.ckpt is not None:
        load_part(module, config.ckpt, prefix="")
    if config.get("sampler") is not None:
        diffusion_of(module).replace_sampler(OmegaConf.to_container(config.sampler))
    return module


def facts(config: Any) -> dict[str, Any]:
    """Which weights they are, for the protocol of a measurement."""
    from completesplat.commands.protocol import checkpoint_facts, weights_facts

    return checkpoint_facts(Path(config.ckpt)) if config.ckpt is not None else weights_facts(config.weights)


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
        parent, _, name = key.rpartition(".")
        if name in list(OmegaConf.select(config, parent) or ()):  # also where its value is missing
            OmegaConf.update(config, key, None)
    # The machine that trained it had to have a GPU; this one need not. Where it has one, both are the same.
    if OmegaConf.select(config, "model.rasterizer._target_") == "completesplat.rasterizers.selection.cuda":
        config.model.rasterizer._target_ = "completesplat.rasterizers.selection.auto"
    return config


def _config_of_weights(config: Any) -> Any:
    """Stage 2's module around a generator that is loaded; what it would be trained with does not matter."""
    from omegaconf import OmegaConf

    from completesplat.weights import CONFIG_FILE, weights_folder

    folder = weights_folder(config.weights)
    model = {
        "_target_": "completesplat.training.latent_diffusion.LatentDiffusion",
        "completesplat": {"_target_": "completesplat.generation.CompleteSplat.from_pretrained", "path": str(folder)},
        "rasterizer": config.rasterizer,
        "optimizer": {"_target_": "torch.optim.Adam", "_partial_": True},
        "schedule": {"_target_": "completesplat.training.schedules.constant", "_partial_": True},
    }
    found = OmegaConf.create({"seed": config.seed, "data": config.data, "model": model})
    found.data.image_size = json.loads((folder / CONFIG_FILE).read_text())["image_size"]
    return found
