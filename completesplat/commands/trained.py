"""Trained models: a run's checkpoint with its config, or a folder of weights; with data for evaluation."""

import os
import re
import sysconfig
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.utils import get_object, instantiate
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from completesplat.commands.protocol import checkpoint_facts
from completesplat.commands.settings import check_image_size, check_optimizer, check_parts
from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.options import conf_folder
from completesplat.parts import read_architecture
from completesplat.schema import check_value, shown
from completesplat.weights import WEIGHTS_FILE, in_the_box, read_small, sha256_of, weights_folder
from completesplat.weights.splatter_image import find, is_published

# Settings that name weights from elsewhere, which only training needs: before its first step and for its loss.
ONLY_FOR_TRAINING = (
    "model.autoreconstructor_checkpoint",
    "model.checkpoint",
    "model.model.pretrained",
    "model.completesplat.autoreconstructor.pretrained",
    "model.completesplat.conditioning.pretrained",
    "model.loss.terms.lpips",
)
# The parts of a run's config that are read, and the groups of `conf/` from which they are composed.
OF_A_RUN = ["model", "data"]
GROUPS = {"ablation", "autoreconstructor", "conditioning", "data", "denoiser", "experiment", "loss", "model"}
GROUPS |= {"objective", "optimizer", "posterior", "rasterizer", "regressor", "sampler", "schedule"}
TARGET = re.compile(r"_target_: *([\w.]+)")
WITHOUT_EFFECT = "samples, skip_weight, guidance_weight, steps and seed have no effect"
OPTIMIZER = re.compile(r"torch\.optim\.[A-Z]\w*")


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
            loaded = {"_target_": "completesplat.generation.CompleteSplat.from_pretrained", "path": folder}
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
        "_target_": "completesplat.rasterizers.directional.DirectionalRasterizer",
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
    from completesplat.generation import CompleteSplat

    return CompleteSplat.from_pretrained(weights).reconstructing


def open_generator(config: Any) -> Any:
    """Return the model of `config.weights`, with `config.sampler` if given, and print its limits.

    If the model draws no samples, `config.samples` is set to 1.

    Raises:
        WeightsError: as `from_pretrained`.
        CompleteSplatError: a sampler is given for a model that draws no samples.
    """
    from completesplat.generation import CompleteSplat
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
    from completesplat.training.latent_diffusion import LatentDiffusion

    if not isinstance(module, LatentDiffusion):
        raise CompleteSplatError("this checkpoint is of a model that draws no samples; a diffusion model is needed")
    return module.completesplat


def config_of_run(checkpoint: Path, overrides: list[str], trust: bool = False) -> Any:
    """Return model and data of the config saved beside a checkpoint's folder, with changes that `fit` accepts.

    The file may come from anyone, so it may name only what `conf/` names for models and data, or an optimizer of torch.
    If the run is the user's (`trust`, or it lies below the working folder and belongs to the user), it may also name
    the user's modules, such as those in the working folder. The changes may name anything.

    Raises:
        WeightsError: the checkpoint or its config is missing or not readable, or the config names something else.
        CompleteSplatError: the changes cannot be read, or `fit` would refuse them, too.
    """
    path = checkpoint.parent.parent / "config.yaml"
    if not checkpoint.is_file():
        raise WeightsError(f"{checkpoint}: no such checkpoint")
    if not path.is_file():
        raise WeightsError(f"{checkpoint}: the run's configuration {path} is missing")
    config = _changed(_read_config(path, trust), overrides)
    # The weights come from this checkpoint.
    for key in ONLY_FOR_TRAINING:
        parent, _, name = key.rpartition(".")
        if name in list(OmegaConf.select(config, parent) or ()):  # also where its value is missing
            OmegaConf.update(config, key, None)
    # Training with `cuda` needed a GPU, and this machine may lack one. With a GPU, `auto` is the same as `cuda`.
    for place in ("model.rasterizer", "model.rasterizer.rasterizer"):
        if OmegaConf.select(config, f"{place}._target_") == "completesplat.rasterizers.selection.cuda":
            OmegaConf.update(config, f"{place}._target_", "completesplat.rasterizers.selection.auto")
    return config


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


def _read_config(path: Path, trust: bool) -> Any:
    try:
        written: Any = OmegaConf.create(read_small(path))
        config = OmegaConf.masked_copy(written, OF_A_RUN)
    except Exception as error:  # raised by YAML or OmegaConf
        raise WeightsError(f"{path}: not a run's configuration ({type(error).__name__})") from error
    if any(config.get(part) is None for part in OF_A_RUN):
        raise WeightsError(f"{path}: not the configuration of a run of fit, which has {' and '.join(OF_A_RUN)}")
    files = [file for group in GROUPS for file in (conf_folder() / group).glob("*.yaml")]
    known = {name for file in files for name in TARGET.findall(file.read_text())}
    for name, value in _strings(OmegaConf.to_container(config, resolve=False)):
        # `fit` writes resolved values. A reference is refused, because a resolver can read the environment and more.
        if "${" in value:
            raise WeightsError(f"{path}: {shown(value)} refers to something else, which a run's configuration does not")
        if name != "_target_" or value in known or OPTIMIZER.fullmatch(value):
            continue
        message = f"{path} names {shown(value)}, which is no part of models or data in this package"
        if not trust and not _belongs_to_user(path):
            raise WeightsError(f"{message}; if it is a module of your own, and you trust who made the run: trust=true")
        if not _is_own(value):
            raise WeightsError(f"{message}, and not defined in a module of your own (SECURITY.md)")
    return config


def _strings(config: Any, name: Any = "") -> Iterator[tuple[Any, str]]:
    """Yield all keys and values as text, each after the name of the setting to which it belongs."""
    if isinstance(config, Mapping):
        for key, value in config.items():
            yield name, str(key)
            yield from _strings(value, key)
    elif isinstance(config, list):
        for value in config:
            yield from _strings(value, name)
    else:
        yield name, str(config)


def _belongs_to_user(config: Path) -> bool:
    """Return whether a run belongs to the user and lies below the working folder, where the user then put it.

    The working folder must not be the run's own, because modules that came with the run would count as the user's.
    """
    run = config.resolve().parent
    return Path.cwd() in run.parents and {run.stat().st_uid, config.stat().st_uid} == {os.getuid()}


def _is_own(target: str) -> bool:
    """Return whether a target is defined in a module outside of this package and Python's installation."""
    top = target.partition(".")[0]
    try:
        spec = find_spec(top)  # imports nothing, because the name has no dot
    except (ImportError, ValueError):
        return False
    if spec is None or top == "completesplat":
        return False
    places = [spec.origin] if spec.has_location else spec.submodule_search_locations or []
    if not places or any(_is_installed(Path(str(place)).resolve()) for place in places):
        return False
    try:
        definition = get_object(target)
    except (ImportError, ValueError) as error:
        raise WeightsError(f"{target}: cannot be imported ({error})") from error
    # A module of the user's may also hold names that it imports from elsewhere.
    return str(getattr(definition, "__module__", None)).partition(".")[0] == top


def _is_installed(path: Path) -> bool:
    libraries = {Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    return not {"site-packages", "dist-packages"}.isdisjoint(path.parts) or not libraries.isdisjoint(path.parents)
