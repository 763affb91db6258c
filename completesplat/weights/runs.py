"""Configs of runs of `fit`, read from their folders and checkpoints. `check_names` checks the names in them."""

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.settings import checks
from completesplat.settings.schema import check_value
from completesplat.weights import RUN_CONFIG_FILE, first_line, read_small
from completesplat.weights.allowed import ConfigOrigin, check_names

SECTIONS = ["model", "data"]  # sections of a run's config that are read
CONFIG = "hyper_parameters"  # Lightning's name for the config in a checkpoint
# Loss terms with networks of their own, whose weights may be elsewhere.
PERCEPTUAL_TERMS = ("LearnedPerceptualSimilarity", "EfficientNetDistance")


def config_of_run(checkpoint: Path, overrides: list[str], trust: bool = False) -> Any:
    """Return `model` and `data` of the config of a checkpoint's run, with `overrides`, which `fit` must accept.

    The config may come from anyone, so `check_names` limits what it names. The overrides may name anything.

    Raises:
        WeightsError: the checkpoint or its config is missing or unreadable, or `check_names` refuses the config.
        CompleteSplatError: the overrides cannot be read, or `fit` would refuse them, too.
    """
    if not checkpoint.is_file():
        raise WeightsError(f"{checkpoint}: no such checkpoint")
    path, config = read_run_config(checkpoint)
    allowed = OmegaConf.create(check_names(config, ConfigOrigin(path, path.resolve().parent, trust)))
    return without_training(_changed(allowed, overrides))


def config_of_checkpoint(
    checkpoint: Path, contents: Mapping[str, Any], trust: bool, hparams_file: Path | None = None
) -> dict[str, Any]:
    """Return the config of the model in the contents of a checkpoint, or in `hparams_file` in its place.

    The run's folder is the one above the checkpoint's, or that of `hparams_file`. Links are followed, because the
    config is in the file itself: a link in the user's folder does not make another person's file the user's own.

    Raises:
        WeightsError: there is no config, or `check_names` refuses it.
    """
    if hparams_file is None:
        config = contents.get(CONFIG)
        origin = ConfigOrigin(checkpoint, checkpoint.resolve().parent.parent, trust)
        advice = "train with `fit`, or with what completesplat.instantiate gives"
    else:
        config = _read_sections(hparams_file, ["model"])
        origin = ConfigOrigin(hparams_file, hparams_file.resolve().parent, trust)
        advice = "a run of fit writes one, config.yaml"
    if not isinstance(config, dict) or not isinstance(config.get("model"), dict):
        raise WeightsError(f"{origin.file}: has no config; {advice}")
    allowed: dict[str, Any] = check_names(config, origin)
    return allowed


def read_run_config(checkpoint: Path) -> tuple[Path, dict[str, Any]]:
    """Return the path of the config of a checkpoint's run, and its sections `model` and `data` as plain containers.

    A link to a checkpoint is not followed, because the config lies in the folder of the run that has the link.

    Raises:
        WeightsError: the config is missing, unreadable, or not that of a run of `fit`.
    """
    path = checkpoint.absolute().parent.parent / RUN_CONFIG_FILE
    if not path.is_file():
        raise WeightsError(f"{checkpoint}: the run's configuration {path} is missing")
    plain = _read_sections(path, SECTIONS)
    if not all(isinstance(plain.get(section), Mapping) for section in SECTIONS):
        raise WeightsError(f"{path}: not the configuration of a run of fit, which has {' and '.join(SECTIONS)}")
    return path, plain


def _read_sections(path: Path, sections: list[str]) -> dict[str, Any]:
    """Return sections of a YAML file as plain containers; raise WeightsError if it is missing or cannot be read."""
    if not path.is_file():
        raise WeightsError(f"{path}: no such file")
    text = read_small(path)
    try:
        config = OmegaConf.masked_copy(OmegaConf.create(text), sections)  # type: ignore[arg-type]
        return dict(OmegaConf.to_container(config, resolve=False))  # type: ignore[arg-type]
    except Exception as error:  # YAML and OmegaConf raise errors of many types
        raise WeightsError(f"{path}: not a run's configuration ({type(error).__name__})") from error


def with_overrides(model: DictConfig, overrides: Mapping[str, object]) -> DictConfig:
    """Return a model's config with changes: names of settings, `.` between the levels, and values.

    Mappings change only what they name. The changes come from the user and may name anything.

    Raises:
        CompleteSplatError: there is no such setting, or a value does not fit or is an object.
    """
    changed = copy.deepcopy(model)
    for name, value in overrides.items():
        try:
            OmegaConf.update(changed, name, value, merge=True, force_add=True)
        except (OmegaConfBaseException, AssertionError) as error:
            advice = "give numbers, texts, lists or mappings, as in the config; set other objects on the loaded module"
            raise CompleteSplatError(f"{name}: cannot be overridden with {type(value).__name__}; {advice}") from error
    if overrides:
        checks.check_parts(changed)
        checks.check_optimizer(changed.get("optimizer"))
    return changed


def _changed(config: Any, overrides: list[str]) -> Any:
    """Return the config with overrides of `model` and `data`, which are checked as `fit` checks its settings."""
    try:
        changes = OmegaConf.from_dotlist(overrides)
        others = [str(key) for key in changes if key not in SECTIONS]
        if others:
            raise CompleteSplatError(f"{others[0]}: no setting of a run's model or data, which overrides= changes")
        changed: Any = OmegaConf.merge(config, changes)
    except (OmegaConfBaseException, YAMLError, ValueError) as error:
        raise CompleteSplatError(f"overrides={overrides}: cannot be applied: {first_line(error)}") from error
    for section in SECTIONS:
        check_value(section, Mapping[str, object], changed[section])
    if overrides:
        checks.check_parts(changed)
        checks.check_image_size(changed)
        checks.check_optimizer(changed.model.get("optimizer"))
    return changed


def without_training(config: Any) -> Any:
    """Remove from a config what only training needs: weights to start from, loss terms with networks, and a GPU.

    `rasterizer=cuda` becomes `auto`, which is the same where there is a GPU.
    """
    checks.remove_start_weights(config)
    terms = OmegaConf.select(config, "model.loss.terms") or {}
    for name in list(terms):
        targets = [str(part._target_) for part, _ in checks.each_part(terms[name])]
        if any(target.endswith(PERCEPTUAL_TERMS) for target in targets):
            terms[name] = None
    if OmegaConf.select(config, "model.rasterizer._target_") == "completesplat.rasterizers.selection.cuda":
        config.model.rasterizer._target_ = "completesplat.rasterizers.selection.auto"
    return config
