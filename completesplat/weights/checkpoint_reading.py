"""Checkpoints of training: told whole from damaged, and read as plain tensors, without Lightning."""

import hashlib
import os
import pickletools
import re
import zipfile
from collections.abc import Iterator, Mapping
from encodings import normalize_encoding
from encodings.aliases import aliases
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from completesplat.errors import WeightsError
from completesplat.weights import sha256_of

END, END_BYTES = b"PK\5\6", 22
"""How the last record of a zip archive begins, and its length without the comment behind it."""
CHECKSUM, DIGEST_BYTES = b"sha256:", 64
SHARDS, SHARDS_SUFFIX = "shards", ".shards"
"""The entry of a checkpoint that several processes wrote: the folder beside it with the files of their divided tensors,
and the SHA-256 of each."""
DIVIDED = "divided:"
"""How the name begins that stands in the place of such a tensor."""
PLAIN = re.compile(
    r"torch (\w+Storage|Size|device|[a-z]\w*)|torch\._utils _rebuild_(tensor(_v[23])?|parameter)"
    r"|torch\.nn\.parameter Parameter|collections (OrderedDict|Counter)|builtins (set|complex)|_codecs encode"
)
"""What tensors, containers and bytes are made with. torch's own list has more, of which byte arrays and others are as
large as a few bytes say."""
OF_BYTES = {codec for codec in aliases.values() if codec.endswith("_codec")}
"""Codecs that make bytes of bytes (hexadecimal digits): twice as many, as often as they are asked."""
MOST_REPEATED = 2**26
"""Bytes of a tensor that is larger than its file, because it repeats what it has."""


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
        found: dict[str, Any] = _load(path, mmap=True).get(SHARDS, {})
    except Exception:
        return {}
    return found


def _load(path: Path, mmap: bool = False) -> dict[str, Any]:
    """What `torch.save` wrote; `WeightsError` for a file that is made to take more memory than it has bytes."""
    size = path.stat().st_size
    with zipfile.ZipFile(path) as archive:
        records = archive.infolist()
        if sum(record.file_size for record in records) > size:
            raise WeightsError(f"{path}: not a readable checkpoint (its parts are larger than the file)")
        # The reader takes no notice of capitals.
        pickles = [archive.read(record) for record in records if record.filename.lower().endswith(".pkl")]
    if (grows := next(filter(None, map(_growing, pickles)), None)) is not None:
        raise WeightsError(f"{path}: not a readable checkpoint (made of {grows}, not of tensors alone)")
    contents: dict[str, Any] = torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
    if any(value.nbytes > max(size, MOST_REPEATED) for value in _tensors(contents)):
        raise WeightsError(f"{path}: not a readable checkpoint (a tensor is larger than the file)")
    return contents


def _growing(pickle: bytes) -> str | None:
    """What a pickle names that is larger in memory than in the file, if there is such a thing."""
    operations = [(opcode.name, str(argument)) for opcode, argument, _ in pickletools.genops(pickle)]
    named = [argument for opcode, argument in operations if opcode == "GLOBAL"]
    if "_codecs encode" in named:
        texts = (argument for opcode, argument in operations if opcode == "BINUNICODE")
        named += [f"the codec {text}" for text in texts if _codec(text) in OF_BYTES]
    return next((name for name in named if not PLAIN.fullmatch(name)), None)


def _codec(text: str) -> str:
    """The codec that Python finds by a name."""
    name = normalize_encoding(text).lower().replace(".", "_")
    return aliases.get(name, name)


def _tensors(contents: Any) -> Iterator[Tensor]:
    """Those in nested containers. A container may be in others many times, and is looked into once."""
    left, seen = [contents], set[int]()
    while left:
        part = left.pop()
        if id(part) in seen:
            continue
        seen.add(id(part))
        if isinstance(part, Tensor):
            yield part
        elif isinstance(part, Mapping | list | tuple | set):
            left.extend(part.values() if isinstance(part, Mapping) else part)


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
        contents = _put_together(Path(path), _load(Path(path)))
        name = not_finite(contents["state_dict"])
    except WeightsError:
        raise
    except Exception as error:
        raise WeightsError(f"{path}: not a readable checkpoint ({type(error).__name__})") from error
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
