"""Trained models: a run's checkpoint with its config, or a folder of weights; with data for evaluation."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.utils import instantiate
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from completesplat.baselines.splatter_image.files import find, is_published
from completesplat.commands.protocol import checkpoint_facts
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.opening import OF_A_RUN, read_run_config, without_training
from completesplat.parts import read_architecture
from completesplat.settings.checks import check_image_size, check_optimizer, check_parts
from completesplat.settings.schema import check_value
from completesplat.weights import WEIGHTS_FILE, in_the_box, sha256_of, weights_folder

WITHOUT_EFFECT = "samples, skip_weight, guidance_weight, steps and seed have no effect"


@dataclass(frozen=True)
class Trained:
    """A trained model with its data: a run's checkpoint, or a folder of weights.

    `conf/test.yaml` explains the arguments; the configs `data` and `rasterizer` are used with `weights` only.
    `config_of_run` explains what a run's config may name, and when it needs `trust`.
    """

    ckpt: str | None
    overrides: Sequence[str] = ()
    trust: bool = False
    weights: str | None = None
    data: Mapping[str, Any] | None = None
    rasterizer: Mapping[str, Any] | None = None
    sampler: Mapping[str, Any] | None = None
    seed: int = 0

    def configuration(self) -> Any:
        """Return the config of model and data.

        Raises:
            WeightsError: the checkpoint, its run's config or the weights are missing or not trusted.
            CompleteSplatError: neither is given, or both, or weights without data.
        """
        if (self.ckpt is None) == (self.weights is None):
            raise CompleteSplatError("give ckpt=RUN/checkpoints/last.ckpt, or weights=DIR data=NAME data.root=DIR")
        if self.ckpt is not None and self.data is not None:
            raise CompleteSplatError("a checkpoint's data are its run's: change them by overrides=['data.root=DIR']")
        if self.ckpt is not None:
            return config_of_run(Path(self.ckpt), list(self.overrides), self.trust)
        if self.data is None:
            raise CompleteSplatError("weights know no data: give data=NAME data.root=DIR")
        return self._config_of_weights(str(self.weights))

    def open(self) -> tuple[Any, Any]:
        """Return the model and the data module; raise the errors of `configuration` and `open_module`."""
        configuration = self.configuration()
        return self.open_module(configuration), instantiate(configuration.data, _convert_="all")

    def open_module(self, configuration: Any) -> Any:
        """Return the model of the config, with its weights and, if given, another sampler.

        Raises:
            WeightsError: the weights do not fit.
            CompleteSplatError: a sampler is given for a model that draws no samples.
        """
        from completesplat.weights.checkpoint_reading import load_part

        module = instantiate(configuration.model, _convert_="all")
        if self.ckpt is not None:
            load_part(module, self.ckpt, prefix="")
        if self.sampler is not None:
            diffusion_of(module).replace_sampler(self.sampler)
        return module

    def facts(self) -> dict[str, Any]:
        """Return `checkpoint_facts`; for a folder of weights, path and checksum but not how training ended."""
        if self.ckpt is not None:
            return checkpoint_facts(Path(self.ckpt))
        weights = str(self.weights)
        file = find(weights).weights if is_published(weights) else weights_folder(weights) / WEIGHTS_FILE
        return {"checkpoint": {"path": weights, "sha256": sha256_of(file), "step": None}, "ema": None}

    def _config_of_weights(self, weights: str) -> Any:
        """Return the config of a stage's module around a loaded model; its loss and optimizer are never used."""
        published = is_published(weights)
        folder = weights if published else str(weights_folder(weights))
        architecture = {} if published else read_architecture(Path(folder))
        if published or "network" in architecture:
            mse = {"weight": 1.0, "term": {"_target_": "completesplat.losses.mse.MeanSquaredError"}}
            stage: dict[str, Any] = {
                "_target_": "completesplat.training.reconstruction.ReconstructionModule",
                "model": {"_target_": "completesplat.commands.trained.network_of", "weights": folder},
                "loss": {"_target_": "completesplat.losses.WeightedSum", "terms": {"mse": mse}},
            }
        else:
            loaded = {"_target_": "completesplat.generator.CompleteSplat.from_pretrained", "path": folder}
            stage = {"_target_": "completesplat.training.latent_diffusion.LatentDiffusion", "completesplat": loaded}
        model = {
            **stage,
            "rasterizer": self.rasterizer,
            "optimizer": {"_target_": "torch.optim.Adam", "_partial_": True},
            "schedule": {"_target_": "completesplat.training.optimization.constant", "_partial_": True},
        }
        config = OmegaConf.create({"seed": self.seed, "data": self.data, "model": model})
        if published:
            return _as_published(config, weights)
        config.data.image_size = architecture["image_size"]
        return config


def _as_published(config: Any, weights: str) -> Any:
    """Adapt data and rasterizer to published weights, which know only objects on one background.

    Raises:
        CompleteSplatError: the weights need the distance of the object, and the data do not contain it.
    """
    known = find(weights).data
    config.model.rasterizer = {
        "_target_": "completesplat.baselines.splatter_image.directional.DirectionalRasterizer",
        "rasterizer": config.model.rasterizer,
    }
    config.model.background = config.data.background = float(known["white_background"])
    config.data.image_size = known["training_resolution"]
    if known["origin_distances"]:  # the far end of the depth range says where the object is
        if "depth_after" not in config.data:
            raise CompleteSplatError(f"weights={weights}: know objects; these data do not say where objects are")
        config.data.depth_after = known["zfar"]
    return config


def network_of(weights: str) -> Any:
    """Return the network of weights that give one scene for an image and draw no samples."""
    from completesplat.generator import CompleteSplat

    return CompleteSplat.from_pretrained(weights).reconstructing


def open_generator(config: Any) -> Any:
    """Return the model of `config.weights`, with `config.sampler` if given, and print its limits.

    If the model draws no samples, `config.samples` is set to 1.

    Raises:
        WeightsError: as `from_pretrained`.
        CompleteSplatError: a sampler is given for a model that draws no samples.
    """
    from completesplat.generator import CompleteSplat
    from completesplat.published import PublishedGenerator

    if config.weights in in_the_box():
        print(f"weights: {config.weights}, which come with the package: they know procedural scenes, not photographs")
    model = CompleteSplat.from_pretrained(config.weights)
    if not model.draws_samples:
        if config.get("sampler") is not None:
            raise CompleteSplatError(f"{config.weights}: these weights draw no samples: leave out sampler")
        print(f"weights: {config.weights} gives one answer for each picture and draws no samples: {WITHOUT_EFFECT}")
        if isinstance(model, PublishedGenerator):
            print(f"weights: {model.said}")
        config.samples = 1
    if isinstance(model, CompleteSplat) and config.get("sampler") is not None:
        sampler: Any = OmegaConf.to_container(config.sampler)
        model.replace_sampler(sampler)
    return model


def diffusion_of(module: Any) -> Any:
    """Return the generator of a latent diffusion model.

    Raises:
        CompleteSplatError: the module is another model.
    """
    if not module.draws_samples:
        raise CompleteSplatError("this checkpoint is of a model that draws no samples; a diffusion model is needed")
    return module.completesplat


def config_of_run(checkpoint: Path, overrides: list[str], trust: bool = False) -> Any:
    """Return model and data of the config saved beside a checkpoint's folder, with changes that `fit` accepts.

    The file may come from anyone (`check_names` of `completesplat.opening`); the changes may name anything.

    Raises:
        WeightsError: the checkpoint or its config is missing or not readable, or the config names something else.
        CompleteSplatError: the changes cannot be read, or `fit` would refuse them, too.
    """
    path = checkpoint.parent.parent / "config.yaml"
    if not checkpoint.is_file():
        raise WeightsError(f"{checkpoint}: no such checkpoint")
    if not path.is_file():
        raise WeightsError(f"{checkpoint}: the run's configuration {path} is missing")
    return without_training(_changed(read_run_config(path, trust), overrides))


def _changed(config: Any, overrides: list[str]) -> Any:
    try:
        changes = OmegaConf.from_dotlist(overrides)
        if others := [str(key) for key in changes if key not in OF_A_RUN]:
            raise CompleteSplatError(f"{others[0]}: no setting of a run's model or data, which overrides= changes")
        changed: Any = OmegaConf.merge(config, changes)
    except (OmegaConfBaseException, YAMLError, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise CompleteSplatError(f"overrides={overrides}: cannot be applied: {reason}") from error
    for part in OF_A_RUN:
        check_value(part, Mapping[str, Any], changed[part])
    if overrides:
        check_parts(changed)
        check_image_size(changed)
        check_optimizer(changed.model.get("optimizer"))
    return changed
