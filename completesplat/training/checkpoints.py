"""Reading checkpoints: plain tensors and containers only, so `weights_only=True` always."""

from pathlib import Path
from typing import Any

import torch
from torch import nn

from completesplat.errors import WeightsError


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """A checkpoint's contents.

    Raises:
        WeightsError: the file is missing or not a checkpoint of plain tensors.
    """
    if not Path(path).is_file():
        raise WeightsError(f"{path}: no such checkpoint")
    try:
        contents = torch.load(path, map_location="cpu", weights_only=True)
        return {"state_dict": contents["state_dict"], **contents}
    except Exception as error:
        raise WeightsError(f"{path}: not a readable checkpoint ({type(error).__name__})") from error


def load_part(module: nn.Module, path: str | Path, prefix: str) -> None:
    """Load the weights below `prefix` of a checkpoint into a module; all must fit.

    Raises:
        WeightsError: the file is unusable, or its weights are those of another architecture.
    """
    weights = read_checkpoint(path)["state_dict"]
    part = {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}
    try:
        module.load_state_dict(part)
    except RuntimeError as error:
        first = str(error).splitlines()[1].strip() if "\n" in str(error) else str(error)
        raise WeightsError(f"{path}: weights of another architecture: {first}") from error
