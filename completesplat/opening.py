"""Saved configs, of runs and in checkpoints: what they may name before anything is built from them (SECURITY.md)."""

import os
import re
import sysconfig
from collections.abc import Iterator, Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from hydra.utils import get_object
from omegaconf import OmegaConf

from completesplat.errors import WeightsError
from completesplat.settings.options import conf_folder
from completesplat.settings.schema import shown
from completesplat.weights import read_small

ONLY_FOR_TRAINING = (
    "model.autoreconstructor_checkpoint",
    "model.checkpoint",
    "model.model.pretrained",
    "model.completesplat.autoreconstructor.pretrained",
    "model.completesplat.conditioning.pretrained",
    "model.loss.terms.lpips",
)
"""Weights that training read before its first step or for its loss; a checkpoint holds what became of them."""
OF_A_RUN = ["model", "data"]
GROUPS = {"ablation", "autoreconstructor", "conditioning", "data", "denoiser", "experiment", "loss", "model"}
GROUPS |= {"objective", "optimizer", "posterior", "rasterizer", "regressor", "sampler", "schedule"}
"""Groups of `conf/` that models and data are composed of."""
TARGET = re.compile(r"_target_: *([\w.]+)")
OPTIMIZER = re.compile(r"torch\.optim\.[A-Z]\w*")


def read_run_config(path: Path, trust: bool) -> Any:
    """Return model and data in the `config.yaml` of a run.

    Raises:
        WeightsError: the file cannot be read, lacks one of them, or names what `check_names` refuses.
    """
    try:
        written: Any = OmegaConf.create(read_small(path))
        config = OmegaConf.masked_copy(written, OF_A_RUN)
    except Exception as error:  # of YAML and of OmegaConf
        raise WeightsError(f"{path}: not a run's configuration ({type(error).__name__})") from error
    if any(config.get(part) is None for part in OF_A_RUN):
        raise WeightsError(f"{path}: not the configuration of a run of fit, which has {' and '.join(OF_A_RUN)}")
    check_names(OmegaConf.to_container(config, resolve=False), path, path.resolve().parent, trust)
    return config


def check_names(config: Any, source: Path, run: Path, trust: bool) -> None:
    """Refuse a config of the file `source` that names anything but parts of models and data, which may be the user's.

    It may name what `conf/` names for models and data, or an optimizer of torch. Where the run is trusted, or belongs
    to the user, it may also name modules of the user's own, such as those in the working folder.

    Args:
        run: the run's folder, without links. It is the user's if the user owns it and `source`, and it lies below the
            working folder.

    Raises:
        WeightsError: the config names something else.
    """
    files = [file for group in GROUPS for file in (conf_folder() / group).glob("*.yaml")]
    known = {name for file in files for name in TARGET.findall(file.read_text())}
    for name, value in _strings(config):
        # `fit` writes what it has resolved; a resolver can read the environment and more.
        if "${" in value:
            refusal = f"{source}: {shown(value)} refers to something else"
            raise WeightsError(f"{refusal}, which a run's configuration does not")
        if name != "_target_" or value in known or OPTIMIZER.fullmatch(value):
            continue
        refusal = f"{source} names {shown(value)}, which is no part of models or data in this package"
        if not trust and not _belongs_to_user(source, run):
            raise WeightsError(f"{refusal}; if it is a module of your own, and you trust who made the run: trust=true")
        if not _is_own(value):
            raise WeightsError(f"{refusal}, and not defined in a module of your own (SECURITY.md)")


def without_training(config: Any) -> Any:
    """Remove from a config what only training needs: other weights (`ONLY_FOR_TRAINING`), and a GPU.

    Where there is a GPU, `rasterizer=auto` is the same as `cuda`.
    """
    for key in ONLY_FOR_TRAINING:
        parent, _, name = key.rpartition(".")
        if name in list(OmegaConf.select(config, parent) or ()):  # also where its value is missing
            OmegaConf.update(config, key, None)
    for place in ("model.rasterizer", "model.rasterizer.rasterizer"):
        if OmegaConf.select(config, f"{place}._target_") == "completesplat.rasterizers.selection.cuda":
            OmegaConf.update(config, f"{place}._target_", "completesplat.rasterizers.selection.auto")
    return config


def _strings(config: Any, name: Any = "") -> Iterator[tuple[Any, str]]:
    """Yield all keys and values as text, each with the name of the setting that it belongs to."""
    if isinstance(config, Mapping):
        for key, value in config.items():
            yield name, str(key)
            yield from _strings(value, key)
    elif isinstance(config, list):
        for value in config:
            yield from _strings(value, name)
    else:
        yield name, str(config)


def _belongs_to_user(file: Path, run: Path) -> bool:
    """Whether a run lies below the working folder and is the user's, who has then made or brought it there.

    In the run's own folder, modules that came with it would count as the user's.
    """
    return Path.cwd() in run.parents and {run.stat().st_uid, file.stat().st_uid} == {os.getuid()}


def _is_own(target: str) -> bool:
    """Whether the target is defined in a module that is neither this package's nor of Python's installation."""
    top = target.partition(".")[0]
    try:
        spec = find_spec(top)  # of a name without a dot: nothing is imported
    except (ImportError, ValueError):
        return False
    if spec is None or top == "completesplat":
        return False
    places = [spec.origin] if spec.has_location else spec.submodule_search_locations or []
    if not places or any(_is_installed(Path(str(place)).resolve()) for place in places):
        return False
    try:
        part = get_object(target)
    except (ImportError, ValueError) as error:
        raise WeightsError(f"{target}: cannot be imported ({error})") from error
    # A module of the user's own leads to others, by the names that it imports.
    return str(getattr(part, "__module__", None)).partition(".")[0] == top


def _is_installed(path: Path) -> bool:
    libraries = {Path(sysconfig.get_path(name)).resolve() for name in ("stdlib", "platstdlib", "purelib", "platlib")}
    return not {"site-packages", "dist-packages"}.isdisjoint(path.parts) or not libraries.isdisjoint(path.parents)
