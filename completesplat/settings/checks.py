"""Checks of the settings of verbs and of their parts, made before any work begins."""

import re
from collections.abc import Iterator, Mapping
from contextlib import suppress
from typing import Any

from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, ListConfig, Node, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from completesplat.errors import CompleteSplatError
from completesplat.settings.options import did_you_mean
from completesplat.settings.schema import VERBS, arguments_of, check_settings, check_value

Container = DictConfig | ListConfig

REFERENCE = re.compile(r"\$\{(\w[\w.]*)\}")
REMOVE = "remove"
COPYING = re.compile("ddp_(spawn|fork|notebook)")
"""Lightning's strategies whose processes work on copies of the model and its callbacks."""
# Settings of weights that training starts from, in all parts, with examples.
START_WEIGHTS = {
    "pretrained": "CompVis/stable-diffusion-v1-4, or null for random weights",
    "autoreconstructor_checkpoint": "RUN/checkpoints/last.ckpt of stage 1",
    "checkpoint": "RUN/checkpoints/last.ckpt",
}
# Settings that are networks each of whose `channels` but the last halves the sides of images.
HALVING_NETWORKS = ("encoder", "denoiser", "model")
HYDRA_KEYS = ("_target_", "_partial_", "_recursive_", "_convert_", "_args_")


def check_values(verb: str, config: DictConfig) -> None:
    """Raise CompleteSplatError for the first unfit setting of a verb itself, without importing torch."""
    for group in ("experiment", "ablation", "hparams_search", "debug"):
        if group in config:
            message = "its file needs `# @package _global_` as its first line, to set anything"
            raise CompleteSplatError(f"{group}: {message}")
    strategy = str(OmegaConf.select(config, "trainer.strategy", throw_on_missing=False))
    if COPYING.match(strategy):
        reason = "its processes do not give back what training keeps, such as the best checkpoint; take ddp"
        raise CompleteSplatError(f"trainer.strategy={strategy}: {reason}")
    if verb in VERBS:
        check_settings(VERBS[verb], config)


def check_parts_of_verb(verb: str, config: DictConfig) -> None:
    """Complete a verb's task.

    Raises:
        CompleteSplatError: a setting of its parts does not fit, except for `view`.
    """
    if "task" in config:
        complete_task(config)
    if verb != "view":  # `view` shows its page before it imports torch, so it checks its parts later
        check_parts(config)


def complete_task(config: DictConfig) -> None:
    """Let a config's task refer to the settings of the config that have the names of its function's arguments."""
    hints, _ = part_arguments(config.task)
    with open_dict(config):
        for name in hints.keys() & config.keys():
            if name != "out" and name not in config.task:
                config.task[name] = f"${{{name}}}"


def check_parts(config: Container, place: str = "") -> None:
    """Check each mapping with a `_target_`, and all below it, against the arguments of that class or function."""
    hints, complete = part_arguments(config)
    name: Any
    for name in config if isinstance(config, DictConfig) else range(len(config)):
        if OmegaConf.is_missing(config, name):
            continue
        try:
            value = config[name]
            plain = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
        except OmegaConfBaseException:  # it refers to something that is missing
            continue
        key = _origin(config, name, f"{place}.{name}".lstrip("."))
        if complete and name not in (*hints, *HYDRA_KEYS):
            raise CompleteSplatError(f"{config._target_} has no setting {name} ({key}){did_you_mean(name, hints)}")
        if name in hints:
            check_value(key, hints[name], plain)
        if OmegaConf.is_config(value) and not OmegaConf.is_interpolation(config, name):
            check_parts(value, key)


def each_part(config: object) -> Iterator[tuple[DictConfig, Any]]:
    """Yield each part of a config, the outer ones first, with the class or function that makes it."""
    if isinstance(config, DictConfig) and config.get("_target_") is not None:
        with suppress(Exception):  # building the part reports what cannot be imported
            yield config, get_object(config._target_)
    if isinstance(config, DictConfig | ListConfig):
        names: Any = config if isinstance(config, DictConfig) else range(len(config))
        for name in [name for name in names if not OmegaConf.is_missing(config, name)]:
            with suppress(OmegaConfBaseException):  # it refers to something that is missing
                yield from each_part(config[name])


def remove_start_weights(config: DictConfig) -> None:
    """Set all weights that training starts from to null, in all parts of a config, also where they are missing."""
    for part, _ in each_part(config):
        part.update(dict.fromkeys(part.keys() & START_WEIGHTS.keys()))


def part_arguments(config: Container) -> tuple[Mapping[str, object], bool]:
    """Return a part's `arguments_of`, or none if it cannot be imported, because building the part reports that."""
    target = config.get("_target_") if isinstance(config, DictConfig) else None
    if target is None:
        return {}, False
    try:
        return arguments_of(get_object(target))
    except Exception:
        return {}, False


def _origin(config: Container, name: Any, place: str) -> str:
    """Return the setting to which a place refers for its value, or the place itself."""
    root = config._get_root()
    raw = config._get_node(name)
    while isinstance(raw, Node):
        reference = REFERENCE.fullmatch(str(raw._value()))
        if reference is None:
            break
        place = reference[1]
        above, _, last = place.rpartition(".")
        parent = OmegaConf.select(root, above) if above else root
        raw = parent._get_node(last) if isinstance(parent, DictConfig) else None
    return place


def check_image_size(config: DictConfig) -> None:
    """Raise CompleteSplatError if training images cannot be halved as often as the networks halve them."""
    size = config.data.get("image_size")
    reason = None if size is None else unfit_image_size(size, config.get("model"))
    if reason is not None:
        raise CompleteSplatError(f"data.image_size={size}: {reason}")


def unfit_image_size(size: int, model: object) -> str | None:
    """Return why images of this size do not fit the networks in a model's config, or None."""
    multiple = 2 ** _halvings("model", model)
    if size % multiple == 0:
        return None
    near = max(multiple, round(size / multiple) * multiple)
    return f"must be a multiple of {multiple} for the levels of these networks, such as {near}"


def _halvings(setting: str, config: object) -> int:
    """Return how often the networks in the config of a setting halve the sides of images."""
    if not isinstance(config, DictConfig):
        return 0
    count = len(config.channels) - 1 if setting in HALVING_NETWORKS and "channels" in config else 0
    for name in [name for name in config if not OmegaConf.is_missing(config, name)]:
        with suppress(OmegaConfBaseException):  # it refers to something that is missing
            count += _halvings(str(name), config[name])
    return count


def check_optimizer(config: DictConfig | None) -> None:
    """Raise CompleteSplatError for settings that the optimizer refuses, if there is one, before a model is built."""
    from torch import nn, zeros

    try:
        if config is not None:
            instantiate(config, _convert_="all")([nn.Parameter(zeros(1))])
    except (ValueError, TypeError) as error:
        raise CompleteSplatError(f"optimizer: {error}") from error
