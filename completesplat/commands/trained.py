"""Models for commands, from a run's checkpoint, from weights or from files of scenes, and the data to use with them."""

import logging
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from hydra.utils import instantiate
from omegaconf import OmegaConf

from completesplat.commands.inputs import check_one_model
from completesplat.errors import CompleteSplatError, DataError
from completesplat.evaluation.provenance import checkpoint_facts
from completesplat.generator import CompleteSplat
from completesplat.photo.choice import likeliest_for, likeliest_weights, looked_at
from completesplat.scene_model import SceneModel
from completesplat.settings.checks import REMOVE
from completesplat.settings.schema import TestSettings
from completesplat.tensors import used_device
from completesplat.weights import AUTO, RUN_CHECKPOINT, sha256_of, shipped
from completesplat.weights.checkpoint_reading import load_part
from completesplat.weights.runs import config_of_run

if TYPE_CHECKING:
    from completesplat.data.loading.data_module import SceneDataModule
    from completesplat.evaluation.ply_samples import PlySamples
    from completesplat.evaluation.scorer import Scorer

logger = logging.getLogger(__name__)
WITHOUT_EFFECT = "samples, skip_weight, guidance_weight, steps and seed have no effect"


class TrainedModel(ABC):
    """A model to test, with the data to test it on.

    Its kinds: the checkpoint of a run (`RunCheckpoint`), weights (`GivenWeights`), and files of scenes that any program
    wrote (`GivenScenes`). `trained_model` chooses one of them.
    """

    seed: int
    sampler: Mapping[str, object] | None
    method: str | None

    @property
    def label(self) -> str | None:
        """Return the name of the method for results; None: that of the model's class."""
        return self.method

    @abstractmethod
    def configuration(self) -> Any:
        """Return the config of the data, and for a run also of the model.

        Raises:
            WeightsError: the checkpoint, its run's config or the weights are missing or not trusted.
            CompleteSplatError: the data are unsuitable.
        """

    @abstractmethod
    def scorer(self, configuration: Any) -> "Scorer":
        """Return the scorer with its weights; raise WeightsError if they do not fit."""

    @abstractmethod
    def facts(self) -> dict[str, object]:
        """Return path, checksum and training steps of what is tested, as in `checkpoint_facts`."""

    def open_module(self, configuration: Any) -> "Scorer":
        """Return the scorer with its weights and sampler (if given); raise CompleteSplatError if one does not fit."""
        scorer = self.scorer(configuration)
        if self.sampler is not None:
            diffusion_of(scorer).replace_sampler(self.sampler)
        return scorer

    def open(self) -> "tuple[Scorer, SceneDataModule]":
        """Return the model and the data module; raise the errors of `configuration` and `open_module`."""
        configuration = self.configuration()
        return self.open_module(configuration), instantiate(configuration.data, _convert_="all")


@dataclass(frozen=True)
class RunCheckpoint(TrainedModel):
    """A checkpoint of a run, with the run's own model, rasterizer and data.

    Args:
        checkpoint: the file.
        overrides: changes of the run's settings, as on the command line.
        trust: the run may name modules of the user's own.
    """

    checkpoint: Path
    overrides: Sequence[str]
    trust: bool
    sampler: Mapping[str, object] | None
    seed: int
    method: str | None

    def configuration(self) -> Any:
        """See `TrainedModel`; raise CompleteSplatError if `fit` would refuse an override."""
        config = config_of_run(self.checkpoint, list(self.overrides), self.trust)
        if "scene_folder" in config.model:
            config.model.scene_folder = None  # the run's own, whose scene stays as it is
        return config

    def scorer(self, configuration: Any) -> "Scorer":
        """See `TrainedModel`."""
        scorer: Scorer = instantiate(configuration.model, _convert_="all")
        load_part(scorer, self.checkpoint, prefix="")
        return scorer

    def facts(self) -> dict[str, object]:
        """See `TrainedModel`."""
        return checkpoint_facts(self.checkpoint)


@dataclass(frozen=True)
class GivenWeights(TrainedModel):
    """Weights, with data and rasterizer that the user gives.

    Args:
        weights, trust: see `CompleteSplat.from_pretrained`.
        data, rasterizer, sampler: configs of these parts.
        typed: names of the settings that the user gave.
    """

    weights: str
    trust: bool
    data: Mapping[str, object]
    typed: Sequence[str]
    rasterizer: Mapping[str, object]
    sampler: Mapping[str, object] | None
    seed: int
    method: str | None

    @property
    def label(self) -> str:
        """Return the given name, or else that of the weights."""
        return Path(self.weights).name if self.method is None else self.method

    @cached_property
    def model(self) -> SceneModel:
        return CompleteSplat.from_pretrained(self.weights, self.trust)

    def configuration(self) -> Any:
        """Return the config of the data as the weights need them, with a warning where the user gave another value.

        The weights cannot do without their image size and background. A depth range that the user gave stays.
        """
        config = _given_data(self.data, self.seed)
        for name, depth in self.model.depths_of_training().items():
            if name not in config.data:
                continue
            if f"data.{name}" not in self.typed:
                config.data[name] = depth
            elif config.data[name] != depth:
                logger.warning("data.%s=%s: these weights were trained at %s", name, config.data[name], depth)
        for name, value in self.model.needed_of_data(config.data).items():
            if f"data.{name}" in self.typed and config.data[name] != value:
                logger.warning("data.%s=%s: these weights need %s, which is taken", name, config.data[name], value)
            config.data[name] = value
        return config

    def scorer(self, configuration: Any) -> "Scorer":
        """See `TrainedModel`."""
        from completesplat.training.latent_diffusion import DiffusionScorer
        from completesplat.training.reconstruction import ReconstructionScorer

        rendering = _rendering(self.rasterizer, self.model.background)
        if isinstance(self.model, CompleteSplat):
            return DiffusionScorer(self.model, **rendering)
        return ReconstructionScorer(self.model.reconstruction_model, **rendering)

    def facts(self) -> dict[str, object]:
        """Return path and checksum of the weights; facts of their training are not known."""
        assert self.model.file is not None
        checkpoint = {"path": self.weights, "sha256": sha256_of(self.model.file), "step": None}
        return {"checkpoint": checkpoint, "ema": None}


@dataclass(frozen=True)
class GivenScenes(TrainedModel):
    """Files of scenes that any program wrote, with data and rasterizer that the user gives.

    Args:
        scenes, frame, align, method: as in `conf/test.yaml`.
        data, rasterizer, sampler: configs of these parts.
    """

    scenes: str
    frame: str
    align: str
    method: str | None
    data: Mapping[str, object]
    rasterizer: Mapping[str, object]
    sampler: Mapping[str, object] | None
    seed: int

    @cached_property
    def files(self) -> "PlySamples":
        from completesplat.evaluation.ply_samples import PlySamples

        rasterizer = instantiate(self.rasterizer, _convert_="all")
        return PlySamples(self.scenes, self.frame, self.align, self.method, rasterizer=rasterizer)

    def configuration(self) -> Any:
        """Return the config of the data."""
        return _given_data(self.data, self.seed)

    def scorer(self, configuration: Any) -> "Scorer":
        """Return the scorer of the files, on the data's background; raise CompleteSplatError without such a folder."""
        background = configuration.data.get("background")
        if background is not None:
            self.files.background = background
        return self.files

    def facts(self) -> dict[str, object]:
        """Return path and checksum of the files."""
        return self.files.facts()


def trained_model(**settings: Unpack[TestSettings]) -> TrainedModel:
    """Return the model that the settings of `completesplat test` choose; `conf/test.yaml` explains them.

    Raises:
        CompleteSplatError: not exactly one of `ckpt`, `weights` and `scenes` is given, data are missing or superfluous,
            or a setting belongs to another of the three.
    """
    ckpt = settings["ckpt"]
    weights = settings["weights"]
    scenes = settings.get("scenes")
    overrides = settings["overrides"]
    frame = settings.get("frame", "opencv")
    align = settings.get("align", "none")
    method = settings.get("method")
    data = settings.get("data")
    sampler = settings.get("sampler")
    seed = settings["seed"]
    check_one_model(ckpt, weights, scenes)
    if scenes is None and (frame, align) != ("opencv", "none"):
        raise CompleteSplatError("frame, align: these apply to files only; give scenes=DIR")
    if ckpt is not None:
        if data is not None:
            raise CompleteSplatError("a checkpoint's data are its run's: change them by overrides=['data.root=DIR']")
        checkpoint = Path(ckpt, RUN_CHECKPOINT) if Path(ckpt).is_dir() else Path(ckpt)
        return RunCheckpoint(checkpoint, overrides, settings["trust"], sampler, seed, method)
    if overrides:
        raise CompleteSplatError("overrides change a run's settings: give ckpt=FILE, or else data.KEY=VALUE")
    if data is None:
        raise CompleteSplatError("weights=DIR and scenes=DIR need data: give data=NAME data.root=DIR")
    rasterizer = settings["rasterizer"]
    if weights is not None:
        if weights == AUTO:
            weights, reason = likeliest_for_test(data, seed)
            print(f"weights: {weights}{reason}")
        typed = settings.get("typed", ())
        return GivenWeights(weights, settings["trust"], data, typed, rasterizer, sampler, seed, method)
    return GivenScenes(str(scenes), frame, align, method, data, rasterizer, sampler, seed)


def likeliest_for_test(data: Mapping[str, object], seed: int) -> tuple[str, str]:
    """Return the name of the likeliest shipped weights for the reference views of test scenes, and the reason.

    As in a prediction from several photos, one set of weights serves all of them.

    Raises:
        DataError: there are no test scenes.
        WeightsError: the package has no weights.
    """
    module: SceneDataModule = instantiate(_given_data(data, seed).data, _convert_="all")
    module.prepare_data()
    store = module.store("test")
    views = []
    for name in looked_at(store.names):
        with suppress(DataError):  # which the test reports
            sequence = store.source.read(name)
            reference, _ = module.evaluation_views(sequence, "test")
            views.append((name, store.image(sequence, reference)))
    return likeliest_for(views, len(store.names))


def _given_data(data: Mapping[str, object], seed: int) -> Any:
    return OmegaConf.create({"seed": seed, "data": data})  # configs of data refer to the seed


def _rendering(rasterizer: Mapping[str, object], background: object) -> dict[str, Any]:
    """Return the settings of a scorer's renders, without a background if that is not known."""
    settings = {"rasterizer": instantiate(rasterizer, _convert_="all")}
    if background is not None:
        settings["background"] = background
    return settings


def open_generator(config: Any, images: Sequence[Path], announced: bool = True) -> SceneModel:
    """Return the model of `config.weights`, with `config.sampler` if given, on `used_device`; print its limits.

    Of several processes, one prints them (`announced`). `weights=auto` is replaced by the
    `likeliest_weights` for the images. If the model draws no samples, `config.samples` is set to 1.

    Raises:
        WeightsError: as `from_pretrained`.
        CompleteSplatError: a sampler is given for a model that draws no samples.
    """
    reason = ""
    say = print if announced else logger.debug
    if config.weights == AUTO:
        config.weights, reason = likeliest_weights(images, config.background == REMOVE)
    model = CompleteSplat.from_pretrained(config.weights, config.trust)
    if config.weights in shipped():
        content = model.architecture["training"]["content"]
        say(f"weights: {config.weights}, trained on {content}{reason}")
    if config.get("sampler") is not None:
        model.replace_sampler(OmegaConf.to_container(config.sampler))  # type: ignore[arg-type]
    if not model.draws_samples:
        say(f"weights: {config.weights} gives one answer for each image and draws no samples: {WITHOUT_EFFECT}")
        config.samples = 1
    if model.note is not None:
        say(f"weights: {model.note}")
    return model.to(used_device())


def shown_background(chosen: float | str | None, model: SceneModel | None) -> float:
    """Return the grey value behind renders: a chosen number, else that of the weights' training, else 0.5."""
    if chosen is not None and chosen != REMOVE:
        return float(chosen)
    return 0.5 if model is None or model.background is None else model.background


def diffusion_of(scorer: "Scorer") -> CompleteSplat:
    """Return the model of latent diffusion; raise CompleteSplatError if the scorer has another one."""
    model = getattr(scorer, "completesplat", None)
    if not isinstance(model, CompleteSplat):
        raise CompleteSplatError("this model has no sampler: a diffusion model is needed, which stage 2 trains")
    return model
