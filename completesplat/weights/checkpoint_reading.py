"""Checkpoints of training: told whole from damaged, and read as plain tensors, without Lightning."""

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from completesplat.errors import TensorFileError, WeightsError
from completesplat.weights import sha256_of
from completesplat.weights.tensor_files import read_tensor_file

END, END_BYTES = b"PK\5\6", 22
"""How the last record of a zip archive begins, and its length without the comment behind it."""
CHECKSUM, DIGEST_BYTES = b"sha256:", 64
SHARDS, SHARDS_SUFFIX = "shards", ".shards"
"""The entry of a checkpoint that several processes wrote: the folder beside it with the files of their divided tensors,
and the SHA-256 of each."""
DIVIDED = "divided:"
"""How the name begins that stands in the place of such a tensor."""


def check_whole(path: Path) -> None:
    """`WeightsError` unless a checkpoint is as it was written; of one without a checksum, as torch writes, its end.

    The shards of one that several processes wrote belong to it.
    """
    bytes_of_end = END_BYTES + len(CHECKSUM) + DIGEST_BYTES
    with path.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        file.seek(max(0, size - bytes_of_end))
        end = file.read()
        if not end.startswith(END):
            if end[-END_BYTES:].startswith(END) and end.endswith(b"\0\0"):
                return
            raise WeightsError(f"{path}: not a readable checkpoint (damaged at its end, or cut off)")
        digest, left = hashlib.sha256(), size - DIGEST_BYTES
        file.seek(0)
        while left and (part := file.read(min(left, 2**20))):
            digest.update(part)
            left -= len(part)
    if end[-DIGEST_BYTES:] != digest.hexdigest().encode():
        raise WeightsError(f"{path}: not a readable checkpoint (damaged: its checksum is another)")
    shards = shards_of(path)
    for name, checksum in shards.get("files", {}).items():
        shard = path.parent / Path(shards["folder"]).name / Path(name).name
        if not shard.is_file() or sha256_of(shard) != checksum:
            raise WeightsError(f"{path}: not a readable checkpoint (damaged: {shard} is missing or another)")


def shards_of(path: Path) -> dict[str, Any]:
    """The folder and the files of a checkpoint's divided tensors; an empty mapping if it has none, or is unreadable."""
    if not any(path.parent.glob(f"*{SHARDS_SUFFIX}")):
        return {}
    try:
        shards: dict[str, Any] = read_tensor_file(path, mmap=True).get(SHARDS, {})
    except Exception:
        return {}
    return shards


def _put_together(path: Path, contents: dict[str, Any]) -> dict[str, Any]:
    """A checkpoint's contents with its divided tensors in their places, as one process would have written it.

    They are safetensors: reading them runs nothing.
    """
    if (shards := contents.pop(SHARDS, None)) is None:
        return contents
    from torch.distributed.checkpoint.hf_storage import HuggingFaceStorageReader  # takes its time
    from torch.distributed.checkpoint.state_dict_loader import load

    folder = path.parent / Path(shards["folder"]).name
    reader = HuggingFaceStorageReader(str(folder))
    entries: dict[str, Any] = reader.read_metadata().state_dict_metadata
    asked = sum(entry.size.numel() * entry.properties.dtype.itemsize for entry in entries.values())
    if asked > sum(file.stat().st_size for file in folder.iterdir()):
        raise WeightsError(f"{path}: not a readable checkpoint (its tensors are larger than the files in {folder})")
    tensors = {name: torch.empty(entry.size, dtype=entry.properties.dtype) for name, entry in entries.items()}
    load(tensors, storage_reader=reader, no_dist=True)

    def filled(value: Any) -> Any:
        if isinstance(value, str) and value.startswith(DIVIDED):
            return tensors[value.removeprefix(DIVIDED)]
        if isinstance(value, dict):
            return {key: filled(part) for key, part in value.items()}
        return type(value)(map(filled, value)) if isinstance(value, list | tuple) else value

    whole: dict[str, Any] = filled(contents)
    return whole


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """A checkpoint's contents.

    `WeightsError`: the file is missing, damaged, no checkpoint of plain tensors, made to take more memory than it has
    bytes, or its weights are not finite.
    """
    if not Path(path).is_file():
        raise WeightsError(f"{path}: no such checkpoint")
    check_whole(Path(path))
    try:
        contents = _put_together(Path(path), read_tensor_file(Path(path)))
        name = not_finite(contents["state_dict"])
    except WeightsError:
        raise
    except Exception as error:
        reason = error if isinstance(error, TensorFileError) else type(error).__name__
        raise WeightsError(f"{path}: not a readable checkpoint ({reason})") from error
    if name is not None:
        raise WeightsError(f"{path}: {name} is not finite")
    return contents


def not_finite(weights: Mapping[str, Any]) -> str | None:
    """The name of the first tensor that holds NaN or infinities, if there is one."""
    return next((n for n, x in weights.items() if isinstance(x, Tensor) and not x.isfinite().all()), None)


def load_part(module: nn.Module, path: str | Path, prefix: str) -> None:
    """Load the weights below `prefix` of a checkpoint into a module; `WeightsError` unless all are there and fit."""
    weights = read_checkpoint(path)["state_dict"]
    part = {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}
    try:
        module.load_state_dict(part)
    except RuntimeError as error:
        first = str(error).splitlines()[1].strip() if "\n" in str(error) else str(error)
        raise WeightsError(f"{path}: weights of another architecture: {first}") from error
