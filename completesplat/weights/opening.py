"""Configs and tensors of weights, and of runs whose models make scenes from photos: the one way to a stored model."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch
from safetensors.torch import load_file
from torch import Tensor

from completesplat.errors import WeightsError
from completesplat.weights import CAMERA, CONFIG_FILE, RUN_WEIGHTS, SCENES, WEIGHTS_FILE, locate, read_small
from completesplat.weights.allowed import ConfigOrigin, check_architecture, check_names, stored_config
from completesplat.weights.checkpoint_reading import read_checkpoint
from completesplat.weights.runs import read_run_config
from completesplat.wording import SHORT, printable

# The classes of runs whose models make scenes from photos: the setting of the model, which begins its tensors' names.
STAGES = {"LatentDiffusion": "completesplat", "ReconstructionModule": "model"}


class StoredModel(NamedTuple):
    """A model as files hold it: its config, which `check_architecture` has accepted, and its tensors by name."""

    architecture: dict[str, Any]
    tensors: dict[str, Tensor]
    config_file: Path
    tensor_file: Path


def read_model(weights: Path | str, trust: bool) -> StoredModel:
    """Read what a name, folder, run, checkpoint or hub id stands for (`locate`).

    Raises:
        WeightsError: a file is missing or unreadable, the run's model makes no scene from a photo, or the config names
            what `check_names` and `check_architecture` do not allow.
    """
    file = locate(weights)
    return _read_weights(file, trust) if file.name == WEIGHTS_FILE else _read_run(file, trust)


def _read_weights(file: Path, trust: bool) -> StoredModel:
    path = file.with_name(CONFIG_FILE)
    try:
        config = json.loads(read_small(path))
    except (ValueError, RecursionError) as error:
        raise WeightsError(f"{path}: not readable as JSON ({error})") from error
    folder = path.resolve().parent
    run = folder.parent if folder.name == RUN_WEIGHTS else folder
    return StoredModel(_allowed(config, ConfigOrigin(path, run, trust)), load_file(file), path, file)


def _read_run(checkpoint: Path, trust: bool) -> StoredModel:
    """Read the model of a run from its config and a checkpoint, with averaged tensors if it has such."""
    path, config = read_run_config(checkpoint)
    target = printable(config["model"].get("_target_"), SHORT)
    stage = target.rpartition(".")[2]
    if stage not in STAGES:
        fitted = path.parent / SCENES
        advice = f"; those that it fitted are in {fitted}" if fitted.is_dir() else ""
        raise WeightsError(f"{path} names {target}: a run of {stage} makes no scene of a photograph{advice}")
    part = config["model"].get(STAGES[stage])
    origin = ConfigOrigin(path, path.resolve().parent, trust)
    prefix = f"{STAGES[stage]}."
    if stage == "ReconstructionModule":
        settings = {"network": part, "image_size": config["data"].get("image_size")}
        architecture = _allowed(stored_config(settings), origin)
        contents = read_checkpoint(checkpoint)
        tensors = _tensors_below(prefix, contents, "network.") | camera_tensors(contents.get(CAMERA, {}))
    else:
        given = dict(part) if isinstance(part, Mapping) else {}
        settings = {name: value for name, value in given.items() if name not in ("_target_", "_recursive_")}
        architecture = _allowed(stored_config(settings), origin)
        tensors = _tensors_below(prefix, read_checkpoint(checkpoint))
    return StoredModel(architecture, tensors, path, checkpoint)


def _allowed(config: Any, origin: ConfigOrigin) -> dict[str, Any]:
    """Return a model's config as weights store it; raise WeightsError for what the list does not allow."""
    named = check_names(config, origin)
    check_architecture(named, origin.file)
    stored: dict[str, Any] = stored_config(named)
    return stored


def _tensors_below(prefix: str, contents: Mapping[str, Any], new_prefix: str = "") -> dict[str, Tensor]:
    tensors = contents["state_dict"]
    return {new_prefix + name.removeprefix(prefix): x for name, x in tensors.items() if name.startswith(prefix)}


def camera_tensors(camera: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return a training set's typical camera as tensors of a `SceneModel`; raise WeightsError if one is not known."""
    try:
        return {name: torch.tensor(camera[name], dtype=torch.float32) for name in ("fov_degrees", "depth_range", "up")}
    except (KeyError, TypeError, ValueError) as error:
        raise WeightsError("the training set's typical camera is not known") from error
