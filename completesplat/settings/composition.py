"""Composition of a verb's config by Hydra: search path, resolvers, arguments of sweeps, nearest names."""

import hashlib
import re
import secrets
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hydra import compose as compose_by_hydra
from hydra import initialize_config_dir
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.errors import HydraException, MissingConfigException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import DictConfig, OmegaConf

from completesplat.errors import CompleteSplatError
from completesplat.installation import install_command
from completesplat.settings.arguments import for_hydra
from completesplat.settings.options import conf_folder, did_you_mean, folders, groups, options
from completesplat.settings.sweeps import swept_overrides

RUN_NAME = f"{time.strftime('%Y-%m-%d_%H-%M-%S')}-{secrets.token_hex(3)}"
UNKNOWN_KEY = re.compile(r"Could not override '([^']+)'\.\s*(?:To append to your config use .*)?")
LONGEST_NAME = 120


class FurtherOptions(SearchPathPlugin):
    """Hydra plugin that finds further options of the config groups, in extensions and in `./conf`.

    The package's own come first.
    """

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append all other folders of options to the search path (Hydra calls this method)."""
        for folder in folders():
            if not folder.samefile(conf_folder()):
                search_path.append("further-options", f"file://{folder}")


def use_working_folder() -> None:
    """Append the working folder to `sys.path`, and its `conf` and those of extensions to Hydra's search path.

    Each process must call this.
    """
    folder = str(Path.cwd())
    if not {"", folder} & set(sys.path):
        sys.path.append(folder)
    Plugins.instance().register(FurtherOptions)


def compose(verb: str, *overrides: str) -> DictConfig:
    """Return the config of a verb, as `completesplat VERB OVERRIDES...` composes it: `compose("fit", "trainer=ddp")`.

    Raises:
        CompleteSplatError: there is no such verb, or an override cannot be read or names no option.
    """
    if not (conf_folder() / f"{verb}.yaml").is_file():
        raise CompleteSplatError(f"no verb {verb!r}; `completesplat --help` shows those that there are")
    arguments = for_hydra(verb, overrides)
    try:
        with nearest_names(verb):
            config = _composed(verb, arguments)
    except HydraException as error:
        raise CompleteSplatError(" ".join(str(error).split())) from error
    OmegaConf.set_struct(config, False)
    return config


def _composed(verb: str, overrides: Sequence[str] = ()) -> DictConfig:
    if GlobalHydra.instance().is_initialized():  # in a job, with the folders that the command was given
        return compose_by_hydra(verb, overrides=list(overrides))
    use_working_folder()
    with initialize_config_dir(str(conf_folder()), version_base="1.3"):
        return compose_by_hydra(verb, overrides=list(overrides))


@contextmanager
def nearest_names(verb: str) -> Iterator[None]:
    """Raise CompleteSplatError with the nearest name after Hydra's error about a name that does not exist."""
    try:
        yield
    except MissingConfigException as error:
        group, _, option = (error.missing_cfg_file or "").strip("/").rpartition("/")
        if (group, option) == ("hydra/sweeper", "optuna"):
            raise CompleteSplatError(
                f"a search by Optuna needs the extra optuna: {install_command('optuna')}"
            ) from error
        known = options(group)
        if not known:
            raise
        message = f"no {group} {option!r}: there are {', '.join(known)}{did_you_mean(option, known)}"
        raise CompleteSplatError(message) from error
    except HydraException as error:
        unknown = UNKNOWN_KEY.match(str(error))
        if unknown is None:
            raise
        names = {*setting_names(_composed(verb)), *groups()}
        message = f"{unknown[0]}{did_you_mean(unknown[1], names)}"
        raise CompleteSplatError(message) from error
    except ValueError as error:
        if not str(error).startswith("Config group override must be"):  # `group=null`
            raise
        raise CompleteSplatError(str(error)) from error


def setting_names(config: DictConfig, place: str = "") -> Iterator[str]:
    """Yield the names of all settings of a config and of its parts."""
    for name in map(str, config):
        yield f"{place}{name}"
        refers = OmegaConf.is_missing(config, name) or OmegaConf.is_interpolation(config, name)
        if not refers and isinstance(config[name], DictConfig):
            yield from setting_names(config[name], f"{place}{name}.")


def sweep_arguments(verb: str, arguments: Sequence[str]) -> list[str]:
    """Return arguments to add for a sweep: its directory, and in it one for each job, named by the swept settings."""
    keys = [override.split("=")[0] for override in arguments]
    swept = swept_keys(arguments)
    added = []
    if "out" not in keys:
        added.append(f"out=outputs/{verb}/{RUN_NAME}")
    if verb == "fit" and "ckpt_path" not in keys:
        added.append("ckpt_path=last")
    if swept and "hydra.sweep.subdir" not in keys:
        added.append(f"hydra.sweep.subdir=${{job_name:{','.join(swept)}}}${{shard_folder:}}")
    return added


def swept_keys(arguments: Sequence[str]) -> list[str]:
    """Return the keys to which a command line gives several values (`seed=0,1`, `ablation=glob(*)`), in its order."""
    return [override.key_or_group for override in swept_overrides(arguments)]


def typed_keys(overrides: Sequence[str]) -> list[str]:
    """Return the keys of a job's overrides."""
    return [override.key_or_group for override in OverridesParser.create().parse_overrides(list(overrides))]


def job_name(*keys: str, _root_: DictConfig) -> str:
    """Return the directory name for the job that Hydra is about to start: `ablation-no_skips+seed-0`.

    It has the settings `keys`, and those that the sweeper's config searches over (`hydra.sweeper.params`).
    It has no equals signs and commas, so that paths into the directory need no quotes in Hydra's overrides.
    """
    values = dict(override.lstrip("+~").split("=", 1) for override in _root_.hydra.overrides.task if "=" in override)
    shared = shard_folder(_root_)
    searched = OmegaConf.select(_root_, "hydra.sweeper.params") or {}
    unnamed = {"shard"} if shared else set()
    parts = [f"{key}-{values[key]}" for key in dict.fromkeys([*keys, *searched]) if key in values.keys() - unnamed]
    full = "+".join(parts)
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
