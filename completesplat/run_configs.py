"""Models of weights and runs; `check_names` checks all configs before anything is imported or built (SECURITY.md)."""

import json
import os
import re
from collections.abc import Mapping
from functools import cache, partial
from pathlib import Path
from typing import Any

from huggingface_hub import constants
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from safetensors.torch import load_file
from torch import Tensor
from yaml import YAMLError

from completesplat.errors import CompleteSplatError, WeightsError
from completesplat.files import SHORT, printable
from completesplat.parts import PATH, check_architecture, check_sizes, own_part, stored_config
from completesplat.scene_model import camera_tensors
from completesplat.settings import checks
from completesplat.settings.options import conf_folder
from completesplat.settings.schema import check_value
from completesplat.weights import CAMERA, CONFIG_FILE, RUN_CONFIG_FILE, RUN_WEIGHTS, SCENES, first_line, read_small
from completesplat.weights.checkpoint_reading import read_checkpoint

# The classes of runs whose models make scenes from photos: the setting of the model, which begins its tensors' names.
STAGES = {"LatentDiffusion": "completesplat", "ReconstructionModule": "model"}
SECTIONS = ["model", "data"]  # sections of a run's config that are read
GROUPS = {"ablation", "autoreconstructor", "conditioning", "data", "denoiser", "experiment", "loss", "model"}
GROUPS |= {"objective", "optimizer", "posterior", "rasterizer", "regressor", "sampler", "schedule"}
"""Groups of `conf/` that models and data are composed of."""
TARGET = re.compile(r"_target_: *([\w.]+)")
OPTIMIZER = re.compile(r"torch\.optim\.[A-Z]\w*")


def config_of_run(checkpoint: Path, overrides: list[str], trust: bool = False) -> Any:
    """Return `model` and `data` of the config of a checkpoint's run, with `overrides`, which `fit` must accept.

    The config may come from anyone, so `check_names` limits what it names. The overrides may name anything.

    Raises:
        WeightsError: the checkpoint or its config is missing or unreadable, or `check_names` refuses the config.
        CompleteSplatError: the overrides cannot be read, or `fit` would refuse them, too.
    """
    if not checkpoint.is_file():
        raise WeightsError(f"{checkpoint}: no such checkpoint")
    path, plain = read_run_config(checkpoint)
    config = OmegaConf.create(check_names(plain, path, path.resolve().parent, trust))
    return without_training(_changed(config, overrides))


def read_run_config(checkpoint: Path) -> tuple[Path, dict[str, Any]]:
    """Return the path of the config of a checkpoint's run, and its sections `model` and `data` as plain containers.

    Raises:
        WeightsError: the config is missing, unreadable, or not that of a run of `fit`.
    """
    path = checkpoint.absolute().parent.parent / RUN_CONFIG_FILE
    if not path.is_file():
        raise WeightsError(f"{checkpoint}: the run's configuration {path} is missing")
    text = read_small(path)
    try:
        config = OmegaConf.masked_copy(OmegaConf.create(text), SECTIONS)  # type: ignore[arg-type]
    except Exception as error:  # YAML and OmegaConf raise errors of many types
        raise WeightsError(f"{path}: not a run's configuration ({type(error).__name__})") from error
    plain = dict(OmegaConf.to_container(config, resolve=False))  # type: ignore[arg-type]
    if not all(isinstance(plain.get(section), Mapping) for section in SECTIONS):
        raise WeightsError(f"{path}: not the configuration of a run of fit, which has {' and '.join(SECTIONS)}")
    return path, plain


def read_weights(file: Path, trust: bool) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return a model's config and its tensors by name from `model.safetensors` and the `config.json` beside it.

    Raises:
        WeightsError: the config is unreadable or refused, or the tensors do not belong to it.
    """
    path = file.with_name(CONFIG_FILE)
    try:
        architecture = json.loads(read_small(path))
    except (ValueError, RecursionError) as error:
        raise WeightsError(f"{path}: not readable as JSON ({error})") from error
    folder = path.resolve().parent
    architecture = check_names(architecture, path, folder.parent if folder.name == RUN_WEIGHTS else folder, trust)
    check_architecture(architecture, path)
    architecture = stored_config(architecture)
    tensors = load_file(file)
    check_sizes(architecture, tensors, (file.name, CONFIG_FILE))
    return architecture, tensors


def read_run(checkpoint: Path, trust: bool) -> tuple[dict[str, Any], dict[str, Tensor]]:
    """Return a model's config and its tensors by name from a run's checkpoint, averaged tensors if it has such.

    Raises:
        WeightsError: the model makes no scene from a photo, its config is refused, or the checkpoint is not its own.
    """
    path, config = read_run_config(checkpoint)
    model = config["model"]
    target = printable(config["model"].get("_target_"), SHORT)
    stage = target.rpartition(".")[2]
    if stage not in STAGES:
        fitted = path.parent / SCENES
        advice = f"; those that it fitted are in {fitted}" if fitted.is_dir() else ""
        raise WeightsError(f"{path} names {target}: a run of {stage} makes no scene of a photograph{advice}")
    prefix = f"{STAGES[stage]}."
    part = model.get(STAGES[stage])
    one_answer = stage == "ReconstructionModule"
    settings = dict(part) if isinstance(part, Mapping) else {}
    architecture = {key: x for key, x in settings.items() if key not in ("_target_", "_recursive_")}
    if one_answer:
        architecture = {"network": part, "image_size": config["data"].get("image_size")}
    architecture = stored_config(check_names(architecture, path, path.resolve().parent, trust))
    check_architecture(architecture, path)
    contents = read_checkpoint(checkpoint)
    name = "network." if one_answer else ""
    tensors = {name + k.removeprefix(prefix): x for k, x in contents["state_dict"].items() if k.startswith(prefix)}
    check_sizes(architecture, tensors, (checkpoint.name, RUN_CONFIG_FILE))
    return architecture, tensors | camera_tensors(contents.get(CAMERA, {})) if one_answer else tensors


def _changed(config: Any, overrides: list[str]) -> Any:
    try:
        changes = OmegaConf.from_dotlist(overrides)
        if others := [str(key) for key in changes if key not in SECTIONS]:
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
    """Remove from a config what only training needs: weights to start from, loss terms with such, and a GPU.

    `rasterizer=cuda` becomes `auto`, which is the same where there is a GPU.
    """
    checks.remove_start_weights(config)
    terms = OmegaConf.select(config, "model.loss.terms") or {}
    for name in list(terms):
        if any(getattr(kind, "only_for_training", False) for _, kind in checks.each_part(terms[name])):
            terms[name] = None
    if OmegaConf.select(config, "model.rasterizer._target_") == "completesplat.rasterizers.selection.cuda":
        config.model.rasterizer._target_ = "completesplat.rasterizers.selection.auto"
    return config


def check_names(config: Any, source: Path, run: Path, trust: bool, name: object = "") -> Any:
    """Return a plain config from the file `source`, with the present paths of parts that it names by name or old path.

    A config may name what `conf/` names for models and data, and optimizers of torch. If the run is trusted or belongs
    to the user (`_belongs_to_user`), it may also name the user's modules, such as those in the working folder.

    Args:
        run: the folder of the run, or of weights without a run, with links resolved.
        name: the setting that has the value `config`.

    Raises:
        WeightsError: the config names something else.
    """
    check = partial(check_names, source=source, run=run, trust=trust)
    if isinstance(config, Mapping):
        for key in config:
            check(str(key), name=name)
        return {key: check(value, name=key) for key, value in config.items()}
    if isinstance(config, list):
        return [check(value, name=name) for value in config]
    value = str(config)
    # `fit` writes resolved values. References are refused because a resolver can read the environment and more.
    if "${" in value:
        refusal = f"{source}: {printable(value, SHORT)} refers to something else"
        raise WeightsError(f"{refusal}, which a stored configuration does not")
    if name != "_target_" or OPTIMIZER.fullmatch(value):
        return config
    path = PATH.fullmatch(value)
    if path is not None and path[1] in _known_paths():
        return _known_paths()[path[1]]
    refusal = f"{source} names {printable(value, SHORT)}, which is no part of models or data in this package"
    if not trust and not _belongs_to_user(source, run):
        raise WeightsError(f"{refusal}; if it is a module of your own, and you trust who made the file: trust=true")
    if own_part(value) is None:
        places = "which lies in the working folder or in one of PYTHONPATH"
        raise WeightsError(f"{refusal}, and not defined in a module of your own, {places} (SECURITY.md)")
    return value


@cache
def _known_paths() -> dict[str, str]:
    """Return the paths of all parts of models and data in `conf/`, by the names of the classes and functions."""
    files = [file for group in GROUPS for file in (conf_folder() / group).glob("*.yaml")]
    return {path.rpartition(".")[2]: path for file in files for path in TARGET.findall(file.read_text())}


def _belongs_to_user(file: Path, run: Path) -> bool:
    """Whether the user owns a run below the working folder, and has therefore made it or brought it there.

    The hub's client brings files into its cache without the user. The working folder itself must not be the run's,
    because modules that came with it would pass as the user's.
    """
    downloaded = Path(constants.HF_HUB_CACHE).resolve() in run.parents
    return not downloaded and Path.cwd() in run.parents and {run.stat().st_uid, file.stat().st_uid} == {os.getuid()}
