"""Reading of checkpoints and other `torch.save` files: plain tensors, in no more memory than the file has bytes.

`torch.load(weights_only=True)` runs no code of a file, but the calls that it allows can turn a few bytes into much
memory. The pickle is therefore read as a list of steps before it is loaded, and may only contain calls that torch.save
writes. None of this needs Lightning.
"""

import hashlib
import math
import os
import pickletools
import re
import zipfile
from collections.abc import Mapping
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from completesplat.errors import TensorFileError, WeightsError
from completesplat.settings.schema import shown

END, END_BYTES = b"PK\5\6", 22
"""First bytes of a zip archive's last record, and the record's length without the comment at its end."""
CHECKSUM, DIGEST_BYTES = b"sha256:", 64
ZIP = b"PK\3\4"
MOST_REPEATED, MOST_VIEWS = 2**22, 4  # elements of all tensors together: this many, and of each in the file so many
PLAIN = re.compile(
    r"torch (\w+Storage|Size|device|[a-z]\w*)|torch\._utils _rebuild_(tensor(_v[23])?|parameter)"
    r"|collections (OrderedDict|Counter)|_codecs encode"
)
"""Names that build tensors, containers and bytes. torch allows more, such as byte arrays of any length."""
NUMBERS = {"BININT", "BININT1", "BININT2", "LONG1"}
TEXTS = {"BINUNICODE", "SHORT_BINSTRING"}
TUPLES = {"EMPTY_TUPLE", "TUPLE", "TUPLE1", "TUPLE2", "TUPLE3"}
MAPPINGS = {"EMPTY_DICT", "SETITEM", "SETITEMS"}
CALLS = {"REDUCE", "BUILD", "NEWOBJ", "BINPERSID"}
LONGEST_NAME = 16


class _Op(NamedTuple):
    """Operation of a pickle, its argument, and the steps whose results it takes (kept for calls and tuples)."""

    name: str
    argument: Any = None
    inputs: tuple["_Op", ...] = ()


def read_tensor_file(path: Path, mmap: bool = False) -> Any:
    """Return what `torch.save` wrote to a file, on the CPU.

    Args:
        mmap: map the tensors from the file; its checksums (CRC-32) are not compared then.

    Raises:
        TensorFileError: the file is no zip archive from its first byte on, is damaged, has records or tensors that are
            larger than itself, or holds anything but tensors and plain values.
    """
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            # If a file starts with other bytes, torch reads an older format, even if an archive follows.
            if file.read(len(ZIP)) != ZIP:
                raise TensorFileError("not an archive of torch.save")
            file.seek(0)
            archive = torch._C.PyTorchFileReader(file)
            if sum(map(archive.get_record_size, archive.get_all_records())) > size:
                raise TensorFileError("its parts are larger than the file")
            _check_steps(archive.get_record("data.pkl"))
        if not mmap:
            with zipfile.ZipFile(path) as records:  # torch compares no checksums
                whole = sum(record.file_size for record in records.infolist()) <= size and records.testzip() is None
            if not whole:
                raise TensorFileError("damaged: its checksum is another")
        return torch.load(path, map_location="cpu", weights_only=True, mmap=mmap)
    except TensorFileError:
        raise
    except Exception as error:  # torch, zipfile and pickletools raise many kinds for a damaged file
        raise TensorFileError(type(error).__name__) from error


def _check_steps(pickle: bytes) -> None:
    """Raise TensorFileError for a pickle with a step that may make more than the file holds."""
    stack: list[_Op] = []
    marks: list[int] = []
    memo: dict[object, _Op] = {}
    stored: dict[str, int] = {}  # lengths of the storages by their names
    elements = 0
    for opcode, argument, _ in pickletools.genops(pickle):
        name, before = opcode.name, opcode.stack_before
        if name == "MARK":
            marks.append(len(stack))
        elif name.endswith("PUT"):
            memo[argument] = stack[-1]
        elif name.endswith("GET"):
            value = memo[argument]
            is_name = value.name == "GLOBAL" or (value.name in TEXTS and len(value.argument) <= LONGEST_NAME)
            stack.append(value if is_name else _Op(name))
        else:
            marked = pickletools.markobject in before
            first = marks.pop() - before.index(pickletools.markobject) if marked else len(stack) - len(before)
            step = _Op(name, argument, tuple(stack[first:]) if name in CALLS | TUPLES else ())
            if not _is_plain(step):
                made = next((value.argument for value in step.inputs if value.name == "GLOBAL"), argument or name)
                raise TensorFileError(f"made of {shown(made)}, not of tensors alone")
            if name == "BINPERSID":
                _, _, key, _, length = step.inputs[0].inputs
                stored[key.argument] = length.argument
            elements += _elements(step)
            # Only the names of calls are needed.
            stack[first:] = [_Op(name) if name in CALLS else step] * len(opcode.stack_after)
    if elements > MOST_VIEWS * sum(stored.values()) + MOST_REPEATED:
        raise TensorFileError("its tensors are larger than the file")


def _elements(step: _Op) -> int:
    """Return the number of elements of the tensor that a step makes, 0 if it makes none."""
    match step:
        case _Op("REDUCE", _, (_Op("GLOBAL", function), _Op(_, _, (_Op("BINPERSID"), _, sizes, *_)))):
            return abs(math.prod(size.argument for size in sizes.inputs)) if "_rebuild_tensor" in function else 0
    return 0


def _is_plain(step: _Op) -> bool:
    """Return whether `torch.save` writes this step; with arguments beside it, no large value is repeated."""
    match step:
        case _Op("GLOBAL"):
            return PLAIN.fullmatch(step.argument) is not None
        case _Op("BUILD", _, (_, state)):
            return state.name in MAPPINGS
        # The archive's reader ignores case, so keys with letters could name one record many times.
        case _Op("BINPERSID", _, (_Op("TUPLE", _, (_, _Op("GLOBAL"), key, _, length)),)):
            return key.name in TEXTS and re.fullmatch("[0-9]+", key.argument) is not None and length.name in NUMBERS
        case _Op("REDUCE", _, (_Op("GLOBAL", function), arguments)) if arguments.name in TUPLES:
            return _is_plain_call(function, arguments.inputs)
    return step.name not in CALLS


def _is_plain_call(function: str, arguments: tuple[_Op, ...]) -> bool:
    """Return whether a call makes no more than its arguments hold in the file."""
    match function.split()[1], arguments:
        case "OrderedDict", ():
            return True
        case "Counter", (counts,):
            return counts.name in MAPPINGS
        case "Size", (sizes,):
            return sizes.name in TUPLES
        case "device", (place, *index):
            return place.name in TEXTS and all(number.name in NUMBERS for number in index)
        case "encode", (text, codec):
            # Some other codecs double the bytes each time they are called.
            return text.name in TEXTS and codec == _Op(codec.name, "latin1")
        case "_rebuild_parameter", _:
            return True
        case "_rebuild_tensor" | "_rebuild_tensor_v2" | "_rebuild_tensor_v3", (_Op("BINPERSID"), _, sizes, *_):
            return sizes.name in TUPLES and all(size.name in NUMBERS for size in sizes.inputs)
    return False


def check_whole(path: Path) -> None:
    """Raise WeightsError if a checkpoint has changed since it was written.

    Without a checksum, as in files that torch wrote, only the end is checked.
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


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint's contents.

    Raises:
        WeightsError: the file is missing, damaged, no checkpoint of plain tensors, made to take more memory than it has
            bytes, or its weights are not finite.
    """
    if not Path(path).is_file():
        raise WeightsError(f"{path}: no such checkpoint")
    check_whole(Path(path))
    try:
        contents: dict[str, Any] = read_tensor_file(Path(path))
        name = not_finite(contents["state_dict"])
    except WeightsError:
        raise
    except Exception as error:
        reason = error if isinstance(error, TensorFileError) else type(error).__name__
        raise WeightsError(f"{path}: not a readable checkpoint ({reason})") from error
    if name is not None:
        raise WeightsError(f"{path}: {name} is not finite")
    return contents


def not_finite(weights: Mapping[str, object]) -> str | None:
    """Return the name of the first tensor that holds NaN or infinities, if there is one."""
    return next((n for n, x in weights.items() if isinstance(x, Tensor) and not x.isfinite().all()), None)


def mismatch(network: Mapping[str, Tensor], weights: Mapping[str, Tensor]) -> str | None:
    """Describe the first difference between a network's tensors and a file's, in sizes, kinds or names, if any.

    Floats of any precision are one kind, because they are converted; other kinds would be cast in silence.
    """
    pairs = {name: (_described(weights[name]), _described(x)) for name, x in network.items() if name in weights}
    different = (f"{name} is {there} there and {here} here" for name, (there, here) in pairs.items() if there != here)
    missing = (f"{name} is missing there" for name in network if name not in weights)
    needless = (f"{name} has no place here" for name in weights if name not in network)
    return next(chain(different, missing, needless), None)


def _described(tensor: Tensor) -> str:
    kind = "" if tensor.is_floating_point() else f" of {tensor.dtype}"
    return f"{list(tensor.shape)}{kind}"


def load_part(module: nn.Module, path: str | Path, prefix: str) -> None:
    """Load a checkpoint's weights below `prefix` into a module; raise WeightsError unless all are present and fit."""
    weights = read_checkpoint(path)["state_dict"]
    part = {key.removeprefix(prefix): value for key, value in weights.items() if key.startswith(prefix)}
    if (difference := mismatch(module.state_dict(), part)) is not None:
        raise WeightsError(f"{path}: weights of another architecture: {difference}")
    module.load_state_dict(part)
