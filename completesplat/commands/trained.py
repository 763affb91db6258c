"""Models for commands, from a run's checkpoint, from weights or from files of scenes, and the data to use with them."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.utils import instantiate
from omegaconf import OmegaConf

from completesplat.commands.inputs import check_one_model
from completesplat.errors import CompleteSplatError
from completesplat.evaluation.provenance import checkpoint_facts
from completesplat.generator import CompleteSplat
from completesplat.photo.choice import likeliest_weights
from completesplat.run_configs import config_of_run
from completesplat.scene_model import SceneModel
from completesplat.settings.checks import REMOVE
from completesplat.tensors import used_device
from completesplat.weights import AUTO, RUN_CHECKPOINT, sha256_of, shipped
from completesplat.weights.checkpoint_reading import load_part

if TYPE_CHECKING:
    from completesplat.data.loading.data_module import SceneDataModule
    from completesplat.evaluation.scene_files import SceneFiles
    from completesplat.evaluation.scorer import Scorer

logger = logging.getLogger(__name__)
WITHOUT_EFFECT = "samples, skip_weight, guidance_weight, steps and seed have no effect"


@dataclass(frozen=True)
class TrainedModel:
    """A model with its data: a run's checkpoint, weights, or files of scenes that any program wrote.

    `conf/test.yaml` explains the arguments; with `ckpt`, those of its run replace `data` and `rasterizer`.
    `check_names` explains what configs of runs and weights may name, and when they need `trust`.
    """

    ckpt: str | None
    overrides: Sequence[str] = ()
    trust: bool = False
    weights: str | None = None
    scenes: str | None = None
    frame: str = "opencv"
    align: str = "none"
    method: str | None = None
    data: Mapping[str, object] | None = None
    rasterizer: Mapping[str, object] | None = None
    sampler: Mapping[str, object] | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if self.ckpt is not None and Path(self.ckpt).is_dir():
            object.__setattr__(self, "ckpt", str(Path(self.ckpt, RUN_CHECKPOINT)))

    @cached_property
    def model(self) -> SceneModel:
        return CompleteSplat.from_pretrained(str(self.weights), self.trust)

    @cached_property
    def files(self) -> "SceneFiles":
        from completesplat.evaluation.scene_files import SceneFiles

        rendering = self._rendering((self.data or {}).get("background"))
        return SceneFiles(str(self.scenes), self.frame, self.align, self.method, **rendering)

    def configuration(self) -> Any:
        """Return the config of the data, and with `ckpt` also of the model.

        Raises:
            WeightsError: the checkpoint, its run's config or the weights are missing or not trusted.
            CompleteSplatError: not exactly one of them is given, or data are missing, superfluous or unsuitable.
        """
        check_one_model(self.ckpt, self.weights, self.scenes)
        if self.scenes is None and (self.frame, self.align, self.method) != ("opencv", "none", None):
            raise CompleteSplatError("frame, align, method: these apply to files only; give scenes=DIR")
        if self.ckpt is None and self.overrides:
            raise CompleteSplatError("overrides change a run's settings: give ckpt=FILE, or else data.KEY=VALUE")
        if self.ckpt is not None and self.data is not None:
            raise CompleteSplatError("a checkpoint's data are its run's: change them by overrides=['data.root=DIR']")
        if self.ckpt is not None:
            config = config_of_run(Path(self.ckpt), list(self.overrides), self.trust)
            if "scene_folder" in config.model:
                config.model.scene_folder = None  # the run's own, whose scene stays as it is
            return config
        if self.data is None:
            raise CompleteSplatError("weights=DIR and scenes=DIR need data: give data=NAME data.root=DIR")
        config = OmegaConf.create({"seed": self.seed, "data": self.data})
        if self.weights is not None:
            config.data.update(self.model.needed_of_data(config.data))
        return config

    def open(self) -> "tuple[Scorer, SceneDataModule]":
        """Return the model and the data module; raise the errors of `configuration` and `open_module`."""
        configuration = self.configuration()
        return self.open_module(configuration), instantiate(configuration.data, _convert_="all")

    def open_module(self, configuration: Any) -> "Scorer":
        """Return the scorer with its weights and sampler (if given); raise CompleteSplatError if one does not fit."""
        scorer = self._scorer() if self.ckpt is None else instantiate(configuration.model, _convert_="all")
        if self.ckpt is not None:
            load_part(scorer, self.ckpt, prefix="")
        if self.sampler is not None:
            diffusion_of(scorer).replace_sampler(self.sampler)
        return scorer

    def facts(self) -> dict[str, object]:
        """Return `checkpoint_facts`; for weights and files of scenes, path and checksum without facts of training."""
        if self.ckpt is not None:
            return checkpoint_facts(Path(self.ckpt))
        if self.scenes is not None:
            return self.files.facts()
        assert self.model.file is not None
        facts = {"path": self.weights, "sha256": sha256_of(self.model.file), "step": None}
        return {"checkpoint": facts, "ema": None}

    def _rendering(self, background: object) -> dict[str, Any]:
        known = {} if background is None else {"background": background}
        return {"rasterizer": instantiate(self.rasterizer, _convert_="all")} | known

    def _scorer(self) -> "Scorer":
        if self.scenes is not None:
            return self.files
        from completesplat.training.latent_diffusion import DiffusionScorer
        from completesplat.training.reconstruction import ReconstructionScorer

        rendering = self._rendering(self.model.background)
        if isinstance(self.model, CompleteSplat):
            return DiffusionScorer(self.model, **rendering)
        return ReconstructionScorer(self.model.reconstruction_model, **rendering)


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
        say(f"weights: {config.weights}, which come with the package and know {content}{reason}")
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
