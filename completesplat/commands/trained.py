"""Trained models: a run's checkpoint with its configuration, or a folder of weights, with data where it is measured."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import OmegaConf

from completesplat.commands.protocol import checkpoint_facts
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.weights import CONFIG_FILE, WEIGHTS_FILE, in_the_box, sha256_of, weights_folder

# What training needed of weights from elsewhere, before its first step and for its loss.
ONLY_FOR_TRAINING = (
    "model.autoreconstructor_checkpoint",
    "model.checkpoint",
    "model.model.pretrained",
    "model.completesplat.autoreconstructor.pretrained",
    "model.completesplat.conditioning.pretrained",
    "model.loss.terms.lpips",
)


@dataclass(frozen=True)
class Trained:
    """A trained model with its data: a run's checkpoint, or a folder of weights.

    `conf/test.yaml` explains the arguments; the configurations of data and rasterizer belong to `weights`.
    """

    ckpt: str | None
    overrides: Sequence[str] = ()
    weights: str | None = None
    data: Mapping[str, Any] | None = None
    rasterizer: Mapping[str, Any] | None = None
    sampler: Mapping[str, Any] | None = None
    seed: int = 0

    def configuration(self) -> Any:
        """The configuration of model and data.

        Raises:
            WeightsError: the checkpoint, its run's configuration or the weights are missing.
            CompleteSplatError: neither is given, or both, or weights without data.
        """
        if (self.ckpt is None) == (self.weights is None):
            raise CompleteSplatError("give ckpt=RUN/checkpoints/last.ckpt, or weights=DIR data=NAME data.root=DIR")
        if self.ckpt is not None and self.data is not None:
            raise CompleteSplatError("a checkpoint's data are its run's: change them by overrides=['data.root=DIR']")
        if self.ckpt is not None:
            return config_of_run(Path(self.ckpt), list(self.overrides))
        if self.data is None:
            raise CompleteSplatError("weights know no data: give data=NAME data.root=DIR")
        return self._config_of_weights(str(self.weights))

    def open(self) -> tuple[Any, Any]:
        """The model and the data module, as `open_module` and with the errors of `configuration`."""
        configuration = self.configuration()
        return self.open_module(configuration), instantiate(configuration.data, _convert_="all")

    def open_module(self, configuration: Any) -> Any:
        """The model of the configuration, with its weights and the sampler that is to draw.

        Raises:
            WeightsError: the weights do not fit.
            CompleteSplatError: a sampler for a model that draws nothing.
        """
        from completesplat.training.checkpoints import load_part

        module = instantiate(configuration.model, _convert_="all")
        if self.ckpt is not None:
            load_part(module, self.ckpt, prefix="")
        if self.sampler is not None:
            diffusion_of(module).replace_sampler(self.sampler)
        return module

    def facts(self) -> dict[str, Any]:
        """As `checkpoint_facts`; a folder of weights does not say how training ended."""
        if self.ckpt is not None:
            return checkpoint_facts(Path(self.ckpt))
        digest = sha256_of(weights_folder(str(self.weights)) / WEIGHTS_FILE)
        return {"checkpoint": {"path": str(self.weights), "sha256": digest, "step": None}, "ema": None}

    def _config_of_weights(self, weights: str) -> Any:
        """Stage 2's module around a generator that is loaded; what it would be trained with does not matter."""
        folder = weights_folder(weights)
        model = {
            "_target_": "completesplat.training.latent_diffusion.LatentDiffusion",
            "completesplat": {
                "_target_": "completesplat.generation.CompleteSplat.from_pretrained",
                "path": str(folder),
            },
            "rasterizer": self.rasterizer,
            "optimizer": {"_target_": "torch.optim.Adam", "_partial_": True},
            "schedule": {"_target_": "completesplat.training.schedules.constant", "_partial_": True},
        }
        found = OmegaConf.create({"seed": self.seed, "data": self.data, "model": model})
        found.data.image_size = json.loads((folder / CONFIG_FILE).read_text())["image_size"]
        return found


def open_generator(config: Any) -> Any:
    """The `CompleteSplat` of `config.weights`, with `config.sampler` if given.

    `WeightsError`: as `from_pretrained`, or weights that are not finite.
    """
    from completesplat.generation import CompleteSplat

    if config.weights in in_the_box():
        print(f"weights: {config.weights}, which come with the package: they know procedural scenes, not photographs")
    model = CompleteSplat.from_pretrained(config.weights)
    broken = [name for name, values in model.state_dict().items() if not values.isfinite().all()]
    if broken:
        raise WeightsError(
            f"{config.weights}: weights that are not finite in {len(broken)} tensors, such as {broken[0]}"
        )
    if config.get("sampler") is not None:
        sampler: Any = OmegaConf.to_container(config.sampler)
        model.replace_sampler(sampler)
    return model


def diffusion_of(module: Any) -> Any:
    """The generator of a latent diffusion model; `CompleteSplatError` for another model."""
    from completesplat.training.latent_diffusion import LatentDiffusion

    if not isinstance(module, LatentDiffusion):
        raise CompleteSplatError("this checkpoint is of a model that draws no samples; a diffusion model is needed")
    return module.completesplat


def config_of_run(checkpoint: Path, overrides: list[str]) -> Any:
    """The configuration saved beside a checkpoint's folder, with changes; `WeightsError` if one of both is missing."""
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
