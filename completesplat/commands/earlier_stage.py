"""The architecture of stage 1, which stage 2 takes from the checkpoint that it starts from."""

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from completesplat.commands.continuing import differences
from completesplat.errors import CompleteSplatError
from completesplat.weights import RUN_CHECKPOINT

START = ("model.autoreconstructor_checkpoint", "model.checkpoint", "ckpt_path")
"""Settings of stage 2 that name a checkpoint with stage 1's weights; that of `ckpt_path=last` has the same settings."""
PLACES = ("autoreconstructor", "model.completesplat.autoreconstructor")
KIND = "VariationalAutoReconstructor"

logger = logging.getLogger(__name__)


def start_checkpoint(path: str | Path) -> Path:
    """Return the checkpoint that training starts from: the file itself, or the newest one of a run's folder."""
    return Path(path, RUN_CHECKPOINT) if Path(path).is_dir() else Path(path)


def take_architecture(config: DictConfig) -> str | None:
    """Replace the autoreconstructor's settings of stage 2 by those that its weights were trained with.

    An ablation of stage 1 is so given once. Files without a config, and those of the user's own classes, leave the
    settings as they are; the weights' own check then compares the shapes.

    Returns:
        The settings that have changed, in one line, or None if none has.
    """
    if OmegaConf.is_missing(config, "model") or "completesplat" not in (config.get("model") or {}):
        return None
    given = [OmegaConf.select(config, key) for key in START]
    paths = [start_checkpoint(path) for path in given if path and path != "last"]
    trained = _trained(paths[0]) if paths and paths[0].is_file() else None
    if trained is None:
        return None
    before = OmegaConf.to_container(config.model.completesplat.autoreconstructor, resolve=True)
    changed = sorted(differences(before, trained))
    for place in PLACES:
        above, _, name = place.rpartition(".")
        parent = OmegaConf.select(config, above) if above else config
        if isinstance(parent, DictConfig) and name in parent and not OmegaConf.is_interpolation(parent, name):
            parent[name] = trained
    settings = [f"autoreconstructor.{key}" for key in changed if not key.endswith("pretrained")]
    return f"as stage 1 was trained ({paths[0]}): {_described(config, settings)}" if settings else None


def _described(config: DictConfig, settings: list[str]) -> str:
    values = []
    for setting in settings:
        try:
            value = OmegaConf.select(config, f"model.completesplat.{setting}")
        except OmegaConfBaseException:
            value = None
        values.append(f"{setting}={value}")
    return ", ".join(values)


def _trained(checkpoint: Path) -> dict[str, Any] | None:
    """Return the autoreconstructor's config in a checkpoint of stage 1 or 2, None if it cannot be had."""
    from completesplat.weights.checkpoint_reading import read_tensor_file
    from completesplat.weights.runs import config_of_checkpoint

    try:
        contents = read_tensor_file(checkpoint, mmap=True)
        model: Any = config_of_checkpoint(checkpoint, contents, trust=False)["model"]
    except CompleteSplatError as error:  # a file that cannot be used is refused when its weights are read
        logger.debug("%s: its config is not taken: %s", checkpoint, error)
        return None
    for part in (model.get("model"), (model.get("completesplat") or {}).get("autoreconstructor")):
        if isinstance(part, Mapping) and str(part.get("_target_")).endswith(f".{KIND}"):
            return dict(part) | {"pretrained": None}
    return None
