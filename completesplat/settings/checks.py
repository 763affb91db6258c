"""Checks of the settings of verbs and of their parts, made before any work begins."""

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, Literal, TypedDict

from hydra.errors import HydraException, MissingConfigException
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from completesplat.errors import CompleteSplatError
from completesplat.settings.options import meant, options
from completesplat.settings.schema import Positive, Range, Seed, Share, arguments_of, check_settings, check_value

REFERENCE = re.compile(r"\$\{(\w[\w.]*)\}")
NOT_THERE = re.compile(r"Could not override '([^']+)'")
REMOVE = "remove"
HYDRAS = ("_target_", "_partial_", "_recursive_", "_convert_", "_args_")
# Channels of a network by level; each level but the last halves the sides of the image.
LEVELS = (
    "model.completesplat.autoreconstructor.encoder.channels",
    "model.completesplat.denoiser.channels",
    "model.model.encoder.channels",
    "model.model.channels",
    "model.vae.encoder.channels",
)


class Trainer(TypedDict):
    """Settings whose ranges Lightning does not check."""

    accumulate_grad_batches: Positive
    val_check_interval: Annotated[float, Range(1e-6)] | str | Mapping[str, int] | None
    check_val_every_n_epoch: Positive | None
    gradient_clip_val: Annotated[float, Range(0)] | None


class Fit(TypedDict):
    """Settings of `completesplat fit`."""

    trainer: Trainer
    seed: Annotated[int, Range(0, 2**32 - 1)]
    ckpt_path: str | None
    test: bool
    optimized_metric: str | None


class SceneSettings(TypedDict):
    """Settings that `completesplat predict` and `view` share."""

    weights: str
    skip_weight: Share | None
    guidance_weight: Share
    steps: Annotated[int, Range(1, 1000)] | None
    fov: float | None
    frames: Annotated[int, Range(1, 1000)]
    background: Share | Literal["remove"]


class Predict(SceneSettings):
    """Settings of `completesplat predict`. All samples of an image, or frames of a video, are in memory at once."""

    samples: Annotated[int, Range(1, 1000)]
    seed: Seed
    batch: Positive | None
    screen_space_dilation: bool
    maps: bool


class View(SceneSettings):
    """Settings of `completesplat view`."""

    samples: Annotated[int, Range(1, 8)]
    seed: Annotated[int, Range(0, 2**31)]
    port: Annotated[int, Range(1, 65535)]


class OfRun(TypedDict):
    """Settings of every verb that reads a run."""

    overrides: Sequence[str]


class Test(OfRun):
    """Settings of `completesplat test`."""

    ckpt: str | None
    weights: str | None
    seed: Annotated[int, Range(0, 2**32 - 1)]
    trust: bool


OF_VERBS: dict[str, type] = {"fit": Fit, "predict": Predict, "view": View, "test": Test}


def check_verb(verb: str, config: Any) -> None:
    """Raise CompleteSplatError for the first unfit setting of a verb or, except for `view`, of its parts."""
    check_settings(OF_VERBS.get(verb, OfRun), config)
    if verb != "view":  # `view` shows its page before it imports torch, so it checks its parts later
        check_parts(config)


def check_parts(config: Any, place: str = "") -> None:
    """Check each mapping with a `_target_`, and all below it, against the arguments of that class or function."""
    hints, complete = _arguments(config)
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
        if complete and name not in (*hints, *HYDRAS):
            raise CompleteSplatError(f"{config._target_} has no setting {name} ({key}){meant(name, hints)}")
        if isinstance(plain, float) and math.isnan(plain):
            raise CompleteSplatError(f"{key}=nan: must be a number")
        if name in hints:
            check_value(key, hints[name], plain)
        if OmegaConf.is_config(value) and not OmegaConf.is_interpolation(config, name):
            check_parts(value, key)


def _arguments(config: Any) -> tuple[Mapping[str, Any], bool]:
    """Return a part's `arguments_of`, or none if it cannot be imported, because building the part reports that."""
    try:
        target = None if isinstance(config, ListConfig) else config.get("_target_")
        return ({}, False) if target is None else arguments_of(get_object(target))
    except Exception:
        return {}, False


def _origin(config: Any, name: Any, place: str) -> str:
    """Return the setting to which a place refers for its value, or the place itself."""
    root = config._get_root()
    raw = config._get_node(name)
    while (reference := REFERENCE.fullmatch(str(raw._value()) if raw is not None else "")) is not None:
        place = reference[1]
        *above, last = place.split(".")
        parent = OmegaConf.select(root, ".".join(above)) if above else root
        raw = parent._get_node(last) if isinstance(parent, DictConfig) else None
    return place


def check_image_size(config: Any) -> None:
    """Raise CompleteSplatError if training images cannot be halved as often as the networks halve them."""
    channels = [OmegaConf.select(config, key, throw_on_missing=False) for key in LEVELS]
    multiple = 2 ** sum(len(widths) - 1 for widths in channels if widths is not None)
    size = config.data.get("image_size")
    if size is not None and size % multiple:
        near = max(multiple, round(size / multiple) * multiple)
        message = f"must be a multiple of {multiple} for the levels of these networks, such as {near}"
        raise CompleteSplatError(f"data.image_size={size}: {message}")


def check_optimizer(config: Any) -> None:
    """Raise CompleteSplatError for settings that the optimizer refuses, if there is one, before a model is built."""
    from torch import nn, zeros

    try:
        if config is not None:
            instantiate(config, _convert_="all")([nn.Parameter(zeros(1))])
    except (ValueError, TypeError) as error:
        raise CompleteSplatError(f"optimizer: {error}") from error


def misspelt(error: Exception, verb: str, arguments: Sequence[str], compose: Any) -> CompleteSplatError | None:
    """Return Hydra's error with the nearest names, None if no name is wrong; `compose` returns a verb's config."""
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, option = error.missing_cfg_file.strip("/").rpartition("/")
        named = [name for name in error.options or () if not name.startswith("_")]
        kind = f"task of completesplat {verb}" if group == f"{verb}_task" else group
        return CompleteSplatError(f"no {kind} {option!r}: there are {', '.join(named)}{meant(option, named)}")
    if str(error).startswith("Config group override must be"):
        empty = [text.partition("=")[0] for text in arguments if text.endswith("=null") and options(text[:-5])]
        return CompleteSplatError(f"{empty[0]}=null: choose one of {', '.join(options(empty[0]))}") if empty else None
    if not isinstance(error, HydraException) or (unknown := NOT_THERE.match(str(error))) is None:
        return None
    key, names = unknown[1], set(_keys(_composed(verb, arguments, unknown[1], compose)))
    nearest = meant(key, {name for name in names if name.count(".") == key.count(".")}) or meant(key, names)
    hint = nearest or f"; completesplat {verb} --help shows those that there are, and +{key}=VALUE adds one"
    return CompleteSplatError(f"no setting {key!r} of completesplat {verb}{hint}")


def _composed(verb: str, arguments: Sequence[str], key: str, compose: Any) -> Any:
    """Compose a verb's config without the setting `key`, or without any arguments if that fails."""
    settings = [text for text in arguments if not text.startswith("-") and text.lstrip("+~").partition("=")[0] != key]
    try:
        return compose(verb, *settings)
    except Exception:
        return compose(verb)


def _keys(config: Any, place: str = "") -> Iterator[str]:
    """Yield all keys of a config with their places, without following references."""
    for name in config:
        key = f"{place}{name}"
        yield key
        if OmegaConf.is_missing(config, name) or OmegaConf.is_interpolation(config, name):
            continue
        if isinstance(config[name], DictConfig):
            yield from _keys(config[name], f"{key}.")
