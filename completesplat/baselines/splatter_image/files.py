"""Files of Splatter Image's published weights (Szymanowicz et al., CVPR 2024), as they are on the hub.

`config_NAME.yaml` is Hydra's record of a training run, of which a few options are read as data. `model_NAME.pth` is a
checkpoint of torch with `model_state_dict`. The weights for objects of all kinds are in `model_latest.pth`.
"""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, NamedTuple

import torch
import yaml
from torch import Tensor

from completesplat.errors import TensorFileError, WeightsError
from completesplat.files import SHORT, atomic_path, make_folder, printable, write_text
from completesplat.settings.schema import Entries, Few, Natural, Range, Width, refused
from completesplat.weights import RUN_WEIGHTS, from_hub, read_small
from completesplat.weights.checkpoint_reading import read_tensor_file

HUB = "szymanowiczs/splatter-image-v1"
PREFIX = "splatter_image:"
STATE = "model_state_dict"
GENERAL, GENERAL_FILE = "objaverse", "model_latest.pth"
MODEL_FILE = re.compile(r"model_(\w+)\.pth")


# Options that are read, by section; all published weights for one image share the literal values.
SECTIONS: dict[str, dict[str, object]] = {
    "data": {
        "training_resolution": Annotated[int, Range(8, 1024)],
        "znear": Annotated[float, Range(-1e6, 1e6)],
        "zfar": Annotated[float, Range(-1e6, 1e6)],
        "white_background": bool,
        "origin_distances": bool,
        "input_images": Literal[1],
    },
    "model": {
        "name": Literal["SingleUNet"],
        "base_dim": Width,
        "num_blocks": Few,
        "attention_resolutions": Annotated[Sequence[Natural], Entries(most=8)],
        "max_sh_degree": Literal[1],
        "network_with_offset": Literal[True],
        "isotropic": Literal[False],
    },
    "cam_embd": {"embedding": NoneType},  # models of two images embed their cameras
}


class Published(NamedTuple):
    """Checkpoint of published weights, and the sections `data` and `model` of its config."""

    weights: Path
    data: Mapping[str, Any]
    model: Mapping[str, Any]


def is_published(weights: Path | str) -> bool:
    """Return whether `weights` are Splatter Image's: `splatter_image:NAME`, a `.pth` file, or its folder or run."""
    path = Path(str(weights)).expanduser()
    return str(weights).startswith(PREFIX) or path.suffix == ".pth" or (os.path.isdir(path) and bool(_models_in(path)))


def find(weights: str) -> Published:
    """Find the files of `weights`: `splatter_image:NAME` on the hub (downloaded once), or a local file or folder.

    Raises:
        WeightsError: they are missing, cannot be downloaded, or have options that no published weights have.
    """
    if weights.startswith(PREFIX):
        config, model = _download(weights.removeprefix(PREFIX))
    else:
        model = _local(Path(weights).expanduser())
        config = _config_beside(model)
    options = _read_config(config)
    return Published(model, options["data"], options["model"])


def read_tensors(path: Path) -> dict[str, Tensor]:
    """Read the tensors of a checkpoint by name, mapped from the file, so that unused ones take no memory.

    Raises:
        WeightsError: the file is damaged, holds anything but plain data, or has no tensors of a model.
    """
    try:
        checkpoint = read_tensor_file(path, mmap=True)
    except TensorFileError as error:
        raise WeightsError(f"{path}: damaged, or not plain numbers ({error}); fetch it again") from error
    tensors = checkpoint.get(STATE) if isinstance(checkpoint, dict) else None
    if not isinstance(tensors, dict) or not all(isinstance(value, Tensor) for value in tensors.values()):
        raise WeightsError(f"{path}: no {STATE} in it; give Splatter Image's own file")
    return tensors


def write_trained(folder: Path, weights: Path, tensors: Mapping[str, Tensor]) -> None:
    """Write fine-tuned weights in the format of their authors' files, with an unchanged copy of their config."""
    make_folder(folder)
    config = _config_beside(weights)
    write_text(folder / config.name, read_small(config))
    with atomic_path(folder / weights.name) as temporary:
        torch.save({STATE: {name: value.detach().cpu() for name, value in tensors.items()}}, temporary)


def _models_in(folder: Path) -> list[Path]:
    paths = [*folder.glob("model_*.pth"), *(folder / RUN_WEIGHTS).glob("model_*.pth")]
    return sorted(path for path in paths if _config_beside(path).is_file())


def _config_beside(model: Path) -> Path:
    match = MODEL_FILE.fullmatch(model.name)
    name = GENERAL if model.name == GENERAL_FILE else match[1] if match else "NAME"
    return model.with_name(f"config_{name}.yaml")


def _local(path: Path) -> Path:
    models = _models_in(path) if path.is_dir() else [path]
    if len(models) > 1:
        names = ", ".join(model.name for model in models)
        raise WeightsError(f"{path}: holds {names}; give one of these files")
    if not models or not models[0].is_file():
        raise WeightsError(f"{path}: no such file")
    if not (config := _config_beside(models[0])).is_file():
        raise WeightsError(f"{models[0]}: {config.name} is missing beside it; both are at https://huggingface.co/{HUB}")
    return models[0]


def _download(name: str) -> tuple[Path, Path]:
    if not re.fullmatch(r"\w+", name):
        raise WeightsError(
            f"{PREFIX}{printable(name, SHORT)}: give NAME of a config_NAME.yaml at https://huggingface.co/{HUB}"
        )
    files = f"config_{name}.yaml", GENERAL_FILE if name == GENERAL else f"model_{name}.pth"
    advice = f"where there is a network, `hf download {HUB} {' '.join(files)} --local-dir DIR` fetches it; "
    advice += f"then give weights=DIR/{files[1]}"
    folder = from_hub(HUB, files, advice)
    config, model = (folder / file for file in files)
    if not (config.is_file() and model.is_file()):
        raise WeightsError(f"{PREFIX}{name}: {' or '.join(files)} is not in {folder}, the copy of {HUB}; {advice}")
    return config, model


def _read_config(path: Path) -> dict[str, dict[str, Any]]:
    """Read the options in `SECTIONS`; a missing option counts as null, a missing `input_images` as 1."""
    text = read_small(path)
    try:
        if any(isinstance(token, yaml.AliasToken) for token in yaml.scan(text)):
            raise WeightsError(f"{path}: has aliases, which can unpack to any size; Splatter Image's files have none")
        config = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError) as error:
        raise WeightsError(f"{path}: not readable as YAML ({type(error).__name__})") from error
    sections: dict[str, dict[str, Any]] = {}
    for section, hints in SECTIONS.items():
        options = config.get(section) if isinstance(config, Mapping) else None
        options = {"input_images": 1, **options} if isinstance(options, Mapping) else {}
        sections[section] = {name: options.get(name) for name in hints}
        for name, hint in hints.items():
            for place, value, reason in refused(hint, sections[section][name]):
                message = f"{path}: {section}.{name}{place} is {printable(value, SHORT)}: {reason}"
                raise WeightsError(f"{message}; only Splatter Image's weights for one image, as published, are read")
    if not sections["data"]["znear"] < sections["data"]["zfar"]:
        raise WeightsError(f"{path}: data.znear must be below data.zfar")
    return sections
