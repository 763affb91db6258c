"""Composition of a verb's config by Hydra: search path, resolvers, arguments of sweeps, errors with nearest names."""

import hashlib
import re
import secrets
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from typing import Any, cast

from hydra import compose as compose_by_hydra
from hydra import initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

from completesplat.errors import CompleteSplatError
from completesplat.settings.arguments import for_hydra
from completesplat.settings.checks import part_arguments
from completesplat.settings.options import LEAST_LIKE, conf_folder, did_you_mean, groups, options, search_settings

RUN_NAME = f"{time.strftime('%Y-%m-%d_%H-%M-%S')}-{secrets.token_hex(3)}"
NOT_THERE = re.compile(r"Could not override '([^']+)'")
LONGEST_NAME = 120
PARTS_OF_STAGES = {"autoreconstructor", "regressor", "conditioning", "denoiser", "sampler", "objective"}


class SettingsOfWorkingFolder(SearchPathPlugin):
    """Hydra plugin that finds further options of the config groups in `./conf`; the package's own come first."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append `./conf`, if it exists, to the search path (Hydra calls this method)."""
        folder = Path.cwd() / "conf"
        if folder.is_dir() and not folder.samefile(conf_folder()):
            search_path.append("working-folder", f"file://{folder}")


def use_working_folder() -> None:
    """Append the working folder to `sys.path`, and its `conf` to Hydra's search path; each process must call this."""
    folder = str(Path.cwd())
    if not {"", folder} & set(sys.path):
        sys.path.append(folder)
    Plugins.instance().register(SettingsOfWorkingFolder)


def compose(verb: str, *overrides: str) -> DictConfig:
    """Return the config of a verb, as `completesplat VERB OVERRIDES...` composes it: `compose("fit", "trainer=ddp")`.

    Raises:
        CompleteSplatError: there is no such verb, or an override cannot be read or names no option.
    """
    if not (conf_folder() / f"{verb}.yaml").is_file():
        raise CompleteSplatError(f"no verb {verb!r}; `completesplat --help` shows those that there are")
    arguments = for_hydra(verb, overrides)
    try:
        with nearest_names(verb, arguments):
            config = _composed(verb, arguments)
    except HydraException as error:
        raise CompleteSplatError(" ".join(str(error).split())) from error
    OmegaConf.set_struct(config, False)
    return config


def _composed(verb: str, overrides: Sequence[str] = ()) -> DictConfig:
    use_working_folder()
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        return compose_by_hydra(verb, overrides=list(overrides))


def without_unused_parts(config: DictConfig) -> DictConfig:
    """Return a config without those `PARTS_OF_STAGES` to which no other part refers."""
    plain = cast(dict[str, object], OmegaConf.to_container(config, resolve=False))
    texts = {key: str(value) for key, value in plain.items()}
    used = waiting = texts.keys() - PARTS_OF_STAGES
    while waiting:
        named = {name for key in waiting for name in re.findall(r"\$\{(\w+)", texts[key])}
        waiting = (named & texts.keys()) - used
        used |= waiting
    return OmegaConf.masked_copy(config, [key for key in texts if key in used])


@contextmanager
def nearest_names(verb: str, arguments: Sequence[str]) -> Iterator[None]:
    """Raise CompleteSplatError with the nearest names in place of Hydra's error about an unknown name."""
    try:
        yield
    except (HydraException, ValueError) as error:
        if (message := _misspelt(error, verb, arguments)) is None:
            raise
        raise CompleteSplatError(message) from error


def _misspelt(error: Exception, verb: str, arguments: Sequence[str]) -> str | None:
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        group, _, option = error.missing_cfg_file.strip("/").rpartition("/")
        known = [name for name in error.options or () if not name.startswith("_")]
        kind = f"task of completesplat {verb}" if group == f"{verb}_task" else group
        return f"no {kind} {option!r}: there are {', '.join(known)}{did_you_mean(option, known)}"
    if str(error).startswith("Config group override must be"):
        empty = [text.partition("=")[0] for text in arguments if text.endswith("=null") and options(text[:-5])]
        return f"{empty[0]}=null: choose one of {', '.join(options(empty[0]))}" if empty else None
    unknown = NOT_THERE.match(str(error)) if isinstance(error, HydraException) else None
    return _unknown_setting(verb, unknown[1], arguments) if unknown else None


def _unknown_setting(verb: str, key: str, arguments: Sequence[str]) -> str:
    settings = [text for text in arguments if not text.startswith("-") and text.lstrip("+~").partition("=")[0] != key]
    try:
        config = _composed(verb, settings)
    except Exception:  # another argument is wrong, too
        config = _composed(verb)
    names = [name for name in _keys(config) if not name.startswith("task.")] + (groups() if verb == "fit" else [])
    nearest = _nearest(verb, key, list(dict.fromkeys(names)))
    above, _, last = key.rpartition(".")
    parent = OmegaConf.select(config, above, throw_on_resolution_failure=False) if above else None
    if isinstance(parent, DictConfig) and (last in part_arguments(parent)[0] or not (nearest or "_target_" in parent)):
        nearest = f"; +{key}=VALUE adds it"
    hint = f"; completesplat {verb} --help shows those that there are, --help WORD searches them"
    return f"no setting {key!r} of completesplat {verb}{nearest or hint}"


def _nearest(verb: str, key: str, names: Sequence[str]) -> str:
    """Return an ending for a message about an unknown key: settings near its last name, or found by words."""
    top = key.partition(".")[0]
    last = key.rpartition(".")[2]
    lasts = {name: name.rpartition(".")[2] for name in names}
    known = set(lasts.values())
    close = [last] if last in known else get_close_matches(last, known, cutoff=LEAST_LIKE)
    likely = [name for near in close for name in names if lasts[name] == near]
    likely = likely or [setting.key for setting, _, _ in search_settings(verb, None, [last]) if setting.key in lasts]
    likely = [name for name in likely if name.startswith(f"{top}.")] or likely
    nearest = get_close_matches(key, likely, cutoff=LEAST_LIKE) or likely[:3]
    return f"; did you mean {' or '.join(nearest)}?" if nearest else ""


def _keys(config: DictConfig, place: str = "") -> Iterator[str]:
    for name in map(str, config):
        yield f"{place}{name}"
        followed = OmegaConf.is_missing(config, name) or OmegaConf.is_interpolation(config, name)
        if not followed and isinstance(config[name], DictConfig):
            yield from _keys(config[name], f"{place}{name}.")


def sweep_arguments(verb: str, arguments: Sequence[str]) -> list[str]:
    """Return arguments to add for a sweep: its directory, and in it one for each job, named by the swept settings."""
    keys = [override.split("=")[0] for override in arguments]
    added = [] if "out" in keys else [f"out=outputs/{verb}/{RUN_NAME}"]
    if verb == "fit" and "ckpt_path" not in keys:
        added.append("ckpt_path=last")
    swept = swept_keys(arguments)
    if swept and "hydra.sweep.subdir" not in keys:
        added.append(f"hydra.sweep.subdir=${{job_name:{','.join(swept)}}}${{shard_folder:}}")
    return added


def swept_keys(arguments: Sequence[str]) -> list[str]:
    """Return the keys to which a command line gives several values (`seed=0,1`, `ablation=glob(*)`), in its order."""
    overrides = [argument for argument in arguments if "=" in argument and not argument.startswith("-")]
    parsed = OverridesParser.create().parse_overrides(overrides)
    return [override.key_or_group for override in parsed if override.is_sweep_override()]


def job_name(*keys: str, _root_: DictConfig) -> str:
    """Return the directory name for the job that Hydra is about to start: `ablation-no_skips+seed-0`.

    It has no equals signs and commas, so that paths into the directory need no quotes in Hydra's overrides.
    """
    values = dict(override.lstrip("+~").split("=", 1) for override in _root_.hydra.overrides.task if "=" in override)
    shared = shard_folder(_root_)
    full = "+".join(f"{key}-{values[key]}" for key in keys if key in values and not (shared and key == "shard"))
    name = re.sub(r"[^\w.+-]+", "_", full, flags=re.ASCII) or "."  # file systems limit bytes, not characters
    if name in (full, ".") and len(name) <= LONGEST_NAME:
        return name
    return f"{name[:LONGEST_NAME]}-{hashlib.sha256(full.encode()).hexdigest()[:8]}"


def shard_folder(_root_: Mapping[str, Any]) -> str:
    """Return the ending of a job's folder, for its record, log and lock, if it shares `out` with other jobs."""
    return f"/shard-{_root_['shard']}" if _root_.get("shards", 1) != 1 else ""


def has_bfloat16(device: str) -> bool:
    """Return whether a device of this type ("cuda", "cpu", ...) computes in bfloat16 itself."""
    import torch

    if device == "cuda":
        return bool(torch.cuda.is_bf16_supported(including_emulation=False))
    return device == "cpu" and bool(torch.cpu._is_avx512_bf16_supported())


def best_precision() -> str:
    """Return Lightning's precision for networks: bfloat16 where the GPU, or else the CPU, supports it, or float32."""
    import torch

    return "bf16-mixed" if has_bfloat16("cuda" if torch.cuda.is_available() else "cpu") else "32-true"


# Resolvers used in `conf/`. Jobs that a cluster starts import this module, too.
OmegaConf.register_new_resolver("run_name", lambda: RUN_NAME, replace=True)
OmegaConf.register_new_resolver("best_precision", best_precision, replace=True)
OmegaConf.register_new_resolver("job_name", job_name, replace=True)
OmegaConf.register_new_resolver("shard_folder", shard_folder, replace=True)
